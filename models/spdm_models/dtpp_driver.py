"""DTPP in the closed loop."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import React
from spdm_jax.planner import StepInput
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.types import Scenario

from .dtpp_planner import DTPPPlannerConfig, plan, scene_paths
from .params import Params
from .plan_frame import plan_in_scene
from .predictions import Prediction, futures_of
from .scene_features import FeatureConfig, History, recorded_history
from .sight import look

MAP_RADIUS = 80.0
"""How far DTPP sees the map, m."""


@dataclass(frozen=True)
class DTPPDriverConfig:
    """Static settings.

    Attributes:
      planner: network and tree.
      features: what the network sees.
      prediction: what the scores take for the neighbours' futures, in both stages. Literal zeros
        for "none" put every neighbour at the ego's start.
    """

    planner: DTPPPlannerConfig = field(default_factory=DTPPPlannerConfig)
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(radius=MAP_RADIUS))
    prediction: Prediction = "learned"


def dtpp_driver(params: Params, config: DTPPDriverConfig) -> Driver:
    """DTPP; the state is what was seen in the last 2 s, so it must be asked at every step.

    Where the tree finds no branch of 8 s, the plan is to stand where the ego is, as in the
    reference. Perfect predictions in reactive traffic are how the agents would react to each
    branch.

    Args:
      params: weights of the network; make the driver inside `jit`, so that they are no constants
        of the program.
      config: static settings.
    """
    count = config.planner.network.neighbors

    tree = config.planner.tree
    steps = tree.first_steps + tree.second_steps

    def init(scene: Scenario) -> History:
        return recorded_history(scene, -1)

    def step(
        scene: Scenario,
        given: StepInput,
        time: jax.Array,
        state: History,
        react: React | None = None,
    ) -> Driven:
        ego = given.ego
        sight = look(scene, given, state, config.features)
        found = scene_paths(scene.map, scene.route, ego, given.observation, config.planner)
        beside = futures_of(config.prediction, scene, given, sight.neighbors, count, steps, react)
        chosen = plan(
            params,
            sight.features,
            found.paths,
            ego.vx,
            ego.ax,
            found.limit,
            config.planner,
            futures=beside,
        )
        poses = jnp.stack([chosen.x, chosen.y, chosen.heading], axis=-1)
        return Driven(plan_in_scene(poses, ego, time), sight.history, found.overflow)

    return Driver("DTPP", init, step, step if config.prediction == "perfect" else None)
