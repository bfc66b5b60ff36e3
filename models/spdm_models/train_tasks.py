"""What is trained: for each learned planner its sizes, its samples, its loss and its recipe.

Source: training scripts of GameFormer-Planner, DTPP and DIPP. They augment nothing. Differs: the
samples of all are shuffled (DTPP's script keeps them in the order of its files).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import optax

from spdm_jax.config import VehicleParams

from . import dipp, dipp_losses, dtpp, dtpp_losses, gameformer, gameformer_losses
from .dipp import FIXED_WEIGHTS, WEIGHT_SCALE, DIPPConfig
from .dipp_losses import PLAN_COST_FACTOR
from .dipp_on_gameformer import CenterPath, DIPPRefinerConfig, RefinedPlan, refine_plan
from .dipp_planner import TRAIN_SOLVER, DIPPPlannerConfig
from .dtpp import DTPPConfig
from .dtpp_driver import MAP_RADIUS
from .dtpp_losses import DTPPTargets
from .gameformer import GameFormerConfig, GameFormerOutput
from .gameformer_losses import Targets
from .optimizers import adamw, clip_by_norm
from .params import Params
from .scene_encoder import EncoderConfig
from .scene_features import FeatureConfig
from .train_data import SampleConfig, TrainSample
from .weights import Config, ModelName

TaskName = Literal["gameformer", "gameformer-0", "gameformer-dipp", "dtpp", "dipp"]
Size = Literal["small", "full"]
Parts = dict[str, jax.Array]
Loss = Callable[[Params, TrainSample, jax.Array | None, bool], tuple[jax.Array, Parts]]
WIDTHS: dict[Size, int] = {"small": 48, "full": 256}
"""Of a token; the published networks have the full one."""
CLIP_NORM = 5.0
FIRST_STEPS = 30
"""Steps of DTPP's first stage."""
_LABELS = ("minADE", "minFDE", "planADE", "planFDE")


@dataclass(frozen=True)
class Recipe:
    """A published training.

    Attributes:
      epochs: passes over the data.
      batch: samples of a step.
      rate: learning rate at the beginning.
      halved_after: epochs after which it is halved.
      planner_after: epochs after which the planner is part of the loss; None without one.
    """

    epochs: int
    batch: int
    rate: float
    halved_after: tuple[int, ...]
    planner_after: int | None = None

    def schedule(self, steps: int, rate: float | None = None) -> optax.Schedule:
        """Returns the learning rate by step, the recipe's epochs spread over `steps`."""
        halved = {round(epoch * steps / self.epochs): 0.5 for epoch in self.halved_after}
        return optax.piecewise_constant_schedule(self.rate if rate is None else rate, halved)

    def planner_from(self, steps: int) -> int:
        """Returns the first step whose loss holds the planner; `steps` if none does."""
        if self.planner_after is None:
            return steps
        return round(self.planner_after * steps / self.epochs)


GAMEFORMER_RECIPE = Recipe(20, 32, 1e-4, (10, 12, 14, 16, 18))
DTPP_RECIPE = Recipe(30, 16, 2e-4, (5, 10, 15, 20, 25))
DIPP_RECIPE = Recipe(20, 32, 2e-4, (4, 8, 12, 16), planner_after=5)


@dataclass(frozen=True)
class Task:
    """One kind of training; all functions are pure.

    Attributes:
      name: of the task.
      model: what the finished weights are of, see `weights.load_weights`.
      config: sizes of the network.
      recipe: published settings.
      sample: what a sample holds.
      init: key -> what is trained.
      loss: (params, samples `[B]`, dropout key or None, planner in the loss) -> loss, its parts.
      metrics: (params, samples `[B]`) -> `[B]` m by name, NaN where there is no neighbour.
      optimizer: (learning rate, params) -> steps as torch does them.
      network: what is trained -> variables of the network.
      learnt: what is trained -> what it holds beside the network, for the header of the weights.
    """

    name: TaskName
    model: ModelName
    config: Config
    recipe: Recipe
    sample: SampleConfig
    init: Callable[[jax.Array], Params]
    loss: Loss
    metrics: Callable[[Params, TrainSample], Parts]
    optimizer: Callable[[optax.Schedule, Params], optax.GradientTransformation]
    network: Callable[[Params], Params] = lambda params: params
    learnt: Callable[[Params], dict[str, Any]] = lambda params: {}


