"""Smooth minimum and root: finite values and gradients everywhere.

Margins are signed: positive where a rule is kept. Here they are in units of the temperature.
"""

import jax
import jax.numpy as jnp

SHARPNESS = 10.0
"""Minima are taken at a tenth of the temperature: over N entries they lie at most ln(N) / 10 of the
temperature too low, one temperature for 22,000 entries, and never too high."""

FAR = 1e4
"""Margin of what cannot break a rule, in units of the temperature: 1 in every sigmoid."""


def soft_min(
    margin: jax.Array, axis: int | tuple[int, ...], where: jax.Array | bool = True
) -> jax.Array:
    """Smooth minimum of margins along `axis`; entries that are not in `where` count as far off."""
    # Distances over a tiny temperature would overflow float32; beyond FAR nothing is left to see.
    margin = jnp.clip(jnp.where(where, margin, FAR), -FAR, FAR)
    return -jax.nn.logsumexp(-SHARPNESS * margin, axis=axis) / SHARPNESS


def safe_sqrt(square: jax.Array) -> jax.Array:
    """Square root with gradient 0 at 0."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
