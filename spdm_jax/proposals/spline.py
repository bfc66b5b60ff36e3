"""Stage 2 of SPDM: paths onto route lanes, driven with cubic speed profiles.

Paper, Section "Spline-Fitting PDM". A path starts with a cubic Bezier from the ego's pose to a pose
on a route lane, a merge distance ahead, and follows the lane from there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import order_of, prefix_sum
from spdm_jax.config import DT, SplineParams
from spdm_jax.geometry import Path, interpolate, make_path, project, unwrap_masked, wrap
from spdm_jax.proposals.lanes import sequence_path
from spdm_jax.proposals.oncoming import OncomingLane, lateral_offset
from spdm_jax.types import EgoState, Lanes, Route

CURVE_POINTS = 65
"""Samples of the connecting curve, both ends included."""
OWN_LANE_HORIZON = 100.0
"""A branch that stays on the centreline this far beyond its start lane is the own lane, m."""
_SUBSTEPS = 16  # of a 0.1 s interval in which the speed is clipped


class RouteLanePaths(NamedTuple):
    """The K paths of stage 2.

    Attributes:
      path: `Path` `[K, M]`, arc length 0 at the ego.
      valid: `[K]` bool.
      lane: `[K]` int32 first lane of the branch, -1 where invalid.
      overflow: `[]` bool, a path did not fit its buffer.
      borrowed: `[K]` bool, the path is the oncoming lane's; None where none is offered.
    """

    path: Path
    valid: jax.Array
    lane: jax.Array
    overflow: jax.Array
    borrowed: jax.Array | None = None


def bezier(
    start: tuple[jax.Array, jax.Array, jax.Array],
    end: tuple[jax.Array, jax.Array, jax.Array],
    num: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cubic Bezier between two poses, control points offset by a third of the gap.

    Args:
      start: x, y, heading.
      end: x, y, heading.
      num: samples, both ends included.

    Returns:
      x, y, heading `[num]`.
    """
    x0, y0, h0 = start
    x3, y3, h3 = end
    third = jnp.hypot(x3 - x0, y3 - y0) / 3
    control = (
        jnp.stack([x0, x0 + third * jnp.cos(h0), x3 - third * jnp.cos(h3), x3]),
        jnp.stack([y0, y0 + third * jnp.sin(h0), y3 - third * jnp.sin(h3), y3]),
    )
    t = jnp.linspace(0, 1, num, dtype=x3.dtype)
    u = 1 - t
    weights = jnp.stack([u**3, 3 * u * u * t, 3 * u * t * t, t**3])
    slopes = jnp.stack([3 * u * u, 6 * u * t, 3 * t * t])
    high = jax.lax.Precision.HIGHEST
    x, y = (jnp.matmul(p, weights, precision=high) for p in control)
    dx, dy = (jnp.matmul(jnp.diff(p), slopes, precision=high) for p in control)
    return x, y, jnp.arctan2(dy, dx)


def cubic_speed(
    v0: jax.Array, a0: jax.Array, target: jax.Array, horizon: jax.Array
) -> tuple[jax.Array, ...]:
    """Coefficients c0 ... c3 of v(t) with v(0) = v0, v'(0) = a0, v(T_f) = target, v'(T_f) = 0.

    Paper, Equation of the speed profile: c2 = 3 D / T_f^2 - 2 a0 / T_f, c3 = a0 / T_f^2 - 2 D /
    T_f^3 with D = target - v0.
    """
    gap = target - v0
    c2 = 3 * gap / horizon**2 - 2 * a0 / horizon
    c3 = a0 / horizon**2 - 2 * gap / horizon**3
    return v0, a0, c2, c3


