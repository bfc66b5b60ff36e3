"""Batched driving-proposal planning and PDM scoring in JAX."""

__version__ = "0.1.0"
