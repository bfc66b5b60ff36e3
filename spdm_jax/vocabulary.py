"""Trajectory vocabularies: ego futures of a recording, and k-means over many trajectories (host).

All arrays are NumPy. The same trajectories and seed give the same vocabulary, byte for byte, on the
same machine and libraries: distances are float32 matrix products, everything that ends up in the
result is summed in float64 in a fixed order.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spdm_jax.config import NUM_STATES
from spdm_jax.types import EgoState

MAX_ITERATIONS = 50
"""Rounds of k-means at most."""
TOLERANCE = 5e-4
"""k-means ends when a round lowers the inertia by less than this part of it."""
_RESOLUTION = 1e-3  # m; trajectories closer than that are the same one
_BLOCK = 2**20  # distances in memory at a time


@dataclass(frozen=True)
class Vocabulary:
    """Cluster centres and how well they stand for what was clustered.

    Attributes:
      trajectories: `[V, 41, 3]` float32 x, y, heading in the ego frame, 0.1 s apart; the most
        frequent ones first.
      sizes: `[V]` int64, trajectories of each cluster.
      inertia: mean squared distance of a pose to that of its cluster's centre, m^2.
      largest: root mean squared distance of the trajectory that is worst off, m.
      num_trajectories: trajectories that were clustered.
      num_distinct: of them, different ones.
      iterations: rounds of k-means.
      converged: whether the last round gained next to nothing.
    """

    trajectories: np.ndarray
    sizes: np.ndarray
    inertia: float
    largest: float
    num_trajectories: int
    num_distinct: int
    iterations: int
    converged: bool


def ego_futures(ego: EgoState, ego_valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cuts a recording into the futures of all its steps.

    Args:
      ego: `[T]` recorded states, 0.1 s apart; x, y and heading are read.
      ego_valid: `[T]` bool.

    Returns:
      `[N, 41, 3]` float64 poses in the ego frame of their first step, and `[N]` these steps: all
      with 4 s of valid states ahead.
    """
    poses = np.stack([ego.x, ego.y, np.unwrap(ego.heading)], axis=-1).astype(np.float64)
    if len(poses) < NUM_STATES:
        return np.zeros((0, NUM_STATES, 3)), np.zeros(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(poses, NUM_STATES, axis=0)
    valid = np.lib.stride_tricks.sliding_window_view(np.asarray(ego_valid, bool), NUM_STATES)
    steps = np.flatnonzero(valid.all(axis=1))
    return in_ego_frame(np.moveaxis(windows[steps], 1, 2)), steps


def in_ego_frame(poses: np.ndarray) -> np.ndarray:
    """Moves trajectories `[N, T, 3]` into the frame of their first pose, which becomes 0."""
    x, y = (poses[..., i] - poses[:, :1, i] for i in range(2))
    heading = poses[:, :1, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    turned = np.unwrap(poses[..., 2], axis=1)
    return np.stack([cos * x + sin * y, cos * y - sin * x, turned - turned[:, :1]], axis=-1)


def build_vocabulary(
    trajectories: np.ndarray,
    size: int,
    seed: int = 0,
    *,
    max_iterations: int = MAX_ITERATIONS,
    progress: Callable[[str, int, int], None] | None = None,
) -> Vocabulary:
    """Clusters trajectories by k-means over their positions.

    The first centres are drawn by k-means++. A centre is the mean of its trajectories, headings
    included; distances look at positions only, which say where a trajectory heads.

    Args:
      trajectories: `[N, T, 3]` in the ego frame, 0.1 s apart.
      size: V, number of clusters.
      seed: of the first centres.
      max_iterations: rounds at most.
      progress: told the stage ("seeding", "rounds"), and how much of it is done, of how much.

    Raises:
      ValueError: wrong shape, a value that is not finite, or fewer different trajectories than
        clusters.
    """
    values = np.asarray(trajectories, np.float64)
    if values.ndim != 3 or values.shape[-1] != 3:
        raise ValueError(f"trajectories has shape {values.shape}; expected [N, T, 3]")
    if size < 1:
        raise ValueError(f"size is {size}; a vocabulary has at least 1 trajectory")
    if not np.isfinite(values).all():
        raise ValueError("trajectories has values that are not finite; leave these rows out")
    rows, weights = _distinct(values)
    if len(rows) < size:
        raise ValueError(
            f"{len(values)} trajectories, {len(rows)} of them different (by more than "
            f"{_RESOLUTION:g} m): fewer than the {size} clusters asked for. Use more scenarios or "
            f"a size of at most {len(rows)}"
        )
    tell = progress or (lambda stage, done, total: None)
    points = values[rows, :, :2].reshape(len(rows), -1)
    middle = np.average(points, axis=0, weights=weights)
    # Distances in float32 lose less near the origin.
    near = (points - middle).astype(np.float32)
    chosen = _first_centers(near, weights, size, np.random.default_rng(seed), tell)
    centers = points[chosen]
    label, square = _nearest(near, (centers - middle).astype(np.float32))
    inertia, rounds, converged = _mean(square, weights), 0, False
    while rounds < max_iterations and not converged:
        centers = _means(points, weights, label, square, size)
        label, square = _nearest(near, (centers - middle).astype(np.float32))
        rounds, before, inertia = rounds + 1, inertia, _mean(square, weights)
        converged = before - inertia <= TOLERANCE * before
        tell("rounds", rounds, max_iterations)
    return _summary(values, rows, weights, label, size, rounds, converged)


def _distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns rows of the different trajectories, in order, and how often each occurs."""
    count, steps = values.shape[:2]
    grid = np.rint(values[..., :2] / _RESOLUTION).astype(np.int32).reshape(count, 2 * steps)
    # Rows as opaque bytes: sorting them is all that is needed.
    opaque = np.ascontiguousarray(grid).view(np.dtype((np.void, 8 * steps))).reshape(count)
    _, first, count = np.unique(opaque, return_index=True, return_counts=True)
    order = np.argsort(first)
    return first[order], count[order].astype(np.float64)


def _first_centers(
    points: np.ndarray,
    weights: np.ndarray,
    size: int,
    generator: np.random.Generator,
    tell: Callable[[str, int, int], None],
) -> np.ndarray:
    """Draws rows by k-means++ (Arthur and Vassilvitskii, 2007): far from those drawn before."""
    chosen = np.zeros(size, np.int64)
    draw = generator.random(size)
    mass = np.cumsum(weights)
    chosen[0] = np.searchsorted(mass, draw[0] * mass[-1], side="right")
    closest = _squares(points, points[chosen[0]])
    label = np.zeros(len(points), np.int64)
    for i in range(1, size):
        mass = np.cumsum(weights * closest)
        row = int(np.searchsorted(mass, draw[i] * mass[-1], side="right"))
        if row == len(points) or not closest[row]:
            # What is left is closer than float32 can tell; any row not drawn yet will do.
            row = int(np.setdiff1d(np.arange(len(points)), chosen[:i])[0])
        chosen[i] = row
        # Triangle inequality: the new centre wins only points less than half as far from theirs as
        # the two centres are from each other.
        apart = _squares(points[chosen[:i]], points[row])
        near = np.flatnonzero(4 * closest > apart[label])
        square = _squares(points[near], points[row])
        won = square < closest[near]
        closest[near[won]] = square[won]
        label[near[won]] = i
        closest[row] = 0
        tell("seeding", i + 1, size)
    return chosen


def _squares(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns squared distances, float64."""
    away = points - center
    return np.einsum("nd,nd->n", away, away).astype(np.float64)


def _nearest(points: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nearest centre of each point and the squared distance to it."""
    label = np.zeros(len(points), np.int64)
    square = np.zeros(len(points))
    # |x - c|^2 - |x|^2 as one matrix product.
    length = np.einsum("kd,kd->k", centers, centers)
    table = np.ascontiguousarray(np.vstack([-2 * centers.T, length]))
    step = max(1, _BLOCK // len(centers))
    for begin in range(0, len(points), step):
        part = points[begin : begin + step]
        product = np.column_stack([part, np.ones(len(part), np.float32)]) @ table
        found = np.argmin(product, axis=1)
        label[begin : begin + step] = found
        away = part - centers[found]
        square[begin : begin + step] = np.einsum("nd,nd->n", away, away)
    return label, square


def _means(
    points: np.ndarray, weights: np.ndarray, label: np.ndarray, square: np.ndarray, size: int
) -> np.ndarray:
    """Returns the mean of each cluster; an empty one gets the point that is worst off."""
    mass = np.bincount(label, weights, minlength=size)
    order = np.argsort(label, kind="stable")
    filled = np.flatnonzero(mass)
    starts = np.searchsorted(label[order], filled)
    sums = np.add.reduceat(points[order] * weights[order, None], starts, axis=0)
    centers = np.empty((size, points.shape[1]))
    centers[filled] = sums / mass[filled, None]
    empty = np.flatnonzero(mass == 0)
    centers[empty] = points[np.argsort(-square, kind="stable")[: len(empty)]]
    return centers


def _mean(square: np.ndarray, weights: np.ndarray) -> float:
    return float(np.sum(square * weights) / np.sum(weights))


def _summary(
    values: np.ndarray,
    rows: np.ndarray,
    weights: np.ndarray,
    label: np.ndarray,
    size: int,
    rounds: int,
    converged: bool,
) -> Vocabulary:
    """Means of whole trajectories, headings included, and how far their members are from them."""
    steps = values.shape[1]
    flat = values[rows].reshape(len(rows), -1)
    none = np.zeros(len(rows))
    sizes = np.bincount(label, weights, minlength=size).astype(np.int64)
    centers = _means(flat, weights, label, none, size).reshape(size, steps, 3)
    away = values[rows, :, :2] - centers[label, :, :2]
    square = np.mean(np.sum(away**2, axis=-1), axis=-1)
    order = np.argsort(-sizes, kind="stable")
    return Vocabulary(
        trajectories=centers[order].astype(np.float32),
        sizes=sizes[order],
        inertia=_mean(square, weights),
        largest=float(np.sqrt(square.max())),
        num_trajectories=len(values),
        num_distinct=len(rows),
        iterations=rounds,
        converged=converged,
    )
