"""The training loop: a pure step, samples fed ahead of it, checkpoints, a training that goes on."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from spdm_jax.batching import prefetch

from .params import Params
from .train_data import TrainSample, count, rows_of_step, take
from .train_state import Log, TrainState, read_state, write_state
from .train_tasks import Parts, Task

Precision = Literal["f32", "bf16"]
READ_EVERY = 20
"""Steps between two looks at the losses; the device runs ahead meanwhile."""
STATE_FILE = "state.safetensors"
_ALGORITHMS: dict[Precision, str] = {"bf16": "BF16_BF16_F32"}
_TrainStep = Callable[[TrainState, TrainSample], tuple[TrainState, Parts]]


@dataclass(frozen=True)
class FitConfig:
    """How long and how a training runs.

    Attributes:
      steps: of the whole training.
      batch: samples of a step; fewer where there are fewer.
      seed: of weights, order and dropout.
      rate: learning rate at the beginning; the recipe's if None.
      every: steps between two checkpoints.
      dropout: whether it is on.
      precision: of matrix products; weights are float32 in any case. "bf16" needs a GPU to have an
        effect.
      devices: local devices that share each batch; None for all.
    """

    steps: int
    batch: int
    seed: int = 0
    rate: float | None = None
    every: int = 200
    dropout: bool = True
    precision: Precision = "f32"
    devices: int | None = None

    def __post_init__(self):
        for name in ("steps", "batch", "every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")


@dataclass(frozen=True)
class Fitted:
    """Outcome of `fit`.

    Attributes:
      params: what was trained.
      log: what was measured.
      step: steps done; fewer than wanted after a stop.
    """

    params: Params
    log: Log
    step: int


class Diverged(ValueError):
    """A loss is not finite any more."""


def train_step(
    task: Task,
    optimizer: optax.GradientTransformation,
    planner: bool,
    dropout: bool,
    state: TrainState,
    batch: TrainSample,
) -> tuple[TrainState, Parts]:
    """One step; pure.

    Args:
      task: what is trained.
      optimizer: of `Task.optimizer`.
      planner: whether the planner is part of the loss.
      dropout: whether it is on.
      state: before the step.
      batch: samples `[B]`.

    Returns:
      The state after the step, and scalars: loss, its parts, norm of the gradients.
    """
    key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
    dropout_key = key if dropout else None
    (loss, parts), gradients = jax.value_and_grad(task.loss, has_aux=True)(
        state.params, batch, dropout_key, planner
    )
    updates, inner = optimizer.update(gradients, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    moved = state.replace(params=params, optimizer=inner, step=state.step + 1)
    return moved, {"loss": loss, **parts, "gradient": optax.tree_utils.tree_norm(gradients)}


def initial_state(
    task: Task, seed: int, rate: optax.Schedule
) -> tuple[TrainState, optax.GradientTransformation]:
    """Returns the state before the first step, and the optimiser that it belongs to."""
    weights, noise = jax.random.split(jax.random.key(seed))
    params = task.init(weights)
    optimizer = task.optimizer(rate, params)
    state = TrainState(
        params=params,
        optimizer=optimizer.init(params),
        step=jnp.zeros((), jnp.int32),
        key=jax.random.key_data(noise),
    )
    return state, optimizer


def fit(
    task: Task,
    train: TrainSample,
    held_out: TrainSample | None,
    config: FitConfig,
    folder: Path,
    about: Mapping[str, Any],
    *,
    progress: Callable[[int, Log], None] = lambda step, log: None,
    stop: Callable[[], bool] = lambda: False,
) -> Fitted:
    """Trains, or goes on with the training whose checkpoint lies in a folder.

    A training that was stopped or killed and goes on gives the same weights as one that was not,
    bit for bit, on the same devices (on a GPU as far as its kernels add up in a fixed order).

    Args:
      task: what is trained.
      train: samples, NumPy leaves `[S, ...]`.
      held_out: samples that the network is tested on after every epoch, or None.
      config: how long and how.
      folder: of the checkpoint; exists.
      about: what is trained on what, in JSON.
      progress: is told the number of steps done and what was measured, every few steps.
      stop: whether the user wants to stop; a checkpoint is written then.

    Raises:
      ValueError: there are no samples, the devices cannot share a batch, or the checkpoint is of
        another training.
      Diverged: the loss is not finite; the checkpoint before it is kept.
    """
    total = count(train)
    if total == 0:
        raise ValueError("there are no samples to train on")
    size = min(config.batch, total)
    place = _Placement(config, size)
    rate = task.recipe.schedule(config.steps, config.rate)
    state, optimizer = initial_state(task, config.seed, rate)
    log, path = Log(), folder / STATE_FILE
    if path.exists():
        state, log = read_state(path, state, about)
    state, begin = place.everywhere(state), int(state.step)
    planner_from = task.recipe.planner_from(config.steps)
    steps = {
        planner: jax.jit(
            partial(train_step, task, optimizer, planner, config.dropout),
            out_shardings=place.whole,
        )
        for planner in (False, True)
    }
    test = jax.jit(task.metrics)
    feed = prefetch(
        lambda step: place.split(take(train, rows_of_step(config.seed, step, total, size))),
        range(begin, config.steps),
    )
    done, waiting = begin, []
    with place.precision():
        for done, batch in enumerate(feed, begin + 1):
            state, parts = steps[done > planner_from](state, batch)
            waiting.append(parts)
            stopping = stop()
            last = done == config.steps or stopping
            epoch_ends = done % (total // size) == 0 or done == config.steps
            saves = last or done % config.every == 0
            if saves or epoch_ends or len(waiting) == READ_EVERY:
                _read_losses(log, waiting, done, path)
                waiting = []
            if epoch_ends and held_out is not None and count(held_out):
                log.add_validation(done, validate(test, state.params, held_out, size, place.split))
            if saves:
                write_state(path, state, log, about)
            if not waiting:
                progress(done, log)
            if last:
                break
    return Fitted(params=state.params, log=log, step=done)


def validate(
    metrics: Callable[[Params, TrainSample], Parts],
    params: Params,
    samples: TrainSample,
    size: int,
    place: Callable[[TrainSample], TrainSample] = lambda samples: samples,
) -> dict[str, float]:
    """Returns the mean of each metric over the samples that have it; NaN where none has.

    Args:
      metrics: `Task.metrics`, compiled.
      params: what was trained.
      samples: NumPy leaves `[S, ...]`.
      size: samples per call.
      place: moves samples to the devices.
    """
    total = count(samples)
    parts: list[Any] = []
    for begin in range(0, total, size):
        # The last call is filled up with its last sample.
        rows = np.minimum(np.arange(begin, begin + size), total - 1)
        found = jax.device_get(metrics(params, place(take(samples, rows))))
        parts.append({name: values[: total - begin] for name, values in found.items()})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    known = {name: values[~np.isnan(values)] for name, values in joined.items()}
    return {name: float(v.mean()) if len(v) else float("nan") for name, v in known.items()}


class _Placement:
    """Where a training computes: one device, or several that share each batch."""

    def __init__(self, config: FitConfig, size: int):
        devices = jax.local_devices()[: config.devices]
        if config.devices is not None and len(devices) < config.devices:
            raise ValueError(f"devices is {config.devices}, but there are {len(devices)}")
        if size % len(devices):
            raise ValueError(
                f"{len(devices)} devices cannot share a batch of {size} samples evenly; choose a "
                "multiple for the batch, or fewer devices"
            )
        mesh = Mesh(np.array(devices), ("batch",))
        self.whole = NamedSharding(mesh, PartitionSpec())
        self._parts = NamedSharding(mesh, PartitionSpec("batch"))
        self._algorithm = _ALGORITHMS.get(config.precision)

    def everywhere(self, state: TrainState) -> TrainState:
        """Puts a state on every device."""
        return jax.device_put(state, self.whole)

    def split(self, samples: TrainSample) -> TrainSample:
        """Gives each device its part of a batch."""
        return jax.device_put(samples, self._parts)

    def precision(self) -> AbstractContextManager[Any]:
        """Sets the algorithm of matrix products for what is traced inside."""
        if self._algorithm is None:
            return nullcontext()
        return jax.default_matmul_precision(self._algorithm)


def _read_losses(log: Log, waiting: list[Parts], done: int, path: Path) -> None:
    """Moves what the last steps measured to the log.

    Raises:
      Diverged: a loss, or the norm of its gradients, is not finite.
    """
    found = jax.device_get(waiting)
    # Compiled functions return dicts in alphabetical order.
    columns = ("loss", *(name for name in found[0] if name != "loss"))
    rows = np.array([[part[name] for name in columns] for part in found], np.float32)
    wrong = ~np.all(np.isfinite(rows), axis=1)
    if np.any(wrong):
        first = int(np.argmax(wrong))
        values = dict(zip(columns, rows[first].tolist(), strict=True))
        kept = f"{path} is the last good state" if path.exists() else "there is no checkpoint yet"
        raise Diverged(
            f"step {done - len(waiting) + first + 1}: the loss is no number any more ({values}); "
            f"{kept}. Train with a lower rate or another seed"
        )
    log.add_losses(columns, rows)
