"""Small array tools that compile and run fast on every backend.

XLA lowers `cumsum`, sorting and `nonzero` to long chains of operations on a CPU. At the sizes used
here, a triangular matrix product and pairwise comparisons do the same in a few.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

_ROW = 64
Carry = TypeVar("Carry")


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


def prefix_count(values: jax.Array) -> jax.Array:
    """Inclusive sums of flags or small counts along the last axis, int32 (exact up to 2^24)."""
    return prefix_sum(values.astype(jnp.float32)).astype(jnp.int32)


class TrueEntries(NamedTuple):
    """Where a row of flags is True, ready to be asked for the n-th.

    Attributes:
      within: `[R, 64]` int32 inclusive counts in each row of 64 flags.
      before: `[R]` int32 True flags in the rows before.
      total: `[]` int32.
    """

    within: jax.Array
    before: jax.Array
    total: jax.Array


def true_entries(flags: jax.Array) -> TrueEntries:
    """Counts the True entries of `[N]` flags."""
    rows = -(-flags.shape[0] // _ROW)
    table = jnp.pad(flags, (0, rows * _ROW - flags.shape[0])).reshape(rows, _ROW)
    within = prefix_count(table)
    ends = prefix_count(within[:, -1])
    return TrueEntries(within, ends - within[:, -1], ends[-1])


def nth_true(entries: TrueEntries, n: jax.Array) -> jax.Array:
    """Positions of the n-th True, from 1; some valid position where there are fewer."""
    row = jnp.sum(entries.before < n[..., None], axis=-1, dtype=jnp.int32) - 1
    row = jnp.maximum(row, 0)
    rest = n - entries.before[row]
    column = jnp.sum(entries.within[row] < rest[..., None], axis=-1, dtype=jnp.int32)
    return row * _ROW + jnp.minimum(column, _ROW - 1)


def true_indices(flags: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    """First `size` positions of True, and which of them are real; the others are 0."""
    entries = true_entries(flags)
    wanted = jnp.arange(1, size + 1, dtype=jnp.int32)
    real = wanted <= entries.total
    return jnp.where(real, nth_true(entries, wanted), 0), real


def visit_true(
    flags: jax.Array,
    size: int,
    visit: Callable[[jax.Array, jax.Array, Carry], Carry],
    start: Carry,
) -> Carry:
    """Visits all True entries of `[N]` flags, a fixed number at a time.

    Where few of many entries need work, this does the work for those alone, without a limit on how
    many they are.

    Args:
      flags: `[N]` bool.
      size: entries at a time.
      visit: called with positions `[size]`, which of them are real `[size]`, and the carry.
      start: first carry.
    """
    entries = true_entries(flags)

    def some(state):
        part, carry = state
        number = part * size + jnp.arange(size, dtype=jnp.int32)
        return part + 1, visit(nth_true(entries, number + 1), number < entries.total, carry)

    more = lambda state: state[0] * size < entries.total
    return jax.lax.while_loop(more, some, (jnp.int32(0), start))[1]


def when(wanted: jax.Array, change: Callable[[Carry], Carry], value: Carry) -> Carry:
    """Returns `change(value)` where wanted and `value` elsewhere, like `lax.cond`.

    Under vmap `lax.cond` becomes a selection and copies whatever its branches read, the map
    included, once for every row. This is a loop of at most one turn: what it reads is shared.

    Args:
      wanted: `[]` bool.
      change: what may be left out.
      value: any pytree.
    """
    turn = lambda state: (jnp.zeros_like(wanted), change(state[1]))
    return jax.lax.while_loop(lambda state: state[0], turn, (wanted, value))[1]


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
