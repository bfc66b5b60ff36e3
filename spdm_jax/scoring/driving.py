"""Driving direction and progress."""

import jax
import jax.numpy as jnp

from spdm_jax.arrays import prefix_sum
from spdm_jax.config import ScoringParams
from spdm_jax.geometry import Path, project_many

METRIC_WINDOW = 11
"""Steps over which nuPlan's metric sums the way against traffic: those of 1 s and one more."""


def driving_direction(
    center_x: jax.Array,
    center_y: jax.Array,
    oncoming: jax.Array,
    params: ScoringParams,
    window: int | None = None,
) -> jax.Array:
    """Returns 1, 0.5 or 0 by the way driven against traffic, `[P]`.

    Args:
      center_x: `[P, T]` ego centre, m.
      center_y: `[P, T]`.
      oncoming: `[P, T]` bool, the centre is in no on-route polygon.
      params: thresholds.
      window: None takes the longest uninterrupted run, as published; else the longest way within so
        many steps, as nuPlan's metric judges a drive (`METRIC_WINDOW`).

    Source: tuplan_garage `PDMScorer._calculate_driving_direction_compliance`: the distance driven
    in each uninterrupted run of oncoming states, its maximum against 2 m and 6 m. nuPlan
    `driving_direction_compliance` for the window.
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
        # Who starts against the traffic has driven that way before, which is not seen here: what
        # gains speed there counts as if it had been as fast all the time.
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
