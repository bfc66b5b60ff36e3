"""Training samples from recorded scenarios: what a network sees at a step, and what happened next.

A scenario gives one sample per start time. Samples are computed once, many at a time, and kept in
host memory; which of them a training step sees is a pure function of seed and step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.agents.observation import Observation
from spdm_jax.batching import BatchConfig, SceneRunner
from spdm_jax.config import VehicleParams
from spdm_jax.proposals.lanes import starting_lane
from spdm_jax.types import Array, EgoState, Scenario, ScenarioBatch

from .dipp import DIPPFeatures
from .dipp_features import DIPPFeatureConfig, dipp_features
from .dipp_on_gameformer import CenterPath, DIPPRefinerConfig, center_path
from .dtpp_planner import TRAINING_LIMIT, DTPPPlannerConfig, scene_paths, training_tree
from .scene_encoder import SceneFeatures
from .scene_features import (
    FeatureConfig,
    History,
    pick_neighbors,
    recorded_futures,
    recorded_history,
    scene_features,
)

Inputs = Literal["gameformer", "gameformer-dipp", "dtpp", "dipp"]
STARTS_PER_CALL = 8
"""Start times of one scenario that are computed together."""


@dataclass(frozen=True)
class SampleConfig:
    """What a sample holds.

    Attributes:
      inputs: of which network.
      features: what it sees; `rearmost` is None, as training keeps neighbours behind the ego.
      count: A, neighbours whose future is learnt.
      steps: T, future samples of 0.1 s.
      planner: of DTPP's training trees.
      refiner: of the centre line.
      dipp: sizes of DIPP's inputs.
    """

    inputs: Inputs
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(rearmost=None))
    count: int = 10
    steps: int = 80
    planner: DTPPPlannerConfig = field(default_factory=DTPPPlannerConfig)
    refiner: DIPPRefinerConfig = field(default_factory=DIPPRefinerConfig)
    dipp: DIPPFeatureConfig = field(default_factory=DIPPFeatureConfig)


class TrainSample(struct.PyTreeNode, kw_only=True):
    """One sample, in the frame of the ego's rear axle now; m, rad, s.

    All fields may have the same leading axes.

    Attributes:
      features: `SceneFeatures`, or DIPP's `DIPPFeatures`.
      ego: `[T, 3]` x, y, heading the ego drove, first at 0.1 s.
      neighbors: `[A, T, 3]` those of the nearest neighbours; zero where there is no record.
      first: `[N, 80, 6]` first-stage branches of DTPP's tree, else None.
      second: `[N, 80, 6]` branches of both stages, else None.
      path: `[P, 3]` centre line (DIPP and GameFormer with DIPP), else None.
      info: `[P]` speed limit along it, 0 where a light is red, else None.
    """

    features: Any
    ego: Array
    neighbors: Array
    first: Array = None
    second: Array = None
    path: Array = None
    info: Array = None


def sample_at(
    scene: Scenario, iteration: jax.Array, config: SampleConfig
) -> tuple[TrainSample, jax.Array]:
    """Builds the sample of one step.

    Args:
      scene: one scenario.
      iteration: `[]` step within the scenario's window.
      config: what the sample holds.

    Returns:
      The sample, and `[]` bool: the ego's whole future is known and, where a route or a tree is
      needed, it was found.
    """
    now = scene.num_history + iteration
    last = scene.ego_valid.shape[0] - 1
    wanted = now + jnp.arange(config.steps + 1)
    known = jnp.all(scene.ego_valid[jnp.clip(wanted, 0, last)] & (wanted <= last))
    valid = known & (iteration >= 0) & (iteration < scene.num_iterations)
    history = recorded_history(scene, iteration)
    neighbors = pick_neighbors(history, config.features)
    lights = scene.lights[now]
    features = scene_features(scene.map, scene.route, lights, history, neighbors, config.features)
    ego, others = recorded_futures(scene, neighbors, iteration, config.count, config.steps)
    sample = TrainSample(features=features, ego=ego, neighbors=others)
    state = jax.tree.map(lambda v: v[-1], history.ego)
    if config.inputs == "dtpp":
        seen = _seen(history, lights, now)
        found = scene_paths(scene.map, scene.route, state, seen, config.planner, TRAINING_LIMIT)
        tree = training_tree(found.paths, state.vx, state.ax, found.limit, ego, config.planner)
        sample = sample.replace(first=tree.first, second=tree.second)
        valid = valid & tree.useful & ~found.overflow
    if config.inputs in ("dipp", "gameformer-dipp"):
        center, on_route = _center(scene, lights, state, config)
        sample = sample.replace(path=center.path, info=center.info)
        valid = valid & on_route & ~center.overflow
    if config.inputs == "dipp":
        inputs = dipp_features(scene.map, lights, state, features, VehicleParams(), config.dipp)
        sample = sample.replace(features=inputs)
    return sample, valid


def _seen(history: History, lights: jax.Array, step: jax.Array) -> Observation:
    names = ("x", "y", "heading", "vx", "vy", "length", "width", "valid")
    tracks = history.tracks
    series = {name: getattr(tracks, name)[:, -1] for name in names}
    return Observation(**series, type=tracks.type, lights=lights, step=step)


def _center(
    scene: Scenario, lights: jax.Array, ego: EgoState, config: SampleConfig
) -> tuple[CenterPath, jax.Array]:
    usable = scene.map.lanes.valid
    lane = starting_lane(scene.map, scene.route, usable, ego, VehicleParams())
    return center_path(scene.map, scene.route, lane, lights, ego, config.refiner), lane >= 0


def _samples_of(scene: Scenario, starts: Any, shared: Any, config: SampleConfig) -> Any:
    """The start times `[K]` of one scenario; what a `SceneRunner` runs."""
    del shared
    return jax.vmap(lambda start: sample_at(scene, start, config))(starts)


class SampleMaker:
    """Computes samples of batches of scenarios; one program per shape of a batch."""

    def __init__(self, config: SampleConfig, stride: int, chunk: int | None = None):
        """Keeps the settings.

        Args:
          config: what samples hold.
          stride: steps of 0.1 s between the start times of a scenario.
          chunk: scenarios per device call; by their memory if None.

        Raises:
          ValueError: `stride` is no number of steps.
        """
        if stride < 1:
            raise ValueError(f"the stride is {stride} steps; it must be at least 1")
        self._stride = stride
        self._runner = SceneRunner(_samples_of, config, config=BatchConfig(chunk=chunk))

    def __call__(self, batch: ScenarioBatch) -> tuple[TrainSample, np.ndarray]:
        """Computes the samples of all scenarios of a batch.

        Args:
          batch: NumPy leaves `[B, ...]`.

        Returns:
          Samples, NumPy leaves `[S, ...]`, those without a future left out; and the scenario of
          each, `[S]`.
        """
        blocks = [
            (row, begin)
            for row, length in enumerate(np.asarray(batch.num_iterations))
            for begin in range(0, int(length), STARTS_PER_CALL * self._stride)
        ]
        row = np.array([row for row, _ in blocks])
        begin = np.array([begin for _, begin in blocks], np.int32)
        starts = begin[:, None] + self._stride * np.arange(STARTS_PER_CALL, dtype=np.int32)
        # Starts beyond the window are computed as well, from what is there, and then dropped.
        samples, valid = self._runner(batch, starts, scene_of=row)
        rows = np.broadcast_to(row[:, None], valid.shape)[valid]
        return jax.tree.map(lambda leaf: leaf[valid], samples), rows


def concatenate(parts: Sequence[TrainSample]) -> TrainSample:
    """Joins samples along their first axis."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def count(samples: TrainSample) -> int:
    """Returns the number of samples."""
    return len(samples.ego)