def cubic_distance(
    v0: jax.Array, a0: jax.Array, target: jax.Array, horizon: jax.Array, num_states: int
) -> jax.Array:
    """Arc length driven at 0, 0.1, ... s, `[num_states]`.

    In closed form; the speed is clipped at 0 where the cubic undershoots (integrated numerically
    over those intervals) and held at the target beyond T_f.
    """
    c0, c1, c2, c3 = cubic_speed(v0, a0, target, horizon)

    def speed(t):
        return c0 + t * (c1 + t * (c2 + t * c3))

    def integral(t):
        return t * (c0 + t * (c1 / 2 + t * (c2 / 3 + t * (c3 / 4))))

    time = jnp.arange(num_states, dtype=target.dtype) * DT
    inside = jnp.minimum(time, horizon)
    begin, end = inside[:-1], inside[1:]
    step = integral(end) - integral(begin)
    fraction = (jnp.arange(_SUBSTEPS, dtype=target.dtype) + 0.5) / _SUBSTEPS
    fine = speed(begin[:, None] + (end - begin)[:, None] * fraction)
    clipped = jnp.mean(jnp.maximum(fine, 0), axis=1) * (end - begin)
    step = jnp.where(jnp.any(fine < 0, axis=1), clipped, step)
    held = jnp.diff(jnp.maximum(time - horizon, 0)) * jnp.maximum(target, 0)
    return jnp.concatenate([jnp.zeros_like(time[:1]), prefix_sum(step + held)])


class _Candidates(NamedTuple):
    """Branches `[M]` that start beside the ego."""

    path: Path  # [M, N]
    at: jax.Array  # ego's arc length
    lane: jax.Array
    own: jax.Array
    usable: jax.Array
    key: jax.Array  # order among the branches
    overflow: jax.Array


def _candidates(
    lanes: Lanes,
    route: Route,
    slot: jax.Array,
    block: jax.Array,
    centerline: Path,
    goal: Path,
    ego: EgoState,
    max_points: int,
) -> _Candidates:
    first = route.branch_start
    usable = (first >= 0) & (lanes.roadblock[first] == block)
    path, overflow = jax.vmap(lambda seq: sequence_path(lanes.centerline, seq, max_points))(
        route.branch_lanes
    )
    at = jax.vmap(lambda p: project(p, ego.x, ego.y))(path)

    # Own lane: everything up to 100 m beyond the start lane lies on the centreline.
    sequence = route.branch_lanes
    centre_lanes = route.centerline_lanes[slot]
    on_centre = jnp.zeros(lanes.valid.shape[0] + 1, bool).at[centre_lanes].set(centre_lanes >= 0)
    length = jnp.where(sequence >= 0, lanes.length[sequence], 0)
    ahead = jnp.cumsum(length, axis=1) - length - length[:, :1]
    near = (sequence >= 0) & (ahead < OWN_LANE_HORIZON)
    own = jnp.all(jnp.where(near, on_centre[sequence], True), axis=1)

    # Lateral position of each branch relative to the centreline, beside the ego.
    x, y, _ = jax.vmap(interpolate)(path, at)
    offset = lateral_offset(centerline, x, y)
    goal_x, goal_y, _ = interpolate(goal, project(goal, ego.x, ego.y))
    goal_offset = lateral_offset(centerline, goal_x, goal_y)
    to_goal = jnp.where(jnp.abs(goal_offset) > 0.5, jnp.sign(goal_offset), 0)
    goal_side = (to_goal != 0) & (jnp.sign(offset) == to_goal)
    # Half-metre steps, so that equal lanes left and right do not swap by rounding; left first.
    distance = 2 * jnp.round(2 * jnp.abs(offset)) + jnp.where(offset > 0, 0, 1)
    key = jnp.where(goal_side, 0, 10_000) + jnp.minimum(distance, 9_999)
    return _Candidates(path, at, first, own, usable, key, jnp.any(overflow & usable))


def _with_oncoming(found: _Candidates, oncoming: OncomingLane) -> _Candidates:
    """Adds the oncoming lane as a last branch, which starts beside the ego."""
    more = _Candidates(
        path=oncoming.path,
        at=jnp.zeros_like(oncoming.path.length),
        lane=oncoming.lane,
        own=jnp.bool_(False),
        usable=oncoming.usable,
        key=jnp.zeros((), found.key.dtype),
        overflow=found.overflow,
    )
    join = lambda a, b: jnp.concatenate([a, b[None]]) if a.ndim > b.ndim else a
    return jax.tree.map(join, found, more)


