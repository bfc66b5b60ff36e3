"""Time series over the real samples of a run: smoothing, derivatives, statistics.

A run that ended early is padded. Everything here gives what the run alone, cut at its end, would
give.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Summary(NamedTuple):
    """Statistics of series `[..., T]`, each `[...]`; NaN where there is no sample."""

    maximum: jax.Array
    minimum: jax.Array
    mean: jax.Array
    p90: jax.Array


def seconds(time: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Duration and mean step of the real samples, s; the step is NaN for a single sample.

    Args:
      time: `[T]` s.
      valid: `[T]` bool, a prefix.
    """
    count = jnp.sum(valid, dtype=jnp.int32)
    duration = time[jnp.maximum(count - 1, 0)] - time[0]
    return duration, jnp.where(count > 1, duration / jnp.maximum(count - 1, 1), jnp.nan)


@lru_cache(maxsize=16)
def _windows(window: int, order: int, derivative: int) -> np.ndarray:
    """Weights `[W + 1, W + 1, W]` of a Savitzky-Golay filter over unit steps.

    Row n serves windows of n samples (of which the first n weights count); column i evaluates the
    fit at its i-th sample and the last column at its middle. NaN where n samples cannot hold a
    polynomial of that order.
    """
    powers = np.arange(order + 1)
    factor = np.array([np.prod(np.arange(p - derivative + 1, p + 1.0)) for p in powers])
    rest = np.maximum(powers - derivative, 0)
    table = np.full((window + 1, window + 1, window), np.nan)
    for n in range(order + 1, window + 1):
        middle = (n - 1) / 2
        q, r = np.linalg.qr((np.arange(n) - middle)[:, None] ** powers)
        fit = np.linalg.solve(r, q.T)
        at = np.append(np.arange(window) - middle, 0.0)
        value = np.where(powers >= derivative, factor * at[:, None] ** rest, 0.0)
        table[n] = 0
        table[n, :, :n] = value @ fit
    return table


def smooth(
    values: jax.Array,
    valid: jax.Array,
    window: int,
    order: int,
    derivative: int = 0,
    step: jax.Array | float = 1.0,
) -> jax.Array:
    """Savitzky-Golay filter of series `[S, T]` over their real samples.

    Interior samples are the middle of the polynomial fitted around them (for an even window that
    is half a sample late, as in scipy); the first and last half windows are the polynomial of the
    first and last window. A series shorter than the window takes its own length as window.

    Args:
      values: `[S, T]`.
      valid: `[T]` bool, a prefix.
      window: samples.
      order: of the polynomial.
      derivative: 0 smooths.
      step: mean spacing of the samples, s.

    Returns:
      `[S, T]`, rounded to 8 decimals in float64 (float32 cannot hold them). NaN where the run is
      too short; 0 on padding.

    Source: nuPlan `state_extractors` (scipy `savgol_filter`, mode "interp").
    """
    count = jnp.sum(valid, dtype=jnp.int32)
    width = jnp.minimum(count, window)
    half = width // 2
    index = jnp.arange(values.shape[-1])
    head, tail = index < half, index >= count - half
    first = jnp.where(head, 0, jnp.where(tail, count - width, index - (width - 1) // 2))
    place = jnp.where(head | tail, index - first, window)
    table = jnp.asarray(_windows(window, order, derivative), values.dtype)
    weights = table[width, jnp.clip(place, 0, window)]  # [T, W]
    sample = jnp.clip(first[:, None] + jnp.arange(window), 0, values.shape[-1] - 1)
    # Weights beyond a short window are 0, what they meet is finite.
    result = jnp.sum(weights * values[:, sample], axis=-1) / step**derivative
    if values.dtype == jnp.float64:
        result = jnp.round(result, 8)
    return jnp.where(valid, result, 0)


@lru_cache(maxsize=8)
def _p90_rank(size: int) -> np.ndarray:
    """Rank of the 90th percentile among n = 0 ... size sorted samples.

    The nearest observation; of two equally near ones the one of even rank, counted from 0 (NumPy
    before version 2).
    """
    index = np.arange(size + 1) * 0.9 - 1.5
    low = np.floor(index)
    lower = (index == low) & (low % 2 == 0)
    return np.clip(np.where(lower, low, low + 1), 0, None).astype(np.int32)


def summarize(values: jax.Array, valid: jax.Array) -> Summary:
    """Statistics of series `[S, T]` over their real samples."""
    count = jnp.sum(valid, dtype=jnp.int32)
    ordered = jnp.sort(jnp.where(valid, values, jnp.inf), axis=-1)
    rank = jnp.asarray(_p90_rank(values.shape[-1]))[count]
    some = count > 0
    pick = lambda v: jnp.where(some, v, jnp.nan)
    # A series that could not be computed is NaN as a whole, and so is all about it.
    return Summary(
        maximum=pick(jnp.max(jnp.where(valid, values, -jnp.inf), axis=-1)),
        minimum=pick(jnp.min(jnp.where(valid, values, jnp.inf), axis=-1)),
        mean=jnp.sum(jnp.where(valid, values, 0), axis=-1) / jnp.where(some, count, jnp.nan),
        p90=pick(jnp.take(ordered, rank, axis=-1)),
    )