def take(samples: TrainSample, rows: np.ndarray) -> TrainSample:
    """Returns some samples, in the order of `rows`."""
    return jax.tree.map(lambda leaf: leaf[rows], samples)


def leaves_of(samples: TrainSample) -> dict[str, np.ndarray]:
    """Returns the arrays of samples by their place (`features.ego_past`), to be stored."""
    found = jax.tree_util.tree_leaves_with_path(samples)
    named = partial(jax.tree_util.keystr, simple=True, separator=".")
    return {named(path): leaf for path, leaf in found}


def from_leaves(leaves: Mapping[str, np.ndarray], inputs: Inputs) -> TrainSample:
    """Returns the samples that `leaves_of` took apart.

    Args:
      leaves: arrays by their place.
      inputs: of which network.

    Raises:
      TypeError: an array is missing or unknown.
    """
    kind = DIPPFeatures if inputs == "dipp" else SceneFeatures
    inner, outer = {}, {}
    for name, leaf in leaves.items():
        place, _, field_name = name.rpartition(".")
        (inner if place == "features" else outer)[field_name] = leaf
    return TrainSample(features=kind(**inner), **outer)


def rows_of_step(seed: int, step: int, total: int, batch: int) -> np.ndarray:
    """Returns the samples `[batch]` of a training step.

    Every epoch is a new order of all samples; what does not fill a batch is left out. The order
    depends on seed and epoch alone, so that a training that goes on sees what it would have seen.

    Args:
      seed: of the training.
      step: from 0 on.
      total: samples, at least `batch`.
      batch: samples of a step.
    """
    epoch, place = divmod(step, total // batch)
    order = np.random.default_rng([seed, epoch]).permutation(total)
    return order[place * batch : (place + 1) * batch]
