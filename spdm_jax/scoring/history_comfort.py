"""Comfort as NAVSIM v2 judges it: with the recorded past, and against the previous plan.

The filters are those of `spdm_jax.scoring.comfort` with other windows. How much of the past is
known differs between frames, so they run over a part of an array of fixed length.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.geometry import unwrap_masked
from spdm_jax.scoring.comfort import rounded, savgol_matrix, within_bounds
from spdm_jax.types import Array, EgoState

EXTENDED_BOUNDS = {"accel": 0.7, "jerk": 0.5, "yaw_rate": 0.1, "yaw_accel": 0.1}
"""Largest root mean square difference between two plans: m/s^2, m/s^3, rad/s, rad/s^2."""
_SMOOTHING_WINDOW, _JERK_WINDOW, _YAW_WINDOW = 8, 15, 5


class EgoPast(struct.PyTreeNode, kw_only=True):
    """Recorded past every 0.1 s, ending before the current state (NAVSIM leaves out the last one).

    Attributes:
      heading: `[H]` unwrapped; the last `count` entries are real, the others repeat the oldest.
      ax, ay: `[H]` rear-axle acceleration in the body frame, m/s^2.
      count: `[]` int32, 0 where no past is known.
    """

    heading: Array
    ax: Array
    ay: Array
    count: Array


def _filter(
    signal: jax.Array,
    begin: jax.Array | int,
    end: jax.Array | int,
    window: int,
    order: int,
    derivative: int = 0,
) -> jax.Array:
    """Filters samples `begin ... end - 1` of `[P, T]` as if there were no others.

    Only they are of use in the result. The range holds a window or more.
    """
    size, half = signal.shape[-1], window // 2
    whole = jnp.asarray(savgol_matrix(size, window, order, derivative), signal.dtype)
    row = jnp.arange(size)[:, None]

    def moved(by):
        index = (jnp.arange(size) - by) % size
        return whole[index[:, None], index]

    # Inside all rows are alike; the first and the last ones move with the ends.
    matrix = jnp.where(row < begin + half, moved(begin), whole)
    matrix = jnp.where(row >= end - half, moved(end - size), matrix)
    result = jnp.matmul(signal, matrix.T, precision=jax.lax.Precision.HIGHEST)
    return rounded(result)


def center_comfort_signals(
    heading: jax.Array,
    ax: jax.Array,
    ay: jax.Array,
    turning: jax.Array,
    vehicle: VehicleParams,
    begin: jax.Array | int = 0,
) -> dict[str, jax.Array]:
    """Filtered signals `[P, T]` with accelerations at the box centre.

    Args:
      heading: `[P, T]` rad, 0.1 s apart.
      ax: `[P, T]` rear-axle acceleration, m/s^2.
      ay: `[P, T]`.
      turning: `[P, T]` yaw rate squared plus yaw acceleration, 1/s^2.
      vehicle: ego dimensions.
      begin: first real sample.

    Source: NAVSIM `ego_is_comfortable` (v2.2); nuPlan `get_acceleration_shifted` for the centre.
    The jerk's norm is that of the rear axle.
    """
    size = heading.shape[-1]
    along = ax + vehicle.rear_axle_to_center * turning
    heading = unwrap_masked(heading, jnp.ones(heading.shape, bool))
    # Yaw derivatives do not see a constant; without it float32 keeps its digits.
    heading = heading - heading[..., :1]
    use = lambda signal, *rule: _filter(signal, begin, size, *rule)
    smooth = lambda signal: use(signal, _SMOOTHING_WINDOW, 2)
    lon, lat = smooth(along), smooth(ay)
    return {
        "lon_accel": lon,
        "lat_accel": lat,
        "jerk": use(smooth(jnp.hypot(ax, ay)), _JERK_WINDOW, 2, 1),
        "lon_jerk": use(lon, _JERK_WINDOW, 2, 1),
        "yaw_accel": use(heading, _YAW_WINDOW, 3, 2),
        "yaw_rate": use(heading, _YAW_WINDOW, 2, 1),
    }


def history_comfort_flags(
    ego: EgoState, past: EgoPast, vehicle: VehicleParams, params: ScoringParams
) -> jax.Array:
    """Whether each of the six signals stays inside its bounds, the past included, `[P, 6]` bool.

    Without a past all of them do.

    Args:
      ego: `[P, T]` states.
      past: recorded past; its samples and the states count as evenly spaced.
      vehicle: ego dimensions.
      params: bounds.

    Source: NAVSIM `PDMScorer._calculate_history_comfort` (v2.2).
    """
    room = past.heading.shape[0]
    num = ego.heading.shape[0]

    def join(before, values):
        before = jnp.broadcast_to(before.astype(values.dtype), (num, room))
        return jnp.concatenate([before, values], axis=1)

    turning = ego.yaw_rate**2 + ego.yaw_acceleration
    begin = room - past.count
    signals = center_comfort_signals(
        join(past.heading, ego.heading),
        join(past.ax, ego.ax),
        join(past.ay, ego.ay),
        join(jnp.zeros(room), turning),
        vehicle,
        begin,
    )
    real = jnp.arange(room + ego.heading.shape[1]) >= begin
    flags = within_bounds({name: jnp.where(real, v, 0) for name, v in signals.items()}, params)
    return flags | (past.count == 0)


def plan_features(
    heading: jax.Array, ax: jax.Array, ay: jax.Array, end: jax.Array | int
) -> dict[str, jax.Array]:
    """What extended comfort compares, `[P, T]` each, of the first `end` samples."""
    heading = unwrap_masked(heading, jnp.ones(heading.shape, bool))
    heading = heading - heading[..., :1]
    use = lambda signal, *rule: _filter(signal, 0, end, *rule)
    accel = use(jnp.hypot(ax, ay), _SMOOTHING_WINDOW, 2)
    return {
        "accel": accel,
        "jerk": use(accel, _JERK_WINDOW, 2, 1),
        "yaw_rate": use(heading, _YAW_WINDOW, 2, 1),
        "yaw_accel": use(heading, _YAW_WINDOW, 2, 2),
    }


def plan_differences(ego: EgoState, earlier: EgoState, steps: jax.Array | int) -> jax.Array:
    """Root mean square differences `[P, 4]` between plans at the times they share.

    Args:
      ego: `[P, T]` current states.
      earlier: `[P, T]` states of plans made `steps` samples before.
      steps: 0 ... 5.

    Source: NAVSIM `ego_is_two_frame_extended_comfort` (v2.2). Its yaw acceleration takes a
    polynomial of order 2.
    """
    size = ego.heading.shape[-1]
    end = size - steps
    # Repeating the last sample keeps what is beyond the end finite and unwrapped.
    index = jnp.arange(size)
    shared = jnp.minimum(index, end - 1)
    later = jnp.minimum(index + steps, size - 1)
    pick = lambda state, at: (state.heading[:, at], state.ax[:, at], state.ay[:, at])
    ours = plan_features(*pick(ego, shared), end)
    theirs = plan_features(*pick(earlier, later), end)
    real = index < end
    square = [jnp.where(real, ours[name] - theirs[name], 0) ** 2 for name in EXTENDED_BOUNDS]
    count = jnp.asarray(end, ego.heading.dtype)
    return jnp.stack([jnp.sqrt(jnp.sum(s, axis=-1) / count) for s in square], axis=-1)


def extended_comfort(ego: EgoState, earlier: EgoState, steps: jax.Array | int) -> jax.Array:
    """Returns 1 where two plans hardly differ, else 0, `[P]`; see `plan_differences`."""
    bounds = jnp.asarray(list(EXTENDED_BOUNDS.values()), ego.heading.dtype)
    alike = jnp.all(plan_differences(ego, earlier, steps) <= bounds, axis=-1)
    return alike.astype(ego.heading.dtype)
