"""From metrics to nuPlan's scores: one scenario, and a set of them."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.metrics.params import OpenLoopWeights, ScoreWeights

SCORED: tuple[str, ...] = (
    "no_ego_at_fault_collisions",
    "drivable_area_compliance",
    "ego_is_making_progress",
    "driving_direction_compliance",
    "ego_progress_along_expert_route",
    "time_to_collision_within_bound",
    "speed_limit_compliance",
    "ego_is_comfortable",
)
"""Scored closed-loop metrics in order; the first four multiply, the others are averaged."""
NUM_MULTIPLIERS = 4

OPEN_LOOP_SCORED: tuple[str, ...] = (
    "planner_miss_rate_within_bound",
    "planner_expert_average_l2_error_within_bound",
    "planner_expert_final_l2_error_within_bound",
    "planner_expert_average_heading_error_within_bound",
    "planner_expert_final_heading_error_within_bound",
)
"""Scored open-loop metrics in order; the first one multiplies."""


def _weighted(multipliers: jax.Array, terms: jax.Array, weights: Sequence) -> jax.Array:
    scale = jnp.stack([jnp.asarray(weight, terms.dtype) for weight in weights])
    return jnp.prod(multipliers) * jnp.sum(scale * terms) / jnp.sum(scale)


def score(scores: jax.Array, weights: ScoreWeights | None = None) -> jax.Array:
    """Closed-loop score of one scenario.

    Args:
      scores: `[8]` in the order of `SCORED`.
      weights: the official ones if None.

    Returns:
      `[]` in [0, 1]; NaN if a metric could not be computed.

    Source: nuPlan `weighted_average_metric_aggregator` with the closed-loop weights; the same for
    reactive and non-reactive traffic.
    """
    w = ScoreWeights() if weights is None else weights
    each = (w.progress, w.time_to_collision, w.speed_limit, w.comfort)
    return _weighted(scores[:NUM_MULTIPLIERS], scores[NUM_MULTIPLIERS:], each)


def open_loop_score(scores: jax.Array, weights: OpenLoopWeights | None = None) -> jax.Array:
    """Open-loop score of one scenario from `[5]` scores in the order of `OPEN_LOOP_SCORED`."""
    w = OpenLoopWeights() if weights is None else weights
    each = (w.average_displacement, w.final_displacement, w.average_heading, w.final_heading)
    return _weighted(scores[:1], scores[1:], each)


class TypeScore(NamedTuple):
    """Mean score of the scenarios of one type.

    Attributes:
      mean: over those whose score is known; NaN if there are none.
      known: how many those are.
      unknown: scenarios whose score could not be computed.
    """

    mean: float
    known: int
    unknown: int


def scores_by_type(scores: np.ndarray, types: Sequence[str]) -> dict[str, TypeScore]:
    """Means per scenario type, and over all scenarios under `"all"` (host).

    The type means weighted by their counts are the mean over all scenarios.

    Args:
      scores: `[B]` scores, NaN where unknown.
      types: `[B]` scenario types.

    Raises:
      ValueError: the lengths differ.
    """
    values = np.asarray(scores, float)
    if values.shape != (len(types),):
        raise ValueError(f"scores has shape {values.shape}, but there are {len(types)} types")

    def one(rows: np.ndarray) -> TypeScore:
        known = values[rows & np.isfinite(values)]
        mean = float(known.mean()) if known.size else float("nan")
        return TypeScore(mean, int(known.size), int(rows.sum() - known.size))

    names = np.array(types, str)
    result = {name: one(names == name) for name in sorted(set(types))}
    result["all"] = one(np.ones(len(types), bool))
    return result
