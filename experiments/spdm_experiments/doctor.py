"""`spdm doctor`: what is installed, and does this machine compute what it should.

A linear-algebra kernel that is silently wrong on one host shows up as scores of zero, hours later.
The checks solve problems whose answers are known beforehand. They take seconds, and half a minute
where the program that scores the scene has to be compiled first.
"""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_experiments.runtime import version_of
from spdm_jax import from_raw, score
from spdm_jax.config import DT, NUM_STATES
from spdm_jax.synthetic import make_scene

PACKAGES = (
    "spdm-jax",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "shapely",
    "polars",
    "pyproj",
    "pyyaml",
    "matplotlib",
)

SCENE = "parked_car"
"""Scene that is scored; its numbers are below."""
_SUB_SCORES = (
    "total",
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "progress",
    "progress_raw",
)
# Computed in float64 by the parity-tested scorer: into the parked car; braking behind it; past it
# in the free lane; off the road to the right.
_STORED = (
    (0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 34.17699),
    (0.779493, 1.0, 1.0, 1.0, 1.0, 1.0, 0.470783, 19.484659),
    (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 41.387736),
    (0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 19.916329),
)
_SCENE_TOLERANCE = 2e-3
"""Float32 moves the metres of progress by some 1e-5, a wrong rule moves a score by 0.08 or more."""


@dataclass(frozen=True)
class Check:
    """Result of one self-test: `deviation` from the known answer, and what is tolerated."""

    name: str
    deviation: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the deviation is within the tolerance; NaN is not."""
        return self.deviation <= self.tolerance


def report(cache: Path | None) -> tuple[list[str], bool]:
    """Returns the lines to print and whether every check passed."""
    lines = [f"python      {platform.python_version()} on {platform.platform()}"]
    lines += [f"{name:11} {version(name)}" for name in PACKAGES]
    lines += [f"device      {device.device_kind} ({device.platform})" for device in jax.devices()]
    lines.append(f"cache       {cache or 'off'}")
    checks = run_checks()
    lines += [
        f"{'ok    ' if check.passed else 'FAILED'}      {check.name}: deviation "
        f"{check.deviation:.1e}, tolerance {check.tolerance:.0e}"
        for check in checks
    ]
    return lines, all(check.passed for check in checks)


def version(name: str) -> str:
    """Returns the installed version of a distribution, or that it is missing."""
    return version_of(name, 'not installed (pip install "spdm-jax[data,plot]")')


def run_checks() -> list[Check]:
    """Runs the numerical self-tests in float32 and float64, and scores the stored scene."""
    checks: list[Check] = []
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            # Room for another summation order and other sine kernels, not for a wrong result.
            unit = float(np.finfo(dtype).eps)
            tests: tuple[tuple[str, Callable[[type], float], float], ...] = (
                ("least squares", _least_squares, 2e3 * unit),
                ("angles", _angles, 20 * unit),
                ("batched = one by one", _batching, 200 * unit),
            )
            checks += [
                Check(f"{name} ({np.dtype(dtype).name})", test(dtype), tolerance)
                for name, test, tolerance in tests
            ]
    return [*checks, Check("scored scene (float32)", _scored_scene(), _SCENE_TOLERANCE)]


def _velocity_fit(positions: jax.Array) -> jax.Array:
    """Returns the smooth velocity whose integral follows `positions` `[T]` (jerk penalised)."""
    count = positions.shape[0] - 1
    dt, weight = 0.1, 1e-4
    integral = dt * np.tril(np.ones((count, count)))
    second = np.diff(np.eye(count), n=2, axis=0) / dt**2
    matrix = jnp.asarray(np.vstack([integral, np.sqrt(weight) * second]), positions.dtype)
    target = jnp.concatenate([positions[1:] - positions[0], jnp.zeros(count - 2, positions.dtype)])
    with jax.default_matmul_precision("highest"):
        q, r = jnp.linalg.qr(matrix)
        return jax.scipy.linalg.solve_triangular(r, q.T @ target)


def _least_squares(dtype: type) -> float:
    # Velocity that grows linearly has no second difference: the fit must give it back.
    velocity = 8.0 + 0.05 * np.arange(40)
    positions = np.concatenate([[0.0], np.cumsum(0.1 * velocity)]).astype(dtype)
    found = jax.jit(_velocity_fit)(positions)
    return float(np.max(np.abs(np.asarray(found, np.float64) - velocity)))


def _angles(dtype: type) -> float:
    angles = np.linspace(-3.1, 3.1, 2001).astype(dtype)
    back = jax.jit(lambda x: jnp.arctan2(jnp.sin(x), jnp.cos(x)))(angles)
    exact = np.stack([np.sin(angles.astype(np.float64)), np.cos(angles.astype(np.float64))])
    direct = jax.jit(lambda x: jnp.stack([jnp.sin(x), jnp.cos(x)]))(angles)
    return float(
        max(
            np.max(np.abs(np.asarray(back, np.float64) - angles.astype(np.float64))),
            np.max(np.abs(np.asarray(direct, np.float64) - exact)),
        )
    )


def _batching(dtype: type) -> float:
    rows = np.random.default_rng(0).uniform(0, 1, (16, 41)).cumsum(axis=1).astype(dtype)
    single = jax.jit(_velocity_fit)
    together = np.asarray(jax.jit(jax.vmap(_velocity_fit))(rows))
    alone = np.stack([np.asarray(single(row)) for row in rows])
    return float(np.max(np.abs(together - alone)) / np.max(np.abs(alone)))


def stored_trajectories() -> np.ndarray:
    """Returns the four trajectories `[4, 41, 3]` of the stored scores, in the ego's frame."""
    # Speed m/s, acceleration m/s^2, sideways shift m.
    motions = ((8.0, 0.0, 0.0), (8.0, -2.0, 0.0), (8.0, 1.0, 3.5), (6.0, -1.0, -6.0))
    time = DT * np.arange(NUM_STATES)
    share = time / time[-1]
    poses = []
    for speed, acceleration, shift in motions:
        x = speed * time + acceleration / 2 * time**2
        y = shift * (3 * share**2 - 2 * share**3)
        poses.append(np.stack([x, y, np.arctan2(np.gradient(y), np.gradient(x))], axis=-1))
    return np.stack(poses)


def _scored_scene() -> float:
    scores = score(from_raw([make_scene(SCENE)]), stored_trajectories()).scores
    found = np.stack([np.asarray(getattr(scores, name))[0] for name in _SUB_SCORES], axis=-1)
    return float(np.max(np.abs(found - np.array(_STORED))))
