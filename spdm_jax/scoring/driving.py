"""Driving direction, progress and lane keeping."""

import jax
import jax.numpy as jnp

from spdm_jax.arrays import prefix_sum, true_indices
from spdm_jax.config import ScoringParams
from spdm_jax.geometry import Path, point_segment_sq, project_many

METRIC_WINDOW = 11
"""Steps over which nuPlan's metric sums the way against traffic: those of 1 s and one more."""
LANE_DEVIATION = 0.5
"""Distance from the centreline that lane keeping tolerates, m (NAVSIM v2.2)."""
LANE_DEVIATION_STEPS = 20
"""Steps in a row beyond it that fail lane keeping (NAVSIM v2.2: 2.0 s)."""


def driving_direction(
    center_x: jax.Array,
    center_y: jax.Array,
    oncoming: jax.Array,
    params: ScoringParams,
    window: int | None = None,
    assume_past: bool = True,
) -> jax.Array:
    """Returns 1, 0.5 or 0 by the way driven against traffic, `[P]`.

    Args:
      center_x: `[P, T]` ego centre, m.
      center_y: `[P, T]`.
      oncoming: `[P, T]` bool, the centre is in no on-route polygon.
      params: thresholds.
      window: None takes the longest uninterrupted run, as published; else the longest way within so
        many steps, as nuPlan's metric judges a drive (`METRIC_WINDOW`).
      assume_past: with a window, who starts against the traffic and gains speed is taken to have
        driven that way before; NAVSIM does not.

    Source: tuplan_garage `PDMScorer._calculate_driving_direction_compliance`: the distance driven
    in each uninterrupted run of oncoming states, its maximum against 2 m and 6 m. nuPlan
    `driving_direction_compliance` and NAVSIM `PDMScorer` for the window.
    """
    step = jnp.hypot(jnp.diff(center_x, axis=-1), jnp.diff(center_y, axis=-1))
    step = jnp.concatenate([jnp.zeros_like(step[..., :1]), step], axis=-1)
    total = prefix_sum(jnp.where(oncoming, step, 0))
    if window is None:
        before = jax.lax.cummax(jnp.where(oncoming, 0, total), axis=total.ndim - 1)
        longest = jnp.max(total - before, axis=-1)
    else:
        index = jnp.maximum(jnp.arange(total.shape[-1]) - window, 0)
        longest = jnp.max(total - total[..., index], axis=-1)
        if assume_past:
            # Who starts against the traffic has driven that way before, which is not seen here:
            # what gains speed there counts as if it had been as fast all the time.
            fastest = jnp.max(jnp.where(oncoming, step, 0), axis=-1)
            gains = oncoming[..., 0] & (fastest > step[..., 1])
            longest = jnp.maximum(longest, jnp.where(gains, window * fastest, 0))
    score = jnp.where(
        longest < params.driving_direction_compliant,
        1.0,
        jnp.where(longest < params.driving_direction_violation, 0.5, 0.0),
    )
    return score.astype(center_x.dtype)


def progress(path: Path, center_x: jax.Array, center_y: jax.Array) -> jax.Array:
    """Metres along the path between the first and the last ego centre, not negative, `[P]`.

    Source: tuplan_garage `PDMScorer._calculate_progress`.
    """
    ends = lambda v: jnp.concatenate([v[:, 0], v[:, -1]])
    start, end = jnp.split(project_many(path, ends(center_x), ends(center_y)), 2)
    return jnp.maximum(end - start, 0)


def near_path(path: Path, x: jax.Array, y: jax.Array, limit: float) -> jax.Array:
    """Whether points `[...]` lie within `limit` of the polyline, its ends included."""
    ax, ay, bx, by = path.x[:-1], path.y[:-1], path.x[1:], path.y[1:]
    slack = 1.001 * limit + 1e-3
    reachable = (
        (jnp.maximum(ax, bx) >= jnp.min(x) - slack)
        & (jnp.minimum(ax, bx) <= jnp.max(x) + slack)
        & (jnp.maximum(ay, by) >= jnp.min(y) - slack)
        & (jnp.minimum(ay, by) <= jnp.max(y) + slack)
        & (jnp.arange(ax.shape[0]) < path.count - 1)
    )
    rows, _ = true_indices(reachable, ax.shape[0])

    def look(i, near):
        row = rows[i]
        square, _ = point_segment_sq(x, y, ax[row], ay[row], bx[row], by[row])
        return near | (square <= limit * limit)

    count = jnp.sum(reachable, dtype=jnp.int32)
    return jax.lax.fori_loop(jnp.int32(0), count, look, jnp.zeros(x.shape, bool))


def lane_keeping(
    path: Path, center_x: jax.Array, center_y: jax.Array, in_intersection: jax.Array
) -> jax.Array:
    """Returns 0 where the ego stays beside the centreline for too long, else 1, `[P]`.

    Steps inside an intersection are passed over: they neither count nor end a run.

    Args:
      path: centreline.
      center_x: `[P, T]` ego centre, m.
      center_y: `[P, T]`.
      in_intersection: `[P, T]` bool, of the centre.

    Source: NAVSIM `PDMScorer._calculate_lane_keeping` (v2.2).
    """
    keeps = near_path(path, center_x, center_y, LANE_DEVIATION)
    beside = ~keeps & ~in_intersection
    total = prefix_sum(beside.astype(center_x.dtype))
    # The count at the last step that ended a run.
    ended = jax.lax.cummax(jnp.where(keeps & ~in_intersection, total, 0), axis=total.ndim - 1)
    fails = jnp.any(total - ended >= LANE_DEVIATION_STEPS, axis=-1)
    return (~fails).astype(center_x.dtype)
