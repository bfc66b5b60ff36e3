"""DIPP with its own network in the closed loop."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import React
from spdm_jax.config import NUM_TRAJECTORY_STATES, PlannerParams
from spdm_jax.planner import StepInput
from spdm_jax.simulation.drivers import Driver
from spdm_jax.types import ProposalSet, Scenario

from . import dipp
from .dipp import DIPPConfig
from .dipp_features import DIPPFeatureConfig, dipp_features
from .dipp_on_gameformer import DIPPRefinerConfig
from .dipp_planner import TEST_SOLVER, DIPPPlannerConfig, bicycle, problem_from_features, solve
from .gameformer_planner import own_center_path
from .params import Params
from .plan_frame import continued, proposals_in_scene
from .predictions import Prediction, futures_of
from .scene_features import FeatureConfig, History
from .sight import Planned, look, seeing_driver


@dataclass(frozen=True)
class DIPPDriverConfig:
    """Static settings.

    Attributes:
      network: sizes of the network.
      features: whom and what is seen.
      inputs: of the network, made from that.
      refiner: problem, solver and reference path.
      prediction: what the problem takes for the neighbours' futures.
    """

    network: DIPPConfig = field(default_factory=DIPPConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    inputs: DIPPFeatureConfig = field(default_factory=DIPPFeatureConfig)
    refiner: DIPPRefinerConfig = field(
        default_factory=lambda: DIPPRefinerConfig(problem=DIPPPlannerConfig(), solver=TEST_SOLVER)
    )
    prediction: Prediction = "learned"

    def __post_init__(self):
        if self.network.horizon != self.refiner.problem.horizon:
            raise ValueError(
                f"the network's horizon is {self.network.horizon} steps, the problem's "
                f"{self.refiner.problem.horizon}"
            )


def dipp_driver(params: Params, config: DIPPDriverConfig) -> Driver:
    """DIPP; the state is what was seen in the last 2 s, so it must be asked at every step.

    The best-scored joint future gives the first plan and the predictions. The plan ends after 5 s;
    chosen: it goes straight on from there at its last speed. Off the route, where there is no line
    to follow, the network's controls are driven as they are. In reactive traffic perfect
    predictions are the reactions to the network's plan.

    Args:
      params: weights of the network; make the driver inside `jit`, so that they are no constants
        of the program.
      config: static settings.
    """

    def think(scene: Scenario, given: StepInput, state: History, react: React | None) -> Planned:
        modes, best, history, overflow = _refine(params, scene, given, state, config, react)
        return continued(modes(best), NUM_TRAJECTORY_STATES - 1), history, overflow

    return seeing_driver("DIPP", think, reacting=config.prediction == "perfect")


def dipp_proposals(
    params: Params,
    scene: Scenario,
    given: StepInput,
    history: History,
    config: DIPPDriverConfig,
    react: React | None = None,
) -> tuple[ProposalSet, History, jax.Array]:
    """The network's M joint futures, each refined, as proposals for the PDM scorer.

    Args:
      params: weights of the network.
      scene: one scenario.
      given: ego and objects of this step.
      history: up to the step before.
      config: static settings.
      react: how traffic would react, in traffic that does.

    Returns:
      Proposals `[M, 41]` in the scene's frame, the history for the next step, and whether a fixed
      buffer was too small, `[]` bool.
    """
    modes, _, following, overflow = _refine(params, scene, given, history, config, react)
    poses = jax.vmap(modes)(jnp.arange(config.network.modes))
    return proposals_in_scene(poses, given.ego), following, overflow


def _refine(
    params: Params,
    scene: Scenario,
    given: StepInput,
    before: History,
    config: DIPPDriverConfig,
    react: React | None,
) -> tuple[Callable[[jax.Array], jax.Array], jax.Array, History, jax.Array]:
    """Returns what refines a mode `[]` to poses `[T, 3]`, the best mode, history and overflow."""
    ego, vehicle, problem_config = given.ego, PlannerParams().vehicle, config.refiner.problem
    steps, count = problem_config.horizon, config.inputs.neighbors
    sight = look(scene, given, before, config.features)
    inputs = dipp_features(
        scene.map, given.observation.lights, ego, sight.features, vehicle, config.inputs
    )
    output = dipp.apply(params, config.network, inputs)
    beside = futures_of(config.prediction, scene, given, sight.neighbors, count, steps, react)
    center, found = own_center_path(scene, given, config.refiner)
    # The curvature column is not read.
    rows = (center.path, jnp.zeros_like(center.info)[:, None], center.info[:, None])
    ref_line = jnp.concatenate(rows, axis=-1)

    def driven(controls: jax.Array) -> jax.Array:
        zero = jnp.zeros_like(ego.x)
        speed, limit = jnp.hypot(ego.vx, ego.vy), problem_config.max_steering
        motion = bicycle(controls, zero, zero, zero, speed, max_steering=limit)
        return jnp.stack([motion.x, motion.y, motion.heading], axis=-1)

    def refined(mode: jax.Array) -> jax.Array:
        controls = output.controls[mode]
        first = driven(controls)
        futures = output.predictions[mode] if beside is None else beside(first[None])[0]
        ego_now, others = inputs.ego[-1], inputs.neighbors[:, -1]
        problem = problem_from_features(ego_now, others, futures, ref_line, output.cost_weights)
        solution = solve(controls, problem, config.refiner.solver, problem_config)
        return jnp.where(found, driven(solution.values.reshape(steps, 2)), first)

    return refined, jnp.argmax(output.scores), sight.history, found & center.overflow
