"""DTPP's tree of ego trajectories: two-stage expansion, pruning, selection.

The learned part enters as a function that scores branches, so everything here is pure geometry in
the ego's current frame (rear axle at the origin, x forward).

Source: DTPP, `TrajTree`, `SplinePlanner` and the planner around them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum, rank_of, true_indices
from spdm_jax.config import DT
from spdm_models.dtpp_paths import ReferencePaths
from spdm_models.lattice import ROW_SPACING, Course

STATE_COLUMNS = ("x", "y", "heading", "speed", "acceleration", "curvature")
"""Columns of a branch's states: m, m, rad, m/s, m/s^2, 1/m."""
MIN_END_GAP = 0.5
"""End points of one expansion lie at least this far apart, m."""
PATH_REACH = 0.1
"""A leaf goes on along the paths that pass this close, m."""

# Multiples of 1 / 2^14 below 2^9 have no rounding error in float32.
_GRID = 2.0**14


@dataclass(frozen=True)
class TreeConfig:
    """Static settings of the tree.

    Attributes:
      num_paths: reference paths.
      first_steps: steps of 0.1 s in the first stage.
      second_steps: steps of 0.1 s in the second stage.
      first_speeds: target speeds of the first stage.
      second_speeds: target speeds of the second stage.
      first_range: change of speed per second that the first stage's targets span, m/s^2.
      second_range: the same for the second stage.
      num_parents: leaves of the first stage that are expanded.
      num_branches: branches that are scored in a stage.
      reference_wrap: a speed profile that drives backwards beyond the path's start goes on from
        the path's end, as in the reference (an index below zero); else it stays at the start.
    """

    num_paths: int = 3
    first_steps: int = 30
    second_steps: int = 50
    first_speeds: int = 10
    second_speeds: int = 5
    first_range: tuple[float, float] = (-4.0, 2.4)
    second_range: tuple[float, float] = (-1.0, 1.0)
    num_parents: int = 5
    num_branches: int = 30
    reference_wrap: bool = False


class Branches(struct.PyTreeNode):
    """Ego trajectories of one stage, real ones first.

    Attributes:
      states: `[N, T, 6]` with columns `STATE_COLUMNS`, first at 0.1 s; zero where not valid.
      valid: `[N]` bool.
      parent: `[N]` int32 branch of the stage before, 0 in the first stage.
    """

    states: jax.Array
    valid: jax.Array
    parent: jax.Array


class TreePlan(struct.PyTreeNode):
    """Outcome of the search.

    Attributes:
      x: `[T]` m, ego frame, first at 0.1 s.
      y: `[T]` m.
      heading: `[T]` rad.
      valid: `[]` bool, False where no branch of 8 s exists; the poses are zero then.
      best: `[]` int32 the chosen branch of the second stage.
      first: branches of the first stage.
      first_scores: `[N]`, -inf where not valid.
      second: branches of both stages, start to end.
      second_scores: `[N]`, -inf where not valid.
      dropped: `[]` int32 branches of the second stage that were left out because of `num_branches`.
    """

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    valid: jax.Array
    best: jax.Array
    first: Branches
    first_scores: jax.Array
    second: Branches
    second_scores: jax.Array
    dropped: jax.Array


ScoreBranches = Callable[[Branches], jax.Array]


