"""Comfort: Savitzky-Golay filters as constant matrices, six strict bounds."""

from collections.abc import Callable
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import DT, Scalar, ScoringParams
from spdm_jax.geometry import unwrap_masked
from spdm_jax.types import EgoState


@lru_cache(maxsize=16)
def savgol_matrix(size: int, window: int, order: int, derivative: int) -> np.ndarray:
    """Returns the `[T, T]` float64 matrix of a Savitzky-Golay filter with "interp" edges.

    An even window is fitted to samples i - w/2 + 1 ... i + w/2 and evaluated half a sample late,
    as scipy does; the edges are the polynomial of the first and last full window.
    """
    window = min(window, size)
    matrix = np.zeros((size, size))

    def weights(at: float) -> np.ndarray:
        powers = np.arange(order + 1)
        q, r = np.linalg.qr((np.arange(window) - (window - 1) / 2)[:, None] ** powers)
        fit = np.linalg.solve(r, q.T)
        factor = np.array(
            [
                np.prod(np.arange(p - derivative + 1, p + 1)) if p >= derivative else 0
                for p in powers
            ]
        )
        value = factor * np.where(powers >= derivative, at ** np.maximum(powers - derivative, 0), 0)
        return value @ fit / DT**derivative

    half, middle = window // 2, (window - 1) / 2
    for i in range(size):
        if i < half:
            first, at = 0, i - middle
        elif i >= size - half:
            first, at = size - window, i - (size - window) - middle
        else:
            first, at = i - (window - 1) // 2, 0.0
        matrix[i, first : first + window] = weights(at)
    return matrix


def _apply(matrix: np.ndarray, signal: jax.Array) -> jax.Array:
    return rounded(filtered(matrix, signal))


def filtered(matrix: np.ndarray, signal: jax.Array) -> jax.Array:
    """Applies a `[T, T]` filter to signals `[..., T]`."""
    operator = jnp.asarray(matrix, signal.dtype)
    return jnp.matmul(signal, operator.T, precision=jax.lax.Precision.HIGHEST)


def rounded(signal: jax.Array) -> jax.Array:
    """Rounds to 8 decimals as nuPlan does; float32 cannot hold them and stays as it is."""
    return jnp.round(signal, 8) if signal.dtype == jnp.float64 else signal


def comfort_signals(ego: EgoState) -> dict[str, jax.Array]:
    """Filtered signals `[P, T]`, in the order of nuPlan's six comfort metrics.

    Source: tuplan_garage `pdm_comfort_metrics`. Its yaw filters keep a window of 5 (the long window
    is not passed on), its acceleration filters take the whole horizon.
    """
    return comfort_filters(ego, jnp.hypot(ego.ax, ego.ay), _apply)


def comfort_filters(
    ego: EgoState,
    magnitude: jax.Array,
    apply: Callable[[np.ndarray, jax.Array], jax.Array],
) -> dict[str, jax.Array]:
    """`comfort_signals` with the steps that have no gradient left to the caller.

    Args:
      ego: `[P, T]` states.
      magnitude: `[P, T]` norm of the acceleration, m/s^2.
      apply: how a `[T, T]` matrix filters a signal `[P, T]`.
    """
    size = ego.ax.shape[-1]
    smooth = savgol_matrix(size, 8, 2, 0)
    jerk = savgol_matrix(size, size, 2, 1)
    heading = unwrap_masked(ego.heading, jnp.ones(ego.heading.shape, bool))
    # Yaw derivatives do not see a constant; without it float32 keeps its digits.
    heading = heading - heading[..., :1]
    return {
        "lon_accel": apply(savgol_matrix(size, size, 2, 0), ego.ax),
        "lat_accel": apply(savgol_matrix(size, size, 2, 0), ego.ay),
        "jerk": apply(jerk, apply(smooth, magnitude)),
        "lon_jerk": apply(jerk, apply(smooth, ego.ax)),
        "yaw_accel": apply(savgol_matrix(size, 5, 3, 2), heading),
        "yaw_rate": apply(savgol_matrix(size, 5, 2, 1), heading),
    }


def comfort_bounds(params: ScoringParams) -> dict[str, tuple[Scalar, Scalar]]:
    """Lower and upper bound of each of the six signals, in their order."""
    return {
        "lon_accel": (params.lon_accel_min, params.lon_accel_max),
        "lat_accel": (-params.lat_accel_max, params.lat_accel_max),
        "jerk": (-params.jerk_max, params.jerk_max),
        "lon_jerk": (-params.lon_jerk_max, params.lon_jerk_max),
        "yaw_accel": (-params.yaw_accel_max, params.yaw_accel_max),
        "yaw_rate": (-params.yaw_rate_max, params.yaw_rate_max),
    }


def comfort_flags(ego: EgoState, params: ScoringParams) -> jax.Array:
    """Whether each of the six signals stays strictly inside its bounds, `[P, 6]` bool."""
    return within_bounds(comfort_signals(ego), params)


def within_bounds(signals: dict[str, jax.Array], params: ScoringParams) -> jax.Array:
    """Whether named signals `[P, T]` stay strictly inside their bounds, `[P, 6]` bool."""
    bounds = comfort_bounds(params)
    return jnp.stack(
        [
            jnp.all((signal > bounds[name][0]) & (signal < bounds[name][1]), axis=-1)
            for name, signal in signals.items()
        ],
        axis=-1,
    )
