"""From a plan to the ego's next state: nuPlan's two-stage controller, or perfect tracking."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.config import DT, TrackerParams, VehicleParams
from spdm_jax.geometry import principal, unwrap_masked, wrap
from spdm_jax.tracking.lqr import HORIZON, LOOKAHEAD_MOMENTS, bicycle_step, lateral_command
from spdm_jax.tracking.profiles import curvature_profile, speed_fit_matrix
from spdm_jax.types import Array, EgoState

PLAN_SECONDS = 8.0
"""Length of the plans that the controller takes by default, s."""


class Plan(struct.PyTreeNode, kw_only=True):
    """A planned trajectory of the rear axle.

    Attributes:
      x, y, heading: `[M]` poses, local frame.
      time: `[M]` s since the first pose; strictly increasing from 0.
      start: `[]` s, the simulation's time at the first pose.
    """

    x: Array
    y: Array
    heading: Array
    time: Array
    start: Array


def pose_at(plan: Plan, offset: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pose at seconds `[...]` since the plan's start, linear in time and held at the ends.

    Source: nuPlan `InterpolatedTrajectory` (differs: holds the ends where nuPlan raises).
    """
    offset = jnp.clip(offset, plan.time[0], plan.time[-1])
    method = "compare_all" if offset.size * plan.time.shape[0] <= 2**15 else "scan"
    right = jnp.searchsorted(plan.time, offset, side="left", method=method)
    right = jnp.clip(right, 1, plan.time.shape[0] - 1)
    before, after = plan.time[right - 1], plan.time[right]
    share = (offset - before) / (after - before)
    mix = lambda v: v[right - 1] + share * (v[right] - v[right - 1])
    heading = unwrap_masked(plan.heading, jnp.ones(plan.heading.shape, bool))
    return mix(plan.x), mix(plan.y), principal(mix(heading))


def plan_profiles(plan: Plan, num_steps: int) -> tuple[jax.Array, jax.Array]:
    """Least-squares speeds (m/s) and curvatures (1/m), `[num_steps]` each, 0.1 s apart.

    Source: nuPlan `tracker_utils.compute_speed_and_curvature_profiles...`: jerk and curvature rate
    are penalised.
    """
    offset = jnp.arange(num_steps + 1).astype(plan.x.dtype) * DT
    x, y, heading = pose_at(plan, offset)
    start = heading[:-1]
    along = jnp.diff(x) * jnp.cos(start) + jnp.diff(y) * jnp.sin(start)
    matrix = jnp.asarray(speed_fit_matrix(num_steps, "corrected"), x.dtype)
    speed = jnp.matmul(matrix, along, precision=jax.lax.Precision.HIGHEST)
    return speed, curvature_profile(heading[None], speed[None])[0]


def _profile_at(profile: jax.Array, step: jax.Array) -> jax.Array:
    """Values of a uniform profile `[N]` at fractional steps `[...]`, held at the ends."""
    last = profile.shape[0] - 1
    step = jnp.clip(step, 0, last)
    left = jnp.minimum(jnp.floor(step), last - 1).astype(jnp.int32)
    return profile[left] + (step - left) * (profile[left + 1] - profile[left])


def track_command(
    ego: EgoState,
    plan: Plan,
    time: jax.Array,
    vehicle: VehicleParams,
    params: TrackerParams,
    plan_seconds: float = PLAN_SECONDS,
) -> tuple[jax.Array, jax.Array]:
    """Commanded acceleration (m/s^2) and steering rate (rad/s), scalars.

    Args:
      ego: current state.
      plan: trajectory to follow.
      time: current time, s.
      vehicle: the tracker's wheel base is the vehicle's.
      params: gains and limits.
      plan_seconds: static; the plan's length, a multiple of 0.1 s.

    Source: nuPlan `LQRTracker`.
    """
    speed, curvature = plan_profiles(plan, round(plan_seconds / DT))
    offset = time - plan.start
    x, y, heading = pose_at(plan, offset)
    step = offset / DT
    target = _profile_at(speed, step + HORIZON)
    ahead = _profile_at(curvature, step + np.arange(HORIZON).astype(curvature.dtype))

    error = ego.vx - target
    horizon = DT * HORIZON
    q, r = params.q_longitudinal, params.r_longitudinal
    accel = -(horizon * q) * error / (horizon * q * horizon + r)
    lateral = (ego.y - y) * jnp.cos(heading) - (ego.x - x) * jnp.sin(heading)
    moments = jnp.sum(LOOKAHEAD_MOMENTS.astype(ahead.dtype) * ahead, axis=1)
    rate = lateral_command(
        lateral,
        wrap(ego.heading - heading),
        ego.steering,
        ego.vx,
        accel,
        moments,
        params.replace(wheel_base=vehicle.wheel_base),
    )
    stopping = (target <= params.stopping_speed) & (ego.vx <= params.stopping_speed)
    accel = jnp.where(stopping, -params.stopping_gain * error, accel)
    return accel, jnp.where(stopping, 0, rate)


def track_step(
    ego: EgoState,
    plan: Plan,
    time: jax.Array,
    next_time: jax.Array,
    vehicle: VehicleParams,
    params: TrackerParams,
    plan_seconds: float = PLAN_SECONDS,
) -> EgoState:
    """Moves the ego along a plan with the LQR tracker and the kinematic bicycle.

    Args:
      ego: current state.
      plan: trajectory to follow.
      time: current time, s.
      next_time: time of the next state, s.
      vehicle: ego dimensions.
      params: gains, limits and lags.
      plan_seconds: static; the plan's length, a multiple of 0.1 s.

    Source: nuPlan `TwoStageController`.
    """
    accel, rate = track_command(ego, plan, time, vehicle, params, plan_seconds)
    return bicycle_step(ego, accel, rate, vehicle, params, next_time - time)


def perfect_step(ego: EgoState, plan: Plan, time: jax.Array, next_time: jax.Array) -> EgoState:
    """Puts the ego on its plan at the next time.

    Plans hold poses only, so speeds and accelerations are differences over the step.

    Source: nuPlan `PerfectTrackingController` (differs: nuPlan's plans carry speeds of their own).
    """
    dt = next_time - time
    x, y, heading = pose_at(plan, next_time - plan.start)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    vx = ((x - ego.x) * cos + (y - ego.y) * sin) / dt
    yaw_rate = wrap(heading - ego.heading) / dt
    zero = jnp.zeros_like(x)
    return EgoState(
        x=x,
        y=y,
        heading=heading,
        vx=vx,
        vy=zero,
        ax=(vx - ego.vx) / dt,
        ay=zero,
        steering=zero,
        steering_rate=zero,
        yaw_rate=yaw_rate,
        yaw_acceleration=(yaw_rate - ego.yaw_rate) / dt,
    )
