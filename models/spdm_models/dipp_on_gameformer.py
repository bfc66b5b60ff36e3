"""DIPP's planner behind GameFormer's predictions, as the SPDM paper pairs them.

GameFormer (N_l = 0 for the paper's "DIPP", 3 for "GameFormer + DIPP") predicts the neighbours and a
first plan; DIPP's problem then refines the plan, over 80 steps instead of 50. Neither the paper nor
public code fixes how they meet; what was chosen is said at each function.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.config import DT, VehicleParams
from spdm_jax.geometry import interpolate, project, wrap
from spdm_jax.proposals.lanes import sequence_path
from spdm_jax.types import Array, EgoState, LightStatus, Route, ScenarioMap

from .dipp import FIXED_WEIGHTS, WEIGHT_SCALE
from .dipp_planner import (
    PATH_NOW,
    TEST_SOLVER,
    WHEELBASE,
    DIPPPlannerConfig,
    DIPPProblem,
    bicycle,
    solve,
)
from .gauss_newton import GaussNewtonConfig
from .path_frame import PATH_STEP

NUM_POINTS = 1200
"""Points of the reference path: 20 m behind the ego, 100 m ahead."""
MIN_STEERED_SPEED = 0.5
"""Below this speed a fitted steering angle is 0, m/s: yaw over distance says nothing there."""
MIN_HEADING_STEP = 0.05
"""A shorter step of a trajectory keeps the heading of the step before it, m."""


@dataclass(frozen=True)
class DIPPRefinerConfig:
    """Static settings.

    Attributes:
      problem: horizon and steps at which agents count; DIPP's own ones and every second after them.
      solver: of the problem.
      max_path_points: room for the map's points along the centre line.
    """

    problem: DIPPPlannerConfig = field(
        default_factory=lambda: DIPPPlannerConfig(
            horizon=80, safety_steps=(0, 2, 5, 9, 14, 19, 24, 29, 39, 49, 59, 69, 79)
        )
    )
    solver: GaussNewtonConfig = TEST_SOLVER
    max_path_points: int = 2048


class CenterPath(struct.PyTreeNode, kw_only=True):
    """The line that the plan follows, in the ego frame, one point every 0.1 m.

    Attributes:
      path: `[1200, 3]` x, y, heading; row 200 lies beside the ego.
      info: `[1200]` speed limit in m/s, 0 where a light is red.
      overflow: `[]` bool, the map's points did not fit.
    """

    path: Array
    info: Array
    overflow: Array


class RefinedPlan(struct.PyTreeNode, kw_only=True):
    """A plan after the solve.

    Attributes:
      poses: `[T, 3]` x, y, heading of the rear axle in the ego frame; the first is 0.1 s ahead.
      controls: `[T, 2]` acceleration in m/s^2, steering angle in rad.
      objective: `[]` at these controls.
      first_objective: `[]` at the controls of the plan that came in.
    """

    poses: Array
    controls: Array
    objective: Array
    first_objective: Array


def even_weights(dtype=jnp.float32) -> jax.Array:
    """Returns `[9]` weights of the costs before any training: equal shares of the softmax."""
    count = len(WEIGHT_SCALE) + len(FIXED_WEIGHTS)
    learned = jnp.asarray(WEIGHT_SCALE, dtype) / count
    return jnp.concatenate([learned, jnp.asarray(FIXED_WEIGHTS, dtype)])


def center_path(
    scene: ScenarioMap,
    route: Route,
    lane: jax.Array,
    lights: jax.Array,
    ego: EgoState,
    config: DIPPRefinerConfig,
    unknown_limit: float = 15.0,
) -> CenterPath:
    """Samples the centre line from a lane on, as the reference path.

    Chosen: the line goes on straight before its start and stays at its end; each lane has its own
    limit; a connector with a red light is 0. Crosswalks, which DIPP marks with 1, change no cost.

    Args:
      scene: the map.
      route: the corrected route.
      lane: `[]` int32 lane that the ego is on (`starting_lane`).
      lights: `[L]` `LightStatus` of this step.
      ego: current state, scalars.
      config: static settings.
      unknown_limit: where the map knows no limit, m/s.
    """
    lanes = scene.lanes
    slot = route.slot_of_lane[jnp.maximum(lane, 0)]
    sequence = route.centerline_lanes[jnp.maximum(slot, 0)]
    line, overflow = sequence_path(lanes.centerline, sequence, config.max_path_points)
    now = project(line, ego.x, ego.y)
    arc = now + PATH_STEP * (jnp.arange(NUM_POINTS) - PATH_NOW).astype(ego.x.dtype)
    x, y, heading = interpolate(line, arc)
    before = jnp.minimum(arc, 0)
    x, y = x + before * jnp.cos(heading), y + before * jnp.sin(heading)
    length = jnp.where(sequence >= 0, lanes.length[sequence], 0)
    end = jnp.cumsum(length)
    part = jnp.minimum(jnp.sum(arc[:, None] >= end, axis=1), sequence.shape[0] - 1)
    # Beyond the last lane its values go on.
    part = jnp.minimum(part, jnp.maximum(jnp.sum(sequence >= 0) - 1, 0))
    on = sequence[part]
    limit = lanes.speed_limit[on]
    limit = jnp.where(jnp.isnan(limit), unknown_limit, limit).astype(ego.x.dtype)
    info = jnp.where(lights[on] == LightStatus.RED, 0, limit)
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    dx, dy = x - ego.x, y - ego.y
    local = (cos * dx + sin * dy, cos * dy - sin * dx, wrap(heading - ego.heading))
    return CenterPath(path=jnp.stack(local, axis=-1), info=info, overflow=overflow)


def with_headings(xy: jax.Array) -> jax.Array:
    """Adds headings to a trajectory by its steps, from a start at the origin that looks along +x.

    Args:
      xy: `[T, 2]` m, ego frame.

    Returns:
      `[T, 3]`; a step shorter than 5 cm keeps the heading before it.
    """
    step = jnp.diff(xy, axis=0, prepend=jnp.zeros_like(xy[:1]))
    moved = jnp.sum(step**2, axis=1) > MIN_HEADING_STEP**2
    angle = jnp.arctan2(step[:, 1], step[:, 0])
    index = jnp.arange(xy.shape[0])
    latest = jax.lax.cummax(jnp.where(moved, index, -1))
    heading = jnp.where(latest >= 0, angle[jnp.maximum(latest, 0)], 0)
    return jnp.concatenate([xy, heading[:, None]], axis=1)


def fit_controls(poses: jax.Array, speed: jax.Array) -> jax.Array:
    """Returns the controls `[T, 2]` that drive the bicycle along a trajectory, unclipped.

    Chosen: finite differences, exact for what the bicycle has driven forwards.

    Args:
      poses: `[T, 3]` x, y, heading in the ego frame, first at 0.1 s.
      speed: `[]` of the ego now, m/s.
    """
    start = jnp.zeros_like(poses[:1])
    step = jnp.diff(poses, axis=0, prepend=start)
    square = jnp.sum(step[:, :2] ** 2, axis=1)
    # The root of 0 has no finite slope.
    driven = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0) / DT
    acceleration = jnp.diff(driven, prepend=speed[None]) / DT
    steered = driven > MIN_STEERED_SPEED
    turn = wrap(step[:, 2]) / DT * WHEELBASE
    steering = jnp.where(steered, turn / jnp.where(steered, driven, 1), 0)
    return jnp.stack([acceleration, steering], axis=-1)


def refine_plan(
    plan: jax.Array,
    futures: jax.Array,
    ego_past: jax.Array,
    neighbors_past: jax.Array,
    center: CenterPath,
    weights: jax.Array,
    config: DIPPRefinerConfig,
    vehicle: VehicleParams,
) -> RefinedPlan:
    """Refines one plan; `vmap` over `plan` refines all modes of the ego.

    Args:
      plan: `[T, 3]` x, y, heading of the ego, of GameFormer's planner or `with_headings`.
      futures: `[A, T, 2]` predicted centres of the neighbours; all zero for no predictions.
      ego_past: `[H, 7]` GameFormer's feature of the ego.
      neighbors_past: `[>= A, H, 11]` GameFormer's features of the neighbours; zero where missing.
      center: reference path.
      weights: `[9]`, `even_weights` or learned ones.
      config: static settings.
      vehicle: ego dimensions.
    """
    dtype = plan.dtype
    speed = jnp.hypot(ego_past[-1, 3], ego_past[-1, 4])
    now = neighbors_past[: futures.shape[0], -1]
    zero = jnp.zeros((), dtype)
    problem = DIPPProblem(
        x=zero,
        y=zero,
        heading=zero,
        speed=speed,
        length=jnp.asarray(vehicle.length, dtype),
        width=jnp.asarray(vehicle.width, dtype),
        agents_xy=futures,
        agent_length=now[:, 6],
        agent_width=now[:, 7],
        agent_valid=jnp.any(now != 0, axis=1),
        path=center.path,
        path_info=center.info,
        weights=weights,
    )
    solution = solve(fit_controls(plan, speed), problem, config.solver, config.problem)
    controls = solution.values.reshape(plan.shape[0], 2)
    motion = bicycle(controls, zero, zero, zero, speed, max_steering=config.problem.max_steering)
    return RefinedPlan(
        poses=jnp.stack([motion.x, motion.y, motion.heading], axis=-1),
        controls=controls,
        objective=solution.objective,
        first_objective=solution.objectives[0],
    )
