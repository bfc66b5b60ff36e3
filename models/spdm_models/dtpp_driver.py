"""DTPP in the closed loop."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import React
from spdm_jax.planner import StepInput
from spdm_jax.simulation.drivers import Driver
from spdm_jax.types import ProposalSet, Scenario

from .dtpp_planner import DTPPPlannerConfig, plan, scene_paths
from .dtpp_tree import TreePlan
from .params import Params
from .plan_frame import proposals_in_scene
from .predictions import Prediction, futures_of
from .scene_features import FeatureConfig, History
from .sight import Planned, look, seeing_driver

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

    def think(scene: Scenario, given: StepInput, state: History, react: React | None) -> Planned:
        tree, history, overflow = _search(params, scene, given, state, config, react)
        return jnp.stack([tree.x, tree.y, tree.heading], axis=-1), history, overflow

    return seeing_driver("DTPP", think, reacting=config.prediction == "perfect")


def dtpp_proposals(
    params: Params,
    scene: Scenario,
    given: StepInput,
    history: History,
    config: DTPPDriverConfig,
    react: React | None = None,
) -> tuple[ProposalSet, History, jax.Array]:
    """The branches of the second stage as proposals for the PDM scorer.

    Args:
      params: weights of the network, which decides what is expanded.
      scene: one scenario.
      given: ego and objects of this step.
      history: up to the step before.
      config: static settings.
      react: how traffic would react, in traffic that does.

    Returns:
      Proposals `[N, 41]` in the scene's frame, the history for the next step, and whether a fixed
      buffer was too small, `[]` bool.
    """
    tree, following, overflow = _search(params, scene, given, history, config, react)
    branches = tree.second
    proposals = proposals_in_scene(branches.states[..., :3], given.ego, branches.valid)
    return proposals, following, overflow


def _search(
    params: Params,
    scene: Scenario,
    given: StepInput,
    before: History,
    config: DTPPDriverConfig,
    react: React | None,
) -> tuple[TreePlan, History, jax.Array]:
    planner, ego = config.planner, given.ego
    sight = look(scene, given, before, config.features)
    found = scene_paths(scene.map, scene.route, ego, given.observation, planner)
    count = planner.network.neighbors
    steps = planner.tree.first_steps + planner.tree.second_steps
    beside = futures_of(config.prediction, scene, given, sight.neighbors, count, steps, react)
    tree = plan(
        params,
        sight.features,
        found.paths,
        ego.vx,
        ego.ax,
        found.limit,
        planner,
        futures=beside,
    )
    return tree, sight.history, found.overflow