def make_task(name: TaskName, size: Size = "small", modes: int = 6) -> Task:
    """Returns a task at one of the two sizes.

    Args:
      name: what to train.
      size: "full" is the published one, "small" has a fifth of its widths.
      modes: futures per agent of GameFormer.

    Raises:
      ValueError: unknown name.
    """
    width = WIDTHS[size]
    encoder = EncoderConfig(width=width)
    if name == "dtpp":
        return dtpp_task(DTPPConfig(encoder=encoder))
    if name == "dipp":
        return dipp_task(DIPPConfig(width=width))
    config = GameFormerConfig(encoder=encoder, levels=3, modes=modes)
    if name == "gameformer":
        return gameformer_task(config)
    if name == "gameformer-0":
        return replace(gameformer_task(replace(config, levels=0)), name="gameformer-0")
    if name == "gameformer-dipp":
        return refined_task(config)
    raise ValueError(f"model {name!r} is unknown; choose one of {', '.join(get_args(TaskName))}")


def gameformer_task(config: GameFormerConfig) -> Task:
    """GameFormer as its script trains it."""

    def loss(params: Params, batch: TrainSample, key: jax.Array | None, planner: bool):
        del planner
        output = gameformer.apply(params, config, batch.features, key=key)
        return _gameformer_loss(output, batch)

    def metrics(params: Params, batch: TrainSample) -> Parts:
        return _gameformer_metrics(gameformer.apply(params, config, batch.features), batch)

    return Task(
        name="gameformer",
        model="gameformer",
        config=config,
        recipe=GAMEFORMER_RECIPE,
        sample=SampleConfig("gameformer", count=config.neighbors, steps=config.steps),
        init=partial(gameformer.init, config),
        loss=loss,
        metrics=metrics,
        optimizer=lambda rate, params: adamw(rate, params, CLIP_NORM),
    )


def refined_task(config: GameFormerConfig, refiner: DIPPRefinerConfig | None = None) -> Task:
    """GameFormer with DIPP's planner behind it, trained through two unrolled steps of the solve.

    Neither the paper nor public code fixes this training. Chosen: GameFormer's recipe and loss; as
    in DIPP, from a quarter of the training on the refined plan's loss and its costs are added. The
    solve starts at the network's plan and sees the best-scored future of each neighbour, as at
    test; the futures learn from their own loss alone. The costs' weights are a softmax of logits
    that start equal.
    """
    refiner = refiner or DIPPRefinerConfig()
    solved = replace(refiner, solver=TRAIN_SOLVER)

    def refine(params: Params, output: GameFormerOutput, batch: TrainSample) -> RefinedPlan:
        weights = cost_weights(params["costs"]["logits"])
        one = lambda plan, futures, ego, neighbors, path, info: refine_plan(
            plan,
            futures,
            ego,
            neighbors,
            CenterPath(path=path, info=info, overflow=False),
            weights,
            solved,
            VehicleParams(),
        )
        return jax.vmap(one)(
            output.plan,
            # Through the solve they would learn to be far from the ego, not to be right.
            jax.lax.stop_gradient(_best_scored(output)),
            batch.features.ego_past,
            batch.features.neighbors_past,
            batch.path,
            batch.info,
        )

    def loss(params: Params, batch: TrainSample, key: jax.Array | None, planner: bool):
        output = gameformer.apply(params["network"], config, batch.features, key=key)
        total, parts = _gameformer_loss(output, batch)
        if planner:
            refined = refine(params, output, batch)
            plan = _plan_loss(refined.poses, batch.ego)
            cost = 2 * jnp.mean(refined.objective) / solved.problem.num_residuals
            total = total + plan + PLAN_COST_FACTOR * cost
        else:
            plan = cost = jnp.zeros_like(total)
        return total, {**parts, "refined": plan, "cost": cost}

    def metrics(params: Params, batch: TrainSample) -> Parts:
        output = gameformer.apply(params["network"], config, batch.features)
        offset = refine(params, output, batch).poses[..., :2] - batch.ego[..., :2]
        missed = jnp.linalg.norm(offset, axis=-1)
        refined = {"refinedADE": jnp.mean(missed, axis=-1), "refinedFDE": missed[:, -1]}
        return {**_gameformer_metrics(output, batch), **refined}

    task = gameformer_task(config)
    return replace(
        task,
        name="gameformer-dipp",
        recipe=replace(GAMEFORMER_RECIPE, planner_after=5),
        sample=replace(task.sample, inputs="gameformer-dipp", refiner=refiner),
        init=lambda key: {
            "network": gameformer.init(config, key),
            "costs": {"logits": jnp.zeros(len(WEIGHT_SCALE) + len(FIXED_WEIGHTS), jnp.float32)},
        },
        loss=loss,
        metrics=metrics,
        network=lambda params: params["network"],
        learnt=lambda params: {
            "cost_weights": [float(w) for w in cost_weights(params["costs"]["logits"])]
        },
    )


