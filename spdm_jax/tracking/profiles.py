"""Reference speed and curvature profiles of the batch LQR tracker.

Both fits are small least-squares problems. The speed fit has the same matrix for every proposal,
so it is one constant matrix; the curvature fit is tridiagonal in the curvatures.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import DT, Tracker
from spdm_jax.geometry import wrap

JERK_PENALTY = 1e-4
CURVATURE_RATE_PENALTY = 1e-2
INITIAL_CURVATURE_PENALTY = 1e-10


@lru_cache(maxsize=8)
def speed_fit_matrix(num_steps: int, tracker: Tracker) -> np.ndarray:
    """Returns `[N, N]` float64 mapping signed displacements (m) to fitted speeds (m/s).

    Unknowns are v_0 and the accelerations a_0 ... a_{N-2}; displacement i along the heading of
    pose i is dt v_i. "reference" regularises with the published difference matrix, in which a
    second assignment overwrote the first; "corrected" penalises differences of accelerations.

    Source: tuplan_garage `batch_lqr_utils._fit_initial_velocity_and_acceleration_profile`.
    """
    to_speed = np.concatenate(
        [np.ones((num_steps, 1)), DT * np.tril(np.ones((num_steps, num_steps - 1)), -1)], axis=1
    )
    rows = DT * to_speed
    difference = np.zeros((num_steps - 2, num_steps))
    index = np.arange(num_steps - 2)
    difference[index, index + 1] = -1.0
    if tracker == "corrected":
        difference[index, index + 2] = 1.0
    else:
        difference[-1, -1] = 1.0
    normal = rows.T @ rows + JERK_PENALTY * difference.T @ difference
    return to_speed @ np.linalg.solve(normal, rows.T)


def speed_profile(x: jax.Array, y: jax.Array, heading: jax.Array, tracker: Tracker) -> jax.Array:
    """Fits speeds `[P, N]` (m/s) to poses `[P, N + 1]`."""
    # Time first: that is how the tracker reads it, and long axes last keep loops contiguous.
    x, y, start = x.T, y.T, heading.T[:-1]
    along = jnp.diff(x, axis=0) * jnp.cos(start) + jnp.diff(y, axis=0) * jnp.sin(start)
    matrix = jnp.asarray(speed_fit_matrix(along.shape[0], tracker), x.dtype)
    return jnp.matmul(matrix, along, precision=jax.lax.Precision.HIGHEST).T


def curvature_profile(heading: jax.Array, speed: jax.Array) -> jax.Array:
    """Fits curvatures `[P, N]` (1/m) to headings `[P, N + 1]` and fitted speeds `[P, N]`.

    Minimises sum (dh_i - dt v_i k_i)^2 + lam / dt^2 sum (k_{i+1} - k_i)^2 + 1e-10 k_0^2. The
    tridiagonal solve is written in information form (p = pivot minus the coupling), where every
    term is non-negative: at standstill the plain pivot would cancel to zero in float32.

    Source: tuplan_garage `batch_lqr_utils._fit_initial_curvature_and_curvature_rate_profile`.
    """
    coupling = CURVATURE_RATE_PENALTY / DT**2
    step = speed.T * DT
    turn = wrap(jnp.diff(heading.T, axis=0))
    first = jnp.arange(step.shape[0])[:, None] == 0
    information = (step * step + jnp.where(first, INITIAL_CURVATURE_PENALTY, 0)) / coupling
    moment = step * turn / coupling

    def forward(carry, xs):
        p, r = carry
        a, b = xs
        p, r = a + p / (1 + p), b + r / (1 + p)
        return (p, r), (p, r)

    zero = jnp.zeros_like(information[0])
    (p_last, r_last), (p, r) = jax.lax.scan(forward, (zero, zero), (information, moment))
    last = r_last / p_last

    def backward(following, xs):
        p, r = xs
        k = (r + following) / (1 + p)
        return k, k

    _, rest = jax.lax.scan(backward, last, (p[:-1], r[:-1]), reverse=True)
    return jnp.concatenate([rest, last[None]]).T
