"""What a simulation computes in one scene, as a pure function: drive, judge, keep what rows need.

The file is apart from the rest because a stored program is found by the source that it was made
from.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.config import PlannerConfig
from spdm_jax.decision import cast_params
from spdm_jax.interplan.score import expert_route
from spdm_jax.metrics import (
    ClosedLoopMetrics,
    Expert,
    ExpertPoses,
    OpenLoopMetrics,
    closed_loop,
    comparison_indices,
    open_loop,
)
from spdm_jax.metrics.routes import CornerLanes
from spdm_jax.simulation.controller import Plan, pose_at
from spdm_jax.simulation.drivers import (
    Driver,
    constant_velocity_driver,
    log_replay_driver,
    planner_driver,
)
from spdm_jax.simulation.history import History
from spdm_jax.simulation.idm_driver import idm_driver
from spdm_jax.simulation.loop import SimulationConfig, SimulationParams, simulate
from spdm_jax.simulation.mobil_driver import mobil_driver
from spdm_jax.simulation.script import Script
from spdm_jax.types import Array, Scenario
from spdm_models import drivers as learned_drivers
from spdm_models.drivers import LearnedPlanner

UNREAD = ("map.crosswalks", "map.walkways")
"""Layers that neither planners nor agents nor metrics read; learned planners see crosswalks."""
UNREAD_BY_LEARNED = ("map.walkways",)
SHOWN_SECONDS = np.arange(17) * 0.5
"""Times of a plan's recorded poses, s after its start."""


@dataclass(frozen=True)
class Switches:
    """What a new value of compiles anew.

    Attributes:
      planner: name on the command line.
      config: of the planner; of the others but PDM-Closed and SPDM only `max_path_points` counts.
      simulation: of the loop; its `ego` is "log" in open loop.
      num_iterations: N of every scenario.
      record: also return the run.
      learned: of a learned planner; None for the others.
    """

    planner: str
    config: PlannerConfig
    simulation: SimulationConfig
    num_iterations: int
    record: bool = False
    learned: LearnedPlanner | None = None


class Kept(struct.PyTreeNode, kw_only=True):
    """A run as it is written, T samples.

    Attributes:
      history: of the run.
      plans: `[T, 17, 3]` x, y, heading every 0.5 s, local frame, or None.
    """

    history: History
    plans: Array | None


class Result(struct.PyTreeNode, kw_only=True):
    """One finished run.

    Attributes:
      metrics: closed-loop or open-loop metrics; routes are left out, but the ego's of a scripted
        run.
      expert_lanes: `[T, L]` bool, `expert_route` of a scripted run, else None.
      time: `[T]` s of the samples.
      samples: `[]` int32, how many of them are real.
      failed: `[]` bool, the planner returned a number that is not finite.
      overflow: `[]` bool, a fixed buffer was too small.
      short: `[]` bool, the record ends before the last plan of an open-loop run does.
      skipped_agents: `[]` int32, reactive agents that once could not move.
      kept: the run, or None.
    """

    metrics: ClosedLoopMetrics | OpenLoopMetrics
    expert_lanes: Array | None
    time: Array
    samples: Array
    failed: Array
    overflow: Array
    short: Array
    skipped_agents: Array
    kept: Kept | None


def make_driver(shared: Any, static: Switches, dtype: Any) -> Driver:
    """Returns a planner by its name on the command line; to be called inside `jit`.

    Args:
      shared: traced settings of PDM-Closed and SPDM, or a learned planner's weights.
      static: static settings.
      dtype: of the scene.
    """
    if static.learned is not None:
        return learned_drivers.make_driver(static.learned, shared)
    if static.planner in ("pdm-closed", "spdm"):
        return planner_driver(static.planner, cast_params(shared, dtype), static.config)
    if static.planner == "idm":
        return idm_driver(max_path_points=static.config.max_path_points)
    if static.planner == "idm-mobil":
        return mobil_driver(max_path_points=static.config.max_path_points)
    if static.planner == "constant-velocity":
        return constant_velocity_driver()
    if static.planner == "log-replay":
        return log_replay_driver()
    raise ValueError(f"no planner {static.planner!r}")


def run_scene(scene: Scenario, mine: Script | None, shared: Any, static: Switches) -> Result:
    """Simulates one scenario and judges the run.

    Args:
      scene: one scenario on the device, of `static.num_iterations` iterations.
      mine: script of an interPlan scenario, else None.
      shared: traced settings of PDM-Closed and SPDM, or a learned planner's weights; the other
        planners do not read it.
      static: static settings.
    """
    driver = make_driver(shared, static, scene.ego.x.dtype)
    run = simulate(scene, driver, SimulationParams(), static.simulation, script=mine)
    expert_lanes = None
    if static.simulation.ego == "log":
        metrics, short = _open_loop(scene, run.plans, static.num_iterations)
    else:
        expert, short = _expert(scene, static.num_iterations), jnp.bool_(False)
        metrics = _closed_loop(scene, run.history, expert, keep_route=mine is not None)
        if mine is not None:
            expert_lanes = expert_route(scene.map, expert, run.history.valid)
    kept = None
    if static.record:
        kept = Kept(history=run.history, plans=_shown(run.plans))
    return Result(
        metrics=metrics,
        expert_lanes=expert_lanes,
        time=run.history.time,
        samples=jnp.sum(run.history.valid, dtype=jnp.int32),
        failed=run.failed,
        overflow=run.overflow,
        short=short,
        skipped_agents=run.skipped_agents,
        kept=kept,
    )


def _expert(scene: Scenario, num_iterations: int) -> Expert:
    at = scene.num_history + jnp.arange(num_iterations)
    pick = lambda values: values[jnp.minimum(at, values.shape[0] - 1)]
    return Expert(jax.tree.map(pick, scene.ego), pick(scene.ego_valid))


def _closed_loop(
    scene: Scenario, history: History, expert: Expert, *, keep_route: bool
) -> ClosedLoopMetrics:
    metrics = closed_loop(history, scene.map, expert)
    # Rows tell nothing of the routes, which are the largest part by far.
    none = jnp.zeros((0,), bool)
    corners = CornerLanes(*(none for _ in CornerLanes._fields))
    route = metrics.route if keep_route else none
    return metrics.replace(route=route, expert_route=none, corners=corners)


def _open_loop(
    scene: Scenario, plans: Plan | None, num_iterations: int
) -> tuple[OpenLoopMetrics, jax.Array]:
    assert plans is not None
    samples, states = comparison_indices(num_iterations, num_iterations - 1)
    at = scene.num_history + states
    last = scene.time.shape[0] - 1
    pick = lambda values: values[jnp.minimum(at, last)]
    ego = jax.tree.map(pick, scene.ego)
    poses = ExpertPoses(ego.x, ego.y, ego.heading, pick(scene.time).astype(ego.x.dtype))
    known = jnp.all((at <= last) & pick(scene.ego_valid))
    compared = jax.tree.map(lambda leaf: leaf[samples], plans)
    return open_loop(compared, poses), ~known


def _shown(plans: Plan | None) -> jax.Array | None:
    if plans is None:
        return None
    seconds = jnp.asarray(SHOWN_SECONDS, plans.x.dtype)
    return jax.vmap(lambda plan: jnp.stack(pose_at(plan, seconds), axis=-1))(plans)