def cost_weights(logits: jax.Array) -> jax.Array:
    """Returns `[9]` weights of DIPP's costs: shares of a softmax, scaled, and two fixed ones."""
    shares = jax.nn.softmax(logits)[: len(WEIGHT_SCALE)]
    learned = shares * jnp.asarray(WEIGHT_SCALE, logits.dtype)
    return jnp.concatenate([learned, jnp.asarray(FIXED_WEIGHTS, logits.dtype)])


def dtpp_task(config: DTPPConfig) -> Task:
    """DTPP: predictions under the branch nearest to the expert, and costs by inverse RL."""

    def stages(params: Params, batch: TrainSample, key: jax.Array | None):
        keys = [None] * 3 if key is None else list(jax.random.split(key, 3))
        encoding = dtpp.encode(params, config, batch.features, keys[0])
        return tuple(
            dtpp.decode(params, config, encoding, batch.features, branches, steps, dropout)
            for branches, steps, dropout in (
                (batch.first, FIRST_STEPS, keys[1]),
                (batch.second, batch.second.shape[-2], keys[2]),
            )
        )

    def loss(params: Params, batch: TrainSample, key: jax.Array | None, planner: bool):
        del planner
        first, second = stages(params, batch, key)
        found = dtpp_losses.loss(first, second, batch.first, batch.second, _dtpp_targets(batch))
        return found.total, {
            "prediction": found.first.prediction,
            "choice": found.first.choice,
            "prediction_2": found.second.prediction,
            "choice_2": found.second.choice,
        }

    def metrics(params: Params, batch: TrainSample) -> Parts:
        _, second = stages(params, batch, None)
        found = jax.vmap(dtpp_losses.metrics)(second, batch.second, _dtpp_targets(batch))
        return {
            "minADE": found.prediction_ade,
            "minFDE": found.prediction_fde,
            "planADE": found.plan_ade,
            "planFDE": found.plan_fde,
        }

    features = FeatureConfig(radius=MAP_RADIUS, rearmost=None)
    sample = SampleConfig("dtpp", features, count=config.neighbors)
    return Task(
        name="dtpp",
        model="dtpp",
        config=config,
        recipe=DTPP_RECIPE,
        sample=replace(sample, planner=replace(sample.planner, network=config)),
        init=partial(dtpp.init, config),
        loss=loss,
        metrics=metrics,
        optimizer=lambda rate, params: dtpp_losses.optimizer(rate),
    )


