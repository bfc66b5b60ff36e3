"""GameFormer as a planner: the network's plan, or a refinement of it, beside chosen predictions.

The paper's "GameFormer" executes the network's plan; its "GameFormer + DIPP" (N_l = 3) and "DIPP"
(N_l = 0) refine it by DIPP's problem; GameFormer's public planner refines its speeds along a
reference path.
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import React
from spdm_jax.config import PlannerParams
from spdm_jax.geometry import ego_box
from spdm_jax.planner import StepInput
from spdm_jax.proposals.lanes import drivable_lanes, starting_lane
from spdm_jax.types import Scenario

from . import gameformer
from .dipp_on_gameformer import (
    CenterPath,
    DIPPRefinerConfig,
    center_path,
    refine_plan,
    with_headings,
)
from .gameformer import GameFormerConfig, GameFormerOutput
from .gameformer_reference import scene_reference
from .gameformer_refine import occupancy, refine
from .params import Params
from .predictions import Prediction, futures_of
from .route_lines import RouteLineConfig
from .scene_features import FeatureConfig
from .sight import Sight

Refinement = Literal["none", "path", "dipp"]


@dataclass(frozen=True)
class GameFormerPlannerConfig:
    """Static settings.

    Attributes:
      network: sizes of the network.
      features: what it sees.
      prediction: what takes the place of the neighbours' predictions, after every decoder and
        before a refinement.
      refinement: "path" is the public planner's, "dipp" DIPP's problem.
      dipp: of that problem.
      lines: candidate lanes of "path".
    """

    network: GameFormerConfig = field(default_factory=GameFormerConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    prediction: Prediction = "learned"
    refinement: Refinement = "none"
    dipp: DIPPRefinerConfig = field(default_factory=DIPPRefinerConfig)
    lines: RouteLineConfig = field(default_factory=lambda: RouteLineConfig(min_length=24.0))


class Predicted(NamedTuple):
    """What the network says, and the futures that plans are refined beside.

    Attributes:
      output: of the network.
      futures: `[A, T, 2]` of the neighbours, ego frame.
    """

    output: GameFormerOutput
    futures: jax.Array


class Finished(NamedTuple):
    """A plan of the ego.

    Attributes:
      poses: `[T, 3]` x, y, heading in the ego frame, first at 0.1 s.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    poses: jax.Array
    overflow: jax.Array


def predict(
    params: Params,
    scene: Scenario,
    given: StepInput,
    sight: Sight,
    config: GameFormerPlannerConfig,
    react: React | None = None,
) -> Predicted:
    """Runs the network beside the predictions that the config asks for.

    Chosen: where traffic reacts, perfect predictions are the reactions to the plan that the network
    makes beside its own; the network is asked again beside them.

    Args:
      params: weights of the network.
      scene: one scenario.
      given: ego and objects of this step.
      sight: of the same step.
      config: static settings.
      react: how traffic would react, in traffic that does.
    """
    network, count = config.network, config.network.neighbors
    run = lambda neighbors: gameformer.apply(params, network, sight.features, neighbors)
    steps, kind = network.steps, config.prediction
    beside = futures_of(kind, scene, given, sight.neighbors, count, steps, react)
    if beside is None:
        output = run(None)
        last = output.levels[-1]
        best = jnp.argmax(last.scores[1:], axis=1)[:, None, None, None]
        futures = jnp.take_along_axis(last.gaussians[1:, ..., :2], best, axis=1)[:, 0]
        return Predicted(output, futures)
    plan = jnp.zeros((steps, 3), given.ego.x.dtype)
    if kind == "perfect" and react is not None:
        plan = run(None).plan
    futures = beside(plan[None])[0, ..., :2]
    return Predicted(run(futures), futures)


def finish(
    plan: jax.Array,
    predicted: Predicted,
    cost_weights: jax.Array,
    scene: Scenario,
    given: StepInput,
    sight: Sight,
    config: GameFormerPlannerConfig,
) -> Finished:
    """Refines a plan as the config asks; `vmap` over `plan` refines several.

    Off the route, where there is no line to follow, it stays as it is.

    Args:
      plan: `[T, 3]` of the ego frame, of the network.
      predicted: of `predict`.
      cost_weights: `[9]` of DIPP's problem.
      scene: one scenario.
      given: ego and objects of this step.
      sight: of the same step.
      config: static settings.
    """
    if config.refinement == "none":
        return Finished(plan, jnp.bool_(False))
    if config.refinement == "dipp":
        center, found = own_center_path(scene, given, config.dipp)
        refined = refine_plan(
            plan,
            predicted.futures,
            sight.features.ego_past,
            sight.features.neighbors_past,
            center,
            cost_weights,
            config.dipp,
            PlannerParams().vehicle,
        )
        return Finished(jnp.where(found, refined.poses, plan), found & center.overflow)
    reference, overflow = scene_reference(scene, given, config.lines)
    scores = predicted.output.levels[-1].scores[1:]
    futures = jnp.broadcast_to(
        predicted.futures[:, None], (*scores.shape, *predicted.futures.shape[1:])
    )
    now = sight.features.neighbors_past[: config.network.neighbors, -1]
    cells = occupancy(futures, scores, now, reference)
    poses = refine(plan, given.ego.vx, given.ego.ax, reference, cells).poses
    return Finished(poses, overflow)


def own_center_path(
    scene: Scenario, given: StepInput, config: DIPPRefinerConfig
) -> tuple[CenterPath, jax.Array]:
    """Returns the centre line from the lane that the ego is on, and whether the route has one."""
    params, ego = PlannerParams(), given.ego
    box = ego_box(ego, params.vehicle)
    lanes, _ = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    lane = starting_lane(scene.map, scene.route, lanes, ego, params.vehicle)
    center = center_path(scene.map, scene.route, lane, given.observation.lights, ego, config)
    return center, lane >= 0


def ego_modes(predicted: Predicted) -> jax.Array:
    """Returns the last level's M futures of the ego `[M, T, 3]`, headings by their steps."""
    return jax.vmap(with_headings)(predicted.output.levels[-1].gaussians[0, ..., :2])