def target_speeds(
    speed: jax.Array, limit: jax.Array, seconds: float, span: tuple[float, float], num: int
) -> jax.Array:
    """Evenly spaced target speeds within reach, `[num]` m/s."""
    lowest = jnp.maximum(speed + span[0] * seconds, 0)
    highest = jnp.minimum(speed + span[1] * seconds, limit)
    # Counted from the nearer end, as torch's `linspace` is.
    index = jnp.arange(num, dtype=speed.dtype)
    step = (highest - lowest) / (num - 1)
    low, high = lowest + step * index, highest - step * (num - 1 - index)
    return jnp.where(index < num // 2, low, high)


def speed_coefficients(
    speed: jax.Array, acceleration: jax.Array, target: jax.Array, seconds: float | jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Cubic v(t) = c0 + c1 t + c2 t^2 + c3 t^3 that ends at the target with acceleration 0."""
    c2 = -2 * acceleration / seconds - 3 * speed / seconds**2 + 3 * target / seconds**2
    c3 = acceleration / seconds**2 + 2 * speed / seconds**3 - 2 * target / seconds**3
    return speed, acceleration, c2, c3


def exact_prefix_sum(values: jax.Array) -> jax.Array:
    """Inclusive sums along the last axis, rounded once (torch adds float32 in float64).

    Exact for float32 sums below 512 and values in `[..., N]` with N below 100.
    """
    coarse = jnp.round(values * _GRID) / _GRID
    return prefix_sum(coarse) + prefix_sum(values - coarse)


def expand(
    start: jax.Array,
    courses: Course,
    course_valid: jax.Array,
    limit: jax.Array,
    from_root: bool,
    config: TreeConfig,
) -> tuple[jax.Array, jax.Array]:
    """Drives every path from one state with every target speed.

    A profile that runs off its path is dropped, and so is one that ends within 0.5 m of a kept
    one before it (order: path, then speed).

    Args:
      start: `[>= 5]` state with columns `STATE_COLUMNS`.
      courses: `[R, L]` reference paths.
      course_valid: `[R]` bool.
      limit: `[]` speed limit, m/s.
      from_root: first stage (paths are driven from their start), else second.
      config: static settings.

    Returns:
      States `[R V, T, 6]` and which of them are kept `[R V]`.
    """
    steps = config.first_steps if from_root else config.second_steps
    num = config.first_speeds if from_root else config.second_speeds
    span = config.first_range if from_root else config.second_range
    seconds = steps * DT
    time = jnp.arange(steps + 1, dtype=start.dtype) * DT
    targets = target_speeds(start[3], limit, seconds, span, num)

    def profile(target):
        c0, c1, c2, c3 = speed_coefficients(start[3], start[4], target, seconds)
        speed = c0 + c1 * time + c2 * time**2 + c3 * time**3
        acceleration = c1 + 2 * c2 * time + 3 * c3 * time**2
        return exact_prefix_sum(speed[:-1] * DT), speed[1:], acceleration[1:]

    driven, speed, acceleration = jax.vmap(profile)(targets)
    # Behind the barrier the compiler cannot replace the division by a product with 10, which
    # rounds differently: at constant speed whole rows lie exactly on the border of a cell.
    spacing = jax.lax.optimization_barrier(jnp.asarray(ROW_SPACING, start.dtype))

    def follow(course, valid):
        if from_root:
            offset = jnp.zeros_like(start[0])
        else:
            index = jnp.arange(course.x.shape[0])
            gap = jnp.hypot(course.x - start[0], course.y - start[1])
            gap = jnp.where(index < course.count, gap, jnp.inf)
            valid = valid & (jnp.min(gap) <= PATH_REACH)
            offset = jnp.argmin(gap).astype(start.dtype) * ROW_SPACING
        row = jnp.trunc((offset + driven) / spacing).astype(jnp.int32)
        fits = row[:, -1] < course.count
        row = jnp.where(row < 0, row + course.count if config.reference_wrap else 0, row)
        row = jnp.clip(row, 0, course.count - 1)
        pose = (course.x[row], course.y[row], course.heading[row])
        states = jnp.stack([*pose, speed, acceleration, course.curvature[row]], -1)
        return states, valid & fits

    states, valid = jax.vmap(follow)(courses, course_valid)
    states, valid = states.reshape(-1, steps, len(STATE_COLUMNS)), valid.reshape(-1)
    end = states[:, -1, :2]
    near = jnp.hypot(*jnp.moveaxis(end[:, None] - end, -1, 0)) < MIN_END_GAP
    index = jnp.arange(valid.shape[0])

    def keep(i, kept):
        taken = jnp.any(kept & near[i] & (index < i))
        return kept.at[i].set(kept[i] & ~taken)

    return states, jax.lax.fori_loop(0, valid.shape[0], keep, valid)


def _gather(states: jax.Array, parent: jax.Array, kept: jax.Array, num: int) -> Branches:
    index, real = true_indices(kept, num)
    states = jnp.where(real[:, None, None], states[index], 0)
    return Branches(states, real, jnp.where(real, parent[index], 0))


def first_stage(
    paths: ReferencePaths,
    speed: jax.Array,
    acceleration: jax.Array,
    limit: jax.Array,
    config: TreeConfig,
) -> Branches:
    """Expands the ego's current state.

    Args:
      paths: in the ego frame.
      speed: `[]` m/s.
      acceleration: `[]` m/s^2.
      limit: `[]` speed limit, m/s.
      config: static settings.

    Raises:
      ValueError: more combinations of path and speed than branches.
    """
    combinations = config.num_paths * config.first_speeds
    if combinations > config.num_branches:
        raise ValueError(
            f"TreeConfig: num_paths {config.num_paths} x first_speeds {config.first_speeds} = "
            f"{combinations} exceeds num_branches {config.num_branches}; raise num_branches"
        )
    zero = jnp.zeros_like(speed)
    start = jnp.stack([zero, zero, zero, speed, acceleration])
    states, kept = expand(start, paths.course, paths.valid, limit, True, config)
    return _gather(states, jnp.zeros(kept.shape[0], jnp.int32), kept, config.num_branches)


def second_stage(
    paths: ReferencePaths,
    first: Branches,
    scores: jax.Array,
    limit: jax.Array,
    config: TreeConfig,
    key: jax.Array | None = None,
) -> tuple[Branches, jax.Array]:
    """Expands the best leaves of the first stage, in the order of their branches.

    Args:
      paths: in the ego frame.
      first: branches of the first stage.
      scores: `[N]`, higher is better, -inf where not valid.
      limit: `[]` speed limit, m/s.
      config: static settings.
      key: typed random key that picks the branches to keep where there are too many (the
        reference draws them at random); without one, every leaf keeps its first ones.

    Returns:
      Branches from the ego's current state on, and how many were left out `[]`.
    """
    best = jnp.sort(jax.lax.top_k(scores, config.num_parents)[1])
    grow = jax.vmap(lambda start: expand(start, paths.course, paths.valid, limit, False, config))
    states, kept = grow(first.states[best, -1])
    kept = kept & (first.valid & jnp.isfinite(scores))[best][:, None]
    trunk = first.states[best][:, None]
    trunk = jnp.broadcast_to(trunk, (*states.shape[:2], *trunk.shape[2:]))
    states = jnp.concatenate([trunk, states], axis=2).reshape(kept.size, -1, states.shape[-1])
    parent = jnp.repeat(best, kept.shape[1])
    if key is None:
        priority = jnp.cumsum(kept, axis=1).reshape(-1).astype(states.dtype)
    else:
        priority = jax.random.uniform(key, (kept.size,), states.dtype)
    kept = kept.reshape(-1)
    chosen = kept & (rank_of(jnp.where(kept, priority, jnp.inf)) < config.num_branches)
    dropped = jnp.sum(kept) - jnp.sum(chosen)
    return _gather(states, parent, chosen, config.num_branches), dropped


def plan_tree(
    paths: ReferencePaths,
    speed: jax.Array,
    acceleration: jax.Array,
    limit: jax.Array,
    score: ScoreBranches,
    config: TreeConfig,
    key: jax.Array | None = None,
) -> TreePlan:
    """Grows both stages and picks the branch with the best sum of its two scores.

    Args:
      paths: in the ego frame.
      speed: `[]` m/s.
      acceleration: `[]` m/s^2.
      limit: `[]` speed limit, m/s.
      score: scores the branches of a stage (30 or 80 steps) `[N]`, higher is better.
      config: static settings.
      key: see `second_stage`.
    """
    first = first_stage(paths, speed, acceleration, limit, config)
    first_scores = jnp.where(first.valid, score(first), -jnp.inf)
    second, dropped = second_stage(paths, first, first_scores, limit, config, key)
    second_scores = jnp.where(second.valid, score(second), -jnp.inf)
    total = jnp.where(second.valid, first_scores[second.parent] + second_scores, -jnp.inf)
    best = jnp.argmax(total).astype(jnp.int32)
    pose = second.states[best, :, :3]
    return TreePlan(
        x=pose[:, 0],
        y=pose[:, 1],
        heading=pose[:, 2],
        valid=jnp.any(second.valid),
        best=best,
        first=first,
        first_scores=first_scores,
        second=second,
        second_scores=second_scores,
        dropped=dropped,
    )
