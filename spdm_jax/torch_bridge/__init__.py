"""The score inside a PyTorch training loop: torch tensors in and out.

Tensors are handed over by DLPack: on the same device nothing is copied, except a row of a CPU
tensor that does not begin at a multiple of 64 bytes. PyTorch is imported when a tensor comes in.
"""

from spdm_jax.torch_bridge.held import UnusableScene
from spdm_jax.torch_bridge.scorer import TorchScorer, torch_score
from spdm_jax.torch_bridge.task import COMPONENTS

__all__ = ["COMPONENTS", "TorchScorer", "UnusableScene", "torch_score"]
