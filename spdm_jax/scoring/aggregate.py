"""From sub-scores to the PDM score."""

from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import Scalar, ScoringParams
from spdm_jax.types import Array


class Aggregate(NamedTuple):
    """`[P]` each: normalised progress and final score."""

    progress: Array
    total: Array


def aggregate(
    multiplier: Array,
    progress_raw: Array,
    ttc: Array,
    comfort: Array,
    valid: Array,
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
    best = xp.max(progress_raw * multiplier)
    progress = relative_progress(
        progress_raw, multiplier, best, params.progress_threshold, multiplied=True, xp=xp
    )
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


def relative_progress(
    progress_raw: Array,
    multiplier: Array,
    best: Array,
    threshold: Scalar,
    *,
    multiplied: bool,
    xp: ModuleType = jnp,
) -> Array:
    """Progress as a share of the best, `[P]`; where nobody made any, all are equally good.

    Args:
      progress_raw: `[P]` m.
      multiplier: `[P]` product of the multipliers.
      best: `[]` or `[P]` largest progress x multiplier of those compared, m.
      threshold: m; up to it nobody made progress.
      multiplied: the share is of progress x multiplier, and 0 where the multiplier is
        (tuplan_garage, NAVSIM v1); else of the raw progress, at most 1 (NAVSIM v2).
      xp: array module.
    """
    moved = best > threshold
    share = (progress_raw * multiplier if multiplied else progress_raw) / xp.where(moved, best, 1)
    if multiplied:
        return xp.where(moved, share, xp.where(multiplier != 0, 1.0, 0.0))
    return xp.where(moved, xp.clip(share, 0, 1), 1.0)


def aggregate_sets(
    multiplier: Array,
    progress_raw: Array,
    ttc: Array,
    comfort: Array,
    valid: Array,
    params: ScoringParams,
) -> Aggregate:
    """`aggregate` of several scenes on the host, for proposals that were scored block by block.

    Args:
      multiplier: `[B, P]`, like what follows, see `aggregate`.
      progress_raw: see above.
      ttc: see above.
      comfort: see above.
      valid: see above.
      params: weights; brought to the type of `progress_raw`.
    """
    weights = jax.tree.map(lambda value: np.asarray(value, progress_raw.dtype), params)
    scenes = zip(multiplier, progress_raw, ttc, comfort, valid, strict=True)
    each = [aggregate(*scene, weights, xp=np) for scene in scenes]
    return Aggregate(np.stack([a.progress for a in each]), np.stack([a.total for a in each]))
