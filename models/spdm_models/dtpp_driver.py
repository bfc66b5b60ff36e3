"""DTPP in the closed loop."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from spdm_jax.config import DT
from spdm_jax.geometry import wrap
from spdm_jax.planner import StepInput
from spdm_jax.simulation.controller import Plan
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.types import EgoState, Scenario

from .dtpp_planner import DTPPPlannerConfig, plan, scene_paths
from .dtpp_tree import TreePlan
from .params import Params
from .scene_features import (
    FeatureConfig,
    History,
    next_history,
    pick_neighbors,
    recorded_history,
    scene_features,
)

MAP_RADIUS = 80.0
"""How far DTPP sees the map, m."""


@dataclass(frozen=True)
class DTPPDriverConfig:
    """Static settings.

    Attributes:
      planner: network and tree.
      features: what the network sees.
    """

    planner: DTPPPlannerConfig = field(default_factory=DTPPPlannerConfig)
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(radius=MAP_RADIUS))


def dtpp_driver(params: Params, config: DTPPDriverConfig) -> Driver:
    """DTPP; the state is what was seen in the last 2 s, so it must be asked at every step.

    Where the tree finds no branch of 8 s, the plan is to stand where the ego is, as in the
    reference.

    Args:
      params: weights of the network; make the driver inside `jit`, so that they are no constants
        of the program.
      config: static settings.
    """

    def init(scene: Scenario) -> History:
        return recorded_history(scene, -1)

    def step(scene: Scenario, given: StepInput, time: jax.Array, state: History) -> Driven:
        ego, seen = given.ego, given.observation
        history = next_history(state, ego, seen)
        neighbors = pick_neighbors(history, config.features)
        features = scene_features(
            scene.map, scene.route, seen.lights, history, neighbors, config.features
        )
        found = scene_paths(scene.map, scene.route, ego, seen, config.planner)
        tree = plan(params, features, found.paths, ego.vx, ego.ax, found.limit, config.planner)
        return Driven(_in_scene(tree, ego, time), history, found.overflow)

    return Driver("DTPP", init, step)


def _in_scene(tree: TreePlan, ego: EgoState, time: jax.Array) -> Plan:
    """The chosen branch in the scene's frame, the current pose first."""
    from_now = lambda values: jnp.concatenate([jnp.zeros_like(values[:1]), values])
    x, y, heading = from_now(tree.x), from_now(tree.y), from_now(tree.heading)
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    return Plan(
        x=ego.x + cos * x - sin * y,
        y=ego.y + sin * x + cos * y,
        heading=wrap(ego.heading + heading),
        time=jnp.arange(x.shape[0], dtype=x.dtype) * DT,
        start=time,
    )