def dipp_task(config: DIPPConfig, planner_config: DIPPPlannerConfig | None = None) -> Task:
    """DIPP: futures alone for a quarter of the training, then with two unrolled planner steps."""
    problem = planner_config or DIPPPlannerConfig(horizon=config.horizon)

    def loss(params: Params, batch: TrainSample, key: jax.Array | None, planner: bool):
        output = dipp.apply(params, config, batch.features, key)
        ego = batch.features.ego[:, -1]
        truth = _joint(batch)
        if planner:
            neighbors = batch.features.neighbors[:, :, -1]
            line = _reference_line(batch)
            found = dipp_losses.planner_loss(output, ego, neighbors, line, truth, problem)
            parts = {
                "futures": found.futures.total,
                "refined": found.plan,
                "cost": found.plan_cost,
            }
            return found.total, parts
        driven = jax.vmap(dipp_losses.plan_trajectories)(output.controls, ego)
        total = dipp_losses.future_loss(driven, output.predictions, output.scores, truth).total
        nothing = jnp.zeros_like(total)
        return total, {"futures": total, "refined": nothing, "cost": nothing}

    def metrics(params: Params, batch: TrainSample) -> Parts:
        output = dipp.apply(params, config, batch.features)
        driven = jax.vmap(dipp_losses.plan_trajectories)(output.controls, batch.features.ego[:, -1])
        plan = dipp_losses.pick(driven, jnp.argmax(output.scores, axis=-1))

        def one(plan, predictions, truth):
            modes = jax.vmap(
                lambda mode: dipp_losses.motion_metrics(plan[None], mode[None], truth[None])
            )(predictions)
            # The best joint future; the plan is the same in all rows.
            return jnp.concatenate([jnp.min(modes[:, 2:], axis=0), modes[0, :2]])

        found = jax.vmap(one)(plan, output.predictions, _joint(batch))
        return {name: found[:, i] for i, name in enumerate(_LABELS)}

    return Task(
        name="dipp",
        model="dipp",
        config=config,
        recipe=DIPP_RECIPE,
        sample=SampleConfig("dipp", steps=config.horizon),
        init=partial(dipp.init, config),
        loss=loss,
        metrics=metrics,
        optimizer=lambda rate, params: optax.chain(clip_by_norm(CLIP_NORM), optax.adam(rate)),
    )


def _plan_loss(plan: jax.Array, truth: jax.Array) -> jax.Array:
    huber = lambda a, b: jnp.mean(optax.losses.huber_loss(a, b))
    return huber(plan, truth) + huber(plan[:, -1], truth[:, -1])


def _gameformer_loss(output: GameFormerOutput, batch: TrainSample) -> tuple[jax.Array, Parts]:
    targets = Targets(ego=batch.ego, neighbors=batch.neighbors)
    found = gameformer_losses.losses(output, targets)
    return found.total, {"levels": found.level_k, "plan": found.planning}


def _gameformer_metrics(output: GameFormerOutput, batch: TrainSample) -> Parts:
    targets = Targets(ego=batch.ego, neighbors=batch.neighbors)
    found = jax.vmap(gameformer_losses.metrics)(output, targets)
    values = (found.prediction_ade, found.prediction_fde, found.plan_ade, found.plan_fde)
    return dict(zip(_LABELS, values, strict=True))


def _best_scored(output: GameFormerOutput) -> jax.Array:
    """Positions `[B, A, T, 2]` of the neighbours' best-scored modes of the last level."""
    last = output.levels[-1]
    mode = jnp.argmax(last.scores[:, 1:], axis=-1)[..., None, None, None]
    return jnp.take_along_axis(last.gaussians[:, 1:, ..., :2], mode, axis=2)[:, :, 0]


def _dtpp_targets(batch: TrainSample) -> DTPPTargets:
    return DTPPTargets(ego_future=batch.ego, neighbors_future=batch.neighbors)


def _joint(batch: TrainSample) -> jax.Array:
    return jnp.concatenate([batch.ego[:, None], batch.neighbors], axis=1)


def _reference_line(batch: TrainSample) -> jax.Array:
    """`[B, P, 5]`; no cost reads the curvature."""
    info = batch.info[..., None]
    return jnp.concatenate([batch.path, jnp.zeros_like(info), info], axis=-1)
