"""Reads a scored proposal set at a smaller number of proposals.

SPDM's sets nest: the first N_p proposals of a larger set are the set of N_p. Only what looks at
all proposals at once depends on their number, the normalisation of progress and the choice; both
are done again here, and nothing else is.
"""

import jax.numpy as jnp
from flax import struct

from spdm_jax.config import PlannerParams, ProgressReference
from spdm_jax.planner import PlanResult
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.types import Array, EgoState, SubScores


class NestedReading(struct.PyTreeNode, kw_only=True):
    """What a planner with fewer proposals would have scored and chosen.

    Attributes:
      scores: `[P]` sub-scores; rows from N_p on are not valid and their total and progress are 0.
      best: `[]` int32, first proposal with the highest score.
      emergency_brake: `[]` bool, the plan would be the brake's.
    """

    scores: SubScores
    best: Array
    emergency_brake: Array


def progress_by_goal(reference: ProgressReference, num_proposals: int, num_stage1: int) -> bool:
    """Whether a planner with that many proposals measures progress along the way to the goal.

    Args:
      reference: `PlannerConfig.progress_reference`.
      num_proposals: N_p.
      num_stage1: lateral offsets x speed fractions.
    """
    return reference == "goal" or (reference == "auto" and num_proposals > num_stage1)


def read_nested(
    plans: PlanResult,
    num_proposals: Array,
    by_goal: Array,
    ego: EgoState,
    params: PlannerParams,
) -> NestedReading:
    """Reads one scene's scored set at its first `num_proposals` rows.

    A set without stage 2 is in the larger one only where the larger planner kept its paths: with
    stage 2 a planner that stands on two lanes at once may continue on the other one
    (`PlannerState.slot` of the first step says so).

    Args:
      plans: one step of SPDM with at least as many proposals.
      num_proposals: `[]` int32 N_p, traced: one program reads every N_p.
      by_goal: `[]` bool, see `progress_by_goal`.
      ego: the state that was planned from, scalars.
      params: traced settings of `plans`, cast to its dtype.
    """
    scores = plans.scores
    within = jnp.arange(scores.total.shape[0]) < num_proposals
    valid = scores.valid & within
    raw = jnp.where(by_goal, plans.progress_goal, plans.progress_centerline)
    combined = aggregate(
        scores.no_at_fault_collision * scores.drivable_area * scores.driving_direction,
        raw,
        scores.time_to_collision,
        scores.comfort,
        valid,
        params.scoring,
    )
    # Not-valid rows of the smaller set take part in its arg max with 0; rows beyond it must not.
    best = jnp.argmax(jnp.where(within, combined.total, -jnp.inf)).astype(jnp.int32)
    braking = (scores.collision_time[best] <= params.brake.time_threshold) & (
        jnp.hypot(ego.vx, ego.vy) <= params.brake.speed_threshold
    )
    return NestedReading(
        scores=scores.replace(
            total=combined.total, progress=combined.progress, progress_raw=raw, valid=valid
        ),
        best=best,
        emergency_brake=braking,
    )
