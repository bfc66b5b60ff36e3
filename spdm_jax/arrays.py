"""Small array tools that compile and run fast on every backend.

XLA lowers `cumsum`, sorting and `nonzero` to long chains of operations on a CPU. At the sizes used
here, a triangular matrix product and pairwise comparisons do the same in a few.
"""

import jax
import jax.numpy as jnp
import numpy as np

_ROW = 64


def prefix_sum(values: jax.Array) -> jax.Array:
    """Inclusive sums along the last axis, by triangular matrix products in rows of 64."""
    size = values.shape[-1]
    rows = -(-size // _ROW)
    padded = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, rows * _ROW - size)])
    table = padded.reshape(*values.shape[:-1], rows, _ROW)
    high = jax.lax.Precision.HIGHEST
    within = jnp.matmul(table, np.triu(np.ones((_ROW, _ROW))).astype(values.dtype), precision=high)
    if rows > 1:
        before = np.triu(np.ones((rows, rows)), 1).astype(values.dtype)
        offset = jnp.matmul(within[..., -1], before, precision=high)
        within = within + offset[..., None]
    return within.reshape(*values.shape[:-1], rows * _ROW)[..., :size]


def prefix_count(flags: jax.Array) -> jax.Array:
    """Inclusive counts of True along the last axis, int32 (exact up to 2^24 flags)."""
    return prefix_sum(flags.astype(jnp.float32)).astype(jnp.int32)


def nth_true(counts: jax.Array, n: jax.Array) -> jax.Array:
    """Positions of the n-th True (from 1) given `prefix_count` of the flags; last one if absent."""
    index = jnp.searchsorted(counts, n, side="left", method="scan")
    return jnp.minimum(index, counts.shape[0] - 1).astype(jnp.int32)


def true_indices(flags: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """First `size` positions of True, and which of them are real."""
    counts = prefix_count(flags)
    wanted = jnp.arange(1, size + 1, dtype=jnp.int32)
    return nth_true(counts, wanted), wanted <= counts[-1]


def rank_of(*keys: jax.Array) -> jax.Array:
    """Place of each entry in lexicographic order, `[N]` int32; the last key is the primary one.

    Equal entries keep their order. Compares all pairs: for a few hundred entries at most.
    """
    num = keys[0].shape[0]
    index = jnp.arange(num)
    before = index[:, None] < index[None, :]
    for key in keys:
        less = key[:, None] < key[None, :]
        before = less | ((key[:, None] == key[None, :]) & before)
    return jnp.sum(before, axis=0).astype(jnp.int32)


def order_of(*keys: jax.Array) -> jax.Array:
    """Indices that sort the entries, as `jnp.lexsort`; see `rank_of`."""
    rank = rank_of(*keys)
    return jnp.zeros_like(rank).at[rank].set(jnp.arange(rank.shape[0], dtype=jnp.int32))
