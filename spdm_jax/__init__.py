"""Batched driving-proposal planning and PDM scoring in JAX."""

__version__ = "0.1.0"

from spdm_jax import functional
from spdm_jax.api import from_raw, load, plan, score, to_navsim
from spdm_jax.batching import BatchConfig
from spdm_jax.config import PlannerConfig, PlannerParams, PlannerSpec, pdm_closed, spdm
from spdm_jax.labels import open_labels
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.navsim.reader import load_frames as load_navsim
from spdm_jax.navsim.results import NavsimScoreSet
from spdm_jax.results import Explanation, Failure, PlanSet, ScenarioSet, ScoreSet
from spdm_jax.soft import SoftScores, soft_score
from spdm_jax.torch_bridge import TorchScorer, torch_score
from spdm_jax.vocabulary import build_vocabulary

__all__ = [
    "BatchConfig",
    "Explanation",
    "Failure",
    "NavsimScoreSet",
    "NavsimSet",
    "PlanSet",
    "PlannerConfig",
    "PlannerParams",
    "PlannerSpec",
    "ScenarioSet",
    "ScoreSet",
    "SoftScores",
    "TorchScorer",
    "build_vocabulary",
    "from_raw",
    "functional",
    "load",
    "load_navsim",
    "open_labels",
    "pdm_closed",
    "plan",
    "score",
    "soft_score",
    "spdm",
    "to_navsim",
    "torch_score",
]
