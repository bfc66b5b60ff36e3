"""A drive of PDM-Closed or SPDM with every choice recorded, as a pure function of one scene.

The file is apart from the rest because a stored program is found by the source that it was made
from.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_experiments.simulate_scene import Switches
from spdm_jax import planner
from spdm_jax.config import DT, PlannerConfig, PlannerParams
from spdm_jax.decision import cast_params
from spdm_jax.metrics import Expert, closed_loop
from spdm_jax.simulation.controller import Plan
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.simulation.loop import SimulationParams, simulate
from spdm_jax.types import Array, Scenario


class NotedPlan(Plan):
    """A plan and how it was chosen among P proposals.

    Attributes:
      scores: `[P]` total scores.
      best: `[]` int32, the proposal chosen.
      brake: `[]` bool, the emergency brake was chosen instead.
    """

    scores: Array
    best: Array
    brake: Array


class Trace(struct.PyTreeNode, kw_only=True):
    """What one drive of T samples leaves.

    Attributes:
      valid: `[T]` bool, real samples.
      time: `[T]` s.
      x, y: `[T]` of the ego's rear axle, local frame, m.
      scores, best, brake: of `NotedPlan`, `[T, ...]`.
      score: `[]` final score of the drive.
    """

    valid: Array
    time: Array
    x: Array
    y: Array
    scores: Array
    best: Array
    brake: Array
    score: Array


def noting_driver(name: str, params: PlannerParams, config: PlannerConfig) -> Driver:
    """PDM-Closed or SPDM as `planner_driver` runs them, with plans that are `NotedPlan`."""

    def step(scene, given, time, state):
        result, state = planner.step(scene, given, state, params, config)
        chosen = result.trajectory
        plan = NotedPlan(
            x=chosen.x,
            y=chosen.y,
            heading=chosen.heading,
            time=jnp.arange(chosen.x.shape[0]).astype(chosen.x.dtype) * DT,
            start=time,
            scores=result.scores.total,
            best=result.best,
            brake=result.emergency_brake,
        )
        return Driven(plan, state, result.overflow)

    return Driver(name, lambda scene: planner.init(scene, params, config), step)


def trace_scene(scene: Scenario, mine: None, shared: PlannerParams, static: Switches) -> Trace:
    """Simulates one scenario in closed loop.

    Args:
      scene: one scenario on the device, of `static.num_iterations` iterations.
      mine: nothing.
      shared: traced settings of the planner.
      static: static settings, `simulation.record_plans` set.
    """
    params = cast_params(shared, scene.ego.x.dtype)
    driver = noting_driver(static.planner, params, static.config)
    run = simulate(scene, driver, SimulationParams(), static.simulation)
    history, plans = run.history, run.plans
    assert isinstance(plans, NotedPlan)
    at = scene.num_history + jnp.arange(static.num_iterations)
    pick = lambda values: values[jnp.minimum(at, values.shape[0] - 1)]
    expert = Expert(jax.tree.map(pick, scene.ego), pick(scene.ego_valid))
    return Trace(
        valid=history.valid,
        time=history.time,
        x=history.ego.x,
        y=history.ego.y,
        scores=plans.scores,
        best=plans.best,
        brake=plans.brake,
        score=closed_loop(history, scene.map, expert).final,
    )
