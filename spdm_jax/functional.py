"""Pure functions over pytrees, for use inside a user's own `jit`, `vmap` or `scan`.

Scenarios come from `spdm_jax.load(...).batch` by `to_device`; `vmap` (or `lax.map`) strips the
leading axis. Settings are `PlannerParams` (traced) and `PlannerConfig` (static).
"""

from spdm_jax.padding import to_device
from spdm_jax.planner import (
    PlannerState,
    PlanResult,
    StepInput,
    init,
    observe,
    plan,
    step,
)
from spdm_jax.scene_score import score_scene
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.soft import soft_score_scene
from spdm_jax.tracking.lqr import track

__all__ = [
    "PlanResult",
    "PlannerState",
    "StepInput",
    "World",
    "init",
    "observe",
    "plan",
    "score_scene",
    "score_trajectories",
    "soft_score_scene",
    "step",
    "to_device",
    "track",
]
