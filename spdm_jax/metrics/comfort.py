"""Comfort: smoothed accelerations, jerks and yaw rates, and their bounds."""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.geometry import unwrap_masked
from spdm_jax.metrics.params import MetricParams
from spdm_jax.metrics.series import Summary, seconds, smooth, summarize
from spdm_jax.types import Array, EgoState

SERIES: tuple[str, ...] = (
    "ego_lon_acceleration",
    "ego_lat_acceleration",
    "ego_jerk",
    "ego_lon_jerk",
    "ego_yaw_rate",
    "ego_yaw_acceleration",
    "ego_acceleration",
    "ego_lat_jerk",
)
"""The comfort series in order; the first six have bounds."""
NUM_BOUNDED = 6

_SMOOTHING_WINDOW = 8
_JERK_WINDOW = 15
# The reference means 15 here too, but does not pass it on.
_YAW_WINDOW = 5


class Comfort(struct.PyTreeNode, kw_only=True):
    """The comfort metrics of one run, S = len(`SERIES`).

    Attributes:
      values: `[S, T]` series, SI units; 0 after the run's end.
      summary: statistics `[S]` over the run.
      outside: `[6, T]` bool, samples on or beyond a bound.
      within: `[6]` bool, whether the whole series is strictly within its bounds.
      score: `[]` 1 where all six are, else 0; NaN where the run is too short to tell.
    """

    values: Array
    summary: Summary
    outside: Array
    within: Array
    score: Array


def comfort(ego: EgoState, time: jax.Array, valid: jax.Array, params: MetricParams) -> Comfort:
    """Judges the comfort of a run.

    Args:
      ego: `[T]` rear-axle states.
      time: `[T]` s.
      valid: `[T]` bool, a prefix.
      params: bounds.

    Source: nuPlan `ego_lon_acceleration` and its siblings, `ego_is_comfortable`. The box centre's
    longitudinal acceleration is `ax + d (w^2 + alpha)`, d its distance from the rear axle; its
    lateral one is the rear axle's (nuPlan `get_acceleration_shifted`).
    """
    shift = params.vehicle.rear_axle_to_center
    lon = ego.ax + shift * (ego.yaw_rate**2 + ego.yaw_acceleration)
    accel = jnp.stack([jnp.hypot(ego.ax, ego.ay), lon, ego.ay])
    _, step = seconds(time, valid)
    smoothed = smooth(accel, valid, _SMOOTHING_WINDOW, 2)
    jerk = smooth(smoothed, valid, _JERK_WINDOW, 2, 1, step)
    # Derivatives do not see a constant; without it float32 keeps its digits.
    heading = (unwrap_masked(ego.heading, valid) - ego.heading[0])[None]
    rate = smooth(heading, valid, _YAW_WINDOW, 2, 1, step)
    yaw_accel = smooth(heading, valid, _YAW_WINDOW, 3, 2, step)
    values = jnp.stack(
        [smoothed[1], smoothed[2], jerk[0], jerk[1], rate[0], yaw_accel[0], smoothed[0], jerk[2]]
    )
    high = jnp.stack(
        [
            jnp.asarray(bound, values.dtype)
            for bound in (
                params.lon_accel_max,
                params.lat_accel_max,
                params.jerk_max,
                params.lon_jerk_max,
                params.yaw_rate_max,
                params.yaw_accel_max,
            )
        ]
    )
    low = (-high).at[0].set(params.lon_accel_min)
    bounded = values[:NUM_BOUNDED]
    outside = valid & ~((bounded > low[:, None]) & (bounded < high[:, None]))
    within = ~jnp.any(outside, axis=-1)
    known = jnp.all(jnp.isfinite(bounded)) & jnp.any(valid)
    score = jnp.where(known, jnp.all(within).astype(values.dtype), jnp.nan)
    return Comfort(
        values=values,
        summary=summarize(values, valid),
        outside=outside,
        within=within,
        score=score,
    )
