"""Paths of reactive agents: baselines joined as the simulation proceeds.

A path starts where the agent stood when it was last extended and ends at the last retained point of
the last lane of its route.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import nth_true, prefix_sum, true_entries
from spdm_jax.geometry import PADDED_PROGRESS, principal, unwrap_masked
from spdm_jax.types import Array, Lanes

_REPEATED = 1e-8
"""Points closer than this to their successor are dropped, m (NumPy's `isclose` to 0)."""
_CURVATURE_REACH = 4.0
"""Arc length over which the curvature at a lane's start is estimated, m."""


class AgentPath(struct.PyTreeNode, kw_only=True):
    """Path of one agent (or of all, with a leading axis).

    Attributes:
      x, y: `[M]` m; padding repeats the last point.
      heading: `[M]` rad, unwrapped.
      progress: `[M]` arc length from the path's start, m; padding is a large number.
      count: `[]` int32 number of points.
    """

    x: Array
    y: Array
    heading: Array
    progress: Array
    count: Array


def path_end(path: AgentPath) -> jax.Array:
    """Arc length of the path's last point, m."""
    return path.progress[jnp.maximum(path.count - 1, 0)]


def start_of_rest(path: AgentPath, progress: jax.Array) -> jax.Array:
    """Arc length at which the remaining path starts, m.

    That of the agent; for one at or beyond the path's end, the last point but one.

    Source: nuPlan `trim_path_up_to_progress`.
    """
    end = path_end(path)
    last = path.progress[jnp.maximum(path.count - 2, 0)]
    return jnp.where(progress >= end, last, jnp.maximum(progress, 0))


def path_pose(path: AgentPath, progress: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pose at one arc length within the path; heading in [-pi, pi).

    Source: nuPlan `InterpolatedPath.get_state_at_progress`.
    """
    right = jnp.sum((path.progress <= progress).astype(jnp.int32))
    right = jnp.clip(right, 1, jnp.maximum(path.count - 1, 1))
    begin, end = path.progress[right - 1], path.progress[right]
    share = jnp.clip((progress - begin) / jnp.where(end > begin, end - begin, 1), 0, 1)
    mix = lambda v: v[right - 1] + share * (v[right] - v[right - 1])
    return mix(path.x), mix(path.y), principal(mix(path.heading))


def append_lane(
    path: AgentPath, progress: jax.Array, lanes: Lanes, lane: jax.Array
) -> tuple[AgentPath, jax.Array]:
    """Path from `progress` on, followed by the baseline of a lane.

    A new path loses its last point, and every point that coincides with its successor.

    Args:
      path: path so far; `count` 0 gives the lane's baseline alone.
      progress: arc length at which the new path starts, m.
      lanes: lane table.
      lane: `[]` int32 lane to append.

    Returns:
      The new path (progress starts at 0) and whether it did not fit.

    Source: nuPlan `create_path_from_se2`.
    """
    size = path.x.shape[0]
    line = lanes.centerline
    passed = jnp.sum((path.progress <= progress).astype(jnp.int32))
    some = (path.count > 0).astype(jnp.int32)
    kept = some * (1 + path.count - jnp.minimum(passed, path.count))
    total = kept + line.count[lane]
    # Twice the room: whatever is dropped must not cost a point that fits.
    index = jnp.arange(2 * size)
    old = jnp.clip(passed + index - 1, 0, size - 1)
    new = jnp.clip(line.start[lane] + index - kept, 0, line.points.shape[0] - 1)
    here = path_pose(path, progress)

    def join(now, before, after):
        return jnp.where(index >= kept, after[new], jnp.where(index == 0, now, before[old]))

    x = join(here[0], path.x, line.points[:, 0])
    y = join(here[1], path.y, line.points[:, 1])
    heading = join(here[2], path.heading, line.points[:, 2])
    step = jnp.hypot(jnp.diff(x), jnp.diff(y))
    retained = (index[:-1] < total - 1) & (step > _REPEATED)
    entries = true_entries(retained)
    count = jnp.minimum(entries.total, size)
    pick = nth_true(entries, jnp.minimum(jnp.arange(1, size + 1), jnp.maximum(count, 1)))
    valid = jnp.arange(size) < count
    x, y, heading = x[pick], y[pick], unwrap_masked(heading[pick], valid)
    chord = jnp.hypot(jnp.diff(x), jnp.diff(y))
    along = jnp.concatenate([jnp.zeros_like(x[:1]), prefix_sum(chord)])
    along = jnp.where(valid, along, jnp.asarray(PADDED_PROGRESS, x.dtype))
    joined = AgentPath(x=x, y=y, heading=heading, progress=along, count=count.astype(jnp.int32))
    return joined, (entries.total > size) | (total > 2 * size)


def empty_path(size: int, dtype) -> AgentPath:
    """A path without points, to append the first lane to."""
    zero = jnp.zeros(size, dtype)
    return AgentPath(
        x=zero, y=zero, heading=zero, progress=zero + PADDED_PROGRESS, count=jnp.int32(0)
    )


def path_from(path: AgentPath, progress: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Vertices `[M]` of the path from an arc length on; what lies behind collapses to its start."""
    x, y, _ = path_pose(path, progress)
    behind = path.progress <= progress
    return jnp.where(behind, x, path.x), jnp.where(behind, y, path.y)


def path_between(
    path: AgentPath, start: jax.Array, end: jax.Array, size: int
) -> tuple[jax.Array, jax.Array]:
    """Vertices `[size]` of the path between two arc lengths; the last one repeats.

    More vertices than fit are thinned evenly.
    """
    x0, y0, _ = path_pose(path, start)
    x1, y1, _ = path_pose(path, end)
    first = jnp.sum((path.progress <= start).astype(jnp.int32))
    between = jnp.sum((path.progress < end).astype(jnp.int32)) - first
    stride = jnp.maximum(-(-between // (size - 2)), 1)
    index = jnp.arange(size)
    offset = (index - 1) * stride
    pick = jnp.clip(first + offset, 0, path.x.shape[0] - 1)
    inside = offset < between

    def choose(begin, values, finish):
        return jnp.where(index == 0, begin, jnp.where(inside, values[pick], finish))

    return choose(x0, path.x, x1), choose(y0, path.y, y1)


def start_curvature(lanes: Lanes) -> jax.Array:
    """Curvature of each baseline at its start, 1/m, `[L]` (absolute value).

    That of the circle through the baseline's points at 0, 2 and 4 m (or over its whole length).

    Source: nuPlan `estimate_curvature_along_path`.
    """
    line = lanes.centerline
    num = line.points.shape[0]
    x, y = line.points[:, 0], line.points[:, 1]
    following = jnp.minimum(jnp.arange(num) + 1, num - 1)
    same = (line.row[following] == line.row) & line.valid & line.valid[following]
    length = jnp.where(same, jnp.hypot(x[following] - x, y[following] - y), 0)
    reach = jnp.minimum(jnp.asarray(_CURVATURE_REACH, x.dtype), lanes.length)

    def point(lane, at):
        """Walks the first segments of a lane; those within reach are few."""

        def more(state):
            k, rest = state
            return (rest > length[k]) & (k + 2 < line.start[lane] + line.count[lane])

        def go(state):
            k, rest = state
            return k + 1, rest - length[k]

        k, rest = jax.lax.while_loop(more, go, (line.start[lane], at))
        share = jnp.where(length[k] > 0, rest / jnp.where(length[k] > 0, length[k], 1), 0)
        after = jnp.minimum(k + 1, num - 1)
        return x[k] + share * (x[after] - x[k]), y[k] + share * (y[after] - y[k])

    lane = jnp.arange(lanes.valid.shape[0])
    (ax, ay), (bx, by), (cx, cy) = (jax.vmap(point)(lane, f * reach) for f in (0.0, 0.5, 1.0))
    area = jnp.abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    sides = jnp.hypot(bx - ax, by - ay) * jnp.hypot(cx - bx, cy - by) * jnp.hypot(cx - ax, cy - ay)
    return jnp.where(sides > 0, 2 * area / jnp.where(sides > 0, sides, 1), 0)
