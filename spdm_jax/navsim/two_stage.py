"""NAVSIM v2's two stages: how much each follow-up frame counts."""

import jax.numpy as jnp

from spdm_jax.types import Array

_SPREAD = 0.2
"""2 sigma^2 of the weights, m^2 (NAVSIM v2.2)."""
_NOTHING = 1e-8


def follow_up_weights(endpoint: Array, starts: Array, valid: Array | None = None) -> Array:
    """Weights of follow-up frames by how near they start to where the first stage's plan ended.

    Args:
      endpoint: `[..., 2]` planned (not simulated) end of the first stage, m.
      starts: `[..., S, 2]` where the follow-ups start, m.
      valid: `[..., S]` bool, real follow-ups; all if None.

    Returns:
      `[..., S]`, summing to 1: Gaussian in the distance, or equal where all are far away.

    Source: NAVSIM `calculate_weighted_average_score` (v2.2).
    """
    square = jnp.sum((starts - endpoint[..., None, :]) ** 2, axis=-1)
    real = jnp.ones(square.shape, bool) if valid is None else valid
    weight = jnp.where(real, jnp.exp(-square / _SPREAD), 0)
    total = jnp.sum(weight, axis=-1, keepdims=True)
    count = jnp.sum(real, axis=-1, keepdims=True)
    equal = jnp.where(real, 1 / jnp.maximum(count, 1), 0).astype(square.dtype)
    far = total <= _NOTHING
    return jnp.where(far, equal, weight / jnp.where(far, 1, total))
