"""From sub-scores to the PDM score."""

from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import ScoringParams


class Aggregate(NamedTuple):
    """`[P]` each: normalised progress and final score."""

    progress: jax.Array
    total: jax.Array


def aggregate(
    multiplier: jax.Array,
    progress_raw: jax.Array,
    ttc: jax.Array,
    comfort: jax.Array,
    valid: jax.Array,
    params: ScoringParams,
    xp: ModuleType = jnp,
) -> Aggregate:
    """Normalises progress over the valid proposals and combines the terms.

    Args:
      multiplier: `[P]` product of no collision, drivable area and driving direction.
      progress_raw: `[P]` m.
      ttc: `[P]` 0 or 1.
      comfort: `[P]` 0 or 1.
      valid: `[P]` bool; the others do not enter the normalisation and score 0.
      params: weights.
      xp: array module; NumPy for sub-scores that are on the host already.

    Source: tuplan_garage `PDMScorer._aggregate_scores`: score = m (5 progress + 5 ttc + 2
    comfort) / 12; where nobody's m x progress exceeds 0.1 m, progress is 1 if m is not 0.
    """
    multiplier = xp.where(valid, multiplier, 0)
    weighted = progress_raw * multiplier
    best = xp.max(weighted)
    moved = best > params.progress_threshold
    relative = weighted / xp.where(moved, best, 1)
    progress = xp.where(moved, relative, xp.where(multiplier != 0, 1.0, 0.0))
    weights = params.progress_weight + params.ttc_weight + params.comfort_weight
    total = (
        multiplier
        * (
            params.progress_weight * progress
            + params.ttc_weight * ttc
            + params.comfort_weight * comfort
        )
        / weights
    )
    dtype = progress_raw.dtype
    return Aggregate(progress.astype(dtype), total.astype(dtype))