def route_lane_paths(
    lanes: Lanes,
    route: Route,
    slot: jax.Array,
    block: jax.Array,
    centerline: Path,
    goal: Path,
    ego: EgoState,
    params: SplineParams,
    num_paths: int,
    max_points: int,
    oncoming: OncomingLane | None = None,
) -> RouteLanePaths:
    """Builds the K paths of stage 2 in their fixed order.

    Order: lanes other than the centreline's before its own; merge distance outermost (4 s, 2 s, 6
    s); within it the goal side first, then by lateral distance from the centreline. A smaller K is
    a prefix of a larger one.

    The oncoming lane, where one is given, comes between the two: after lanes on which one drives
    the right way, and before the own lane, to which stage 1 leads back as well, so that on a road
    with one lane per direction K = 1 already holds it.

    Args:
      lanes: lane table.
      route: route tables.
      slot: `[]` centreline slot.
      block: `[]` roadblock the ego is in.
      centerline: stage-1 centreline.
      goal: goal path.
      ego: current state, scalars.
      params: merge distances.
      num_paths: K.
      max_points: room for a branch's points.
      oncoming: lane to borrow, or None.

    Returns:
      `RouteLanePaths`; rows beyond the available lanes x merge distances are masked.
    """
    found = _candidates(lanes, route, slot, block, centerline, goal, ego, max_points)
    if oncoming is not None:
        found = _with_oncoming(found, oncoming)
    merge_times = jnp.asarray(params.merge_times, ego.x.dtype)
    num_merges, num_branches = merge_times.shape[0], found.lane.shape[0]
    distance = jnp.clip(
        merge_times * jnp.maximum(ego.vx, params.merge_min_speed),
        params.merge_min_distance,
        params.merge_max_distance,
    )
    merge = jnp.repeat(jnp.arange(num_merges), num_branches)
    branch = jnp.tile(jnp.arange(num_branches), num_merges)
    reach = found.at[branch] + distance[merge]
    fits = reach < found.path.length[branch]
    usable = found.usable[branch] & fits
    if oncoming is None:
        rank = order_of(branch, found.key[branch], merge, found.own[branch], ~usable)
    else:
        borrowed = branch == num_branches - 1
        group = jnp.where(borrowed, 1, jnp.where(found.own[branch], 2, 0))
        rank = order_of(branch, found.key[branch], merge, group, ~usable)
    chosen = rank[:num_paths]
    if chosen.shape[0] < num_paths:
        chosen = jnp.pad(chosen, (0, num_paths - chosen.shape[0]), constant_values=rank[-1])
    valid = usable[chosen] & (jnp.arange(num_paths) < rank.shape[0])

    def connect(index):
        path = jax.tree.map(lambda v: v[branch[index]], found.path)
        joint = interpolate(path, reach[index])
        x, y, heading = bezier((ego.x, ego.y, ego.heading), joint, CURVE_POINTS)
        beyond = jnp.sum(path.progress <= reach[index])
        rest = jnp.maximum(path.count - beyond, 0)
        position = jnp.arange(CURVE_POINTS + max_points)
        source = jnp.clip(beyond + position - CURVE_POINTS, 0, max_points - 1)
        on_curve = position < CURVE_POINTS
        curve = jnp.minimum(position, CURVE_POINTS - 1)
        pick = lambda a, b: jnp.where(on_curve, a[curve], b[source])
        count = (CURVE_POINTS + rest).astype(jnp.int32)
        angle = unwrap_masked(pick(heading, wrap(path.heading)), position < count)
        return make_path(pick(x, path.x), pick(y, path.y), angle, count)

    return RouteLanePaths(
        path=jax.vmap(connect)(chosen),
        valid=valid,
        lane=jnp.where(valid, found.lane[branch[chosen]], -1).astype(jnp.int32),
        overflow=found.overflow,
        borrowed=None if oncoming is None else valid & (branch[chosen] == num_branches - 1),
    )


def drive(
    paths: RouteLanePaths,
    ego: EgoState,
    target_speed: jax.Array,
    params: SplineParams,
    num_states: int,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Drives every path with every speed profile.

    Args:
      paths: `[K]` paths.
      ego: current state, scalars.
      target_speed: `[S]` m/s.
      params: horizon of the cubic.
      num_states: T.

    Returns:
      x, y, heading `[K, S, T]` and validity `[K, S]`: a profile that runs past its path's end is
      invalid.
    """
    horizon = jnp.asarray(params.horizon, target_speed.dtype)
    distance = jax.vmap(lambda target: cubic_distance(ego.vx, ego.ax, target, horizon, num_states))(
        target_speed
    )
    pose = jax.vmap(lambda path: interpolate(path, distance))(paths.path)
    fits = distance[None, :, -1] <= paths.path.length[:, None]
    return *pose, paths.valid[:, None] & fits
