"""Batched driving-proposal planning and PDM scoring in JAX."""

__version__ = "0.1.0"

from spdm_jax import functional
from spdm_jax.api import from_raw, load, plan, score
from spdm_jax.config import PlannerConfig, PlannerParams, PlannerSpec, pdm_closed, spdm
from spdm_jax.results import Explanation, Failure, PlanSet, ScenarioSet, ScoreSet

__all__ = [
    "Explanation",
    "Failure",
    "PlanSet",
    "PlannerConfig",
    "PlannerParams",
    "PlannerSpec",
    "ScenarioSet",
    "ScoreSet",
    "from_raw",
    "functional",
    "load",
    "pdm_closed",
    "plan",
    "score",
    "spdm",
]
