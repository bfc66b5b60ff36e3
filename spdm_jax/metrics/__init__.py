"""nuPlan's metrics and scores for runs of the closed loop, and for plans in open loop."""

from spdm_jax.metrics.closed import ClosedLoopMetrics, Expert, closed_loop
from spdm_jax.metrics.params import (
    MetricConfig,
    MetricParams,
    OpenLoopParams,
    OpenLoopWeights,
    ScoreWeights,
)
from spdm_jax.metrics.plans import ExpertPoses, OpenLoopMetrics, comparison_indices, open_loop
from spdm_jax.metrics.score import (
    OPEN_LOOP_SCORED,
    SCORED,
    open_loop_score,
    score,
    scores_by_type,
)

__all__ = [
    "OPEN_LOOP_SCORED",
    "SCORED",
    "ClosedLoopMetrics",
    "Expert",
    "ExpertPoses",
    "MetricConfig",
    "MetricParams",
    "OpenLoopMetrics",
    "OpenLoopParams",
    "OpenLoopWeights",
    "ScoreWeights",
    "closed_loop",
    "comparison_indices",
    "open_loop",
    "open_loop_score",
    "score",
    "scores_by_type",
]
