"""Plane geometry on plain arrays: angles, boxes, polylines.

Everything broadcasts; nothing here knows about scenarios. Boxes are given by centre, cos/sin of
their heading and half extents, so that a fused loop needs no trigonometry per pair.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum
from spdm_jax.types import EgoState


class Box(NamedTuple):
    """Oriented boxes; all fields broadcast against each other.

    Attributes:
      x, y: centre, m.
      cos, sin: of the heading.
      half_length, half_width: m.
    """

    x: jax.Array
    y: jax.Array
    cos: jax.Array
    sin: jax.Array
    half_length: jax.Array
    half_width: jax.Array


def wrap(angle: jax.Array) -> jax.Array:
    """Wraps angles to [-pi, pi] (tuplan_garage `normalize_angle`; differs: no trigonometry)."""
    turn = jnp.asarray(2 * jnp.pi, angle.dtype)
    return angle - turn * jnp.round(angle / turn)


def principal(angle: jax.Array) -> jax.Array:
    """Wraps angles to [-pi, pi) (nuPlan `principal_value`)."""
    turn = jnp.asarray(2 * jnp.pi, angle.dtype)
    return angle - turn * jnp.floor(angle / turn + 0.5)


def box_at(x, y, heading, half_length, half_width) -> Box:
    """Returns boxes from centre poses."""
    return Box(x, y, jnp.cos(heading), jnp.sin(heading), half_length, half_width)


def ego_box(ego: EgoState, vehicle) -> Box:
    """Returns the ego's box; `ego` holds rear-axle states of any shape."""
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    reach = vehicle.rear_axle_to_center
    return Box(
        ego.x + reach * cos,
        ego.y + reach * sin,
        cos,
        sin,
        jnp.asarray(0.5 * vehicle.length, ego.x.dtype),
        jnp.asarray(0.5 * vehicle.width, ego.x.dtype),
    )


def box_corners(box: Box) -> tuple[jax.Array, jax.Array]:
    """Returns corner x and y, each `[..., 4]`: front left, rear left, rear right, front right."""
    fx, fy = box.half_length * box.cos, box.half_length * box.sin
    lx, ly = -box.half_width * box.sin, box.half_width * box.cos
    x = jnp.stack([box.x + fx + lx, box.x - fx + lx, box.x - fx - lx, box.x + fx - lx], -1)
    y = jnp.stack([box.y + fy + ly, box.y - fy + ly, box.y - fy - ly, box.y + fy - ly], -1)
    return x, y


def boxes_overlap(a: Box, b: Box) -> jax.Array:
    """Whether boxes share a point (touching counts), by separating axes in closed form."""
    dx, dy = b.x - a.x, b.y - a.y
    cos = jnp.abs(a.cos * b.cos + a.sin * b.sin)
    sin = jnp.abs(a.cos * b.sin - a.sin * b.cos)
    al, aw, bl, bw = a.half_length, a.half_width, b.half_length, b.half_width
    return (
        (jnp.abs(dx * a.cos + dy * a.sin) <= al + bl * cos + bw * sin)
        & (jnp.abs(dy * a.cos - dx * a.sin) <= aw + bl * sin + bw * cos)
        & (jnp.abs(dx * b.cos + dy * b.sin) <= bl + al * cos + aw * sin)
        & (jnp.abs(dy * b.cos - dx * b.sin) <= bw + al * sin + aw * cos)
    )


def _corner_to_box_sq(a: Box, b: Box) -> jax.Array:
    """Smallest squared distance from a corner of `a` to the solid box `b`."""
    dx, dy = a.x - b.x, a.y - b.y
    px, py = dx * b.cos + dy * b.sin, dy * b.cos - dx * b.sin
    cos = a.cos * b.cos + a.sin * b.sin
    sin = a.sin * b.cos - a.cos * b.sin
    fx, fy = a.half_length * cos, a.half_length * sin
    lx, ly = -a.half_width * sin, a.half_width * cos
    best = None
    for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        ux = jnp.maximum(jnp.abs(px + i * fx + j * lx) - b.half_length, 0)
        uy = jnp.maximum(jnp.abs(py + i * fy + j * ly) - b.half_width, 0)
        square = ux * ux + uy * uy
        best = square if best is None else jnp.minimum(best, square)
    assert best is not None
    return best


def box_distance(a: Box, b: Box) -> jax.Array:
    """Distance between solid boxes, 0 where they overlap."""
    square = jnp.minimum(_corner_to_box_sq(a, b), _corner_to_box_sq(b, a))
    return jnp.where(boxes_overlap(a, b), 0, jnp.sqrt(square))


def point_segment_sq(px, py, ax, ay, bx, by) -> tuple[jax.Array, jax.Array]:
    """Squared distance from points to segments, and the nearest point's fraction along them."""
    ux, uy = bx - ax, by - ay
    vx, vy = px - ax, py - ay
    square = ux * ux + uy * uy
    t = jnp.clip((vx * ux + vy * uy) / jnp.where(square > 0, square, 1), 0, 1)
    ex, ey = vx - t * ux, vy - t * uy
    return ex * ex + ey * ey, t


def segment_meets_box(ax, ay, bx, by, box: Box) -> jax.Array:
    """Whether segments share a point with solid boxes (touching counts)."""
    half = 0.5 * jnp.hypot(bx - ax, by - ay)
    scale = jnp.where(half > 0, 0.5 / jnp.where(half > 0, half, 1), 0)
    segment = Box(
        0.5 * (ax + bx),
        0.5 * (ay + by),
        jnp.where(half > 0, (bx - ax) * scale, 1),
        (by - ay) * scale,
        half,
        jnp.zeros_like(half),
    )
    return boxes_overlap(segment, box)


def segment_box_distance(ax, ay, bx, by, box: Box) -> jax.Array:
    """Distance between segments and solid boxes, 0 where they meet."""

    def local(px, py):
        dx, dy = px - box.x, py - box.y
        return dx * box.cos + dy * box.sin, dy * box.cos - dx * box.sin

    (ax_, ay_), (bx_, by_) = local(ax, ay), local(bx, by)
    best = None
    for px, py in ((ax_, ay_), (bx_, by_)):
        ux = jnp.maximum(jnp.abs(px) - box.half_length, 0)
        uy = jnp.maximum(jnp.abs(py) - box.half_width, 0)
        square = ux * ux + uy * uy
        best = square if best is None else jnp.minimum(best, square)
    for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        square, _ = point_segment_sq(i * box.half_length, j * box.half_width, ax_, ay_, bx_, by_)
        best = jnp.minimum(best, square)
    return jnp.where(segment_meets_box(ax, ay, bx, by, box), 0, jnp.sqrt(best))


def crosses_upward_ray(px, py, ax, ay, bx, by) -> jax.Array:
    """Whether the ray from a point to +x crosses edges: summed parity tells point in polygon."""
    straddles = (ay > py) != (by > py)
    dy = jnp.where(straddles, by - ay, 1)
    return straddles & (px < ax + (py - ay) * (bx - ax) / dy)


class Path(struct.PyTreeNode):
    """A polyline with its arc length; padded points repeat beyond `count`.

    Attributes:
      x, y: `[M]` m.
      heading: `[M]` rad, unwrapped along the path.
      progress: `[M]` cumulative chord length, m; padding is a large number.
      count: `[]` int32 number of real points.
      length: `[]` m.
    """

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    progress: jax.Array
    count: jax.Array
    length: jax.Array


PADDED_PROGRESS = 1e9
"""Progress of padded path points, m: larger than any road."""


def unwrap_masked(angle: jax.Array, valid: jax.Array) -> jax.Array:
    """Unwraps angles along the last axis (NumPy's rule); `valid` is a prefix mask."""
    step = jnp.diff(angle, axis=-1)
    turns = jnp.where(valid[..., 1:], jnp.round(step / (2 * jnp.pi)), 0)
    total = jnp.concatenate([jnp.zeros_like(angle[..., :1]), prefix_sum(turns)], -1)
    return angle - (2 * jnp.pi) * total


def make_path(x: jax.Array, y: jax.Array, heading: jax.Array, count: jax.Array) -> Path:
    """Builds a path from `[M]` points of which the first `count` are real.

    Source: tuplan_garage `PDMPath` (heading unwrapped, progress by chords).
    """
    valid = jnp.arange(x.shape[0]) < count
    last = jnp.maximum(count - 1, 0)
    x = jnp.where(valid, x, x[last])
    y = jnp.where(valid, y, y[last])
    heading = unwrap_masked(heading, valid)
    heading = jnp.where(valid, heading, heading[last])
    chord = jnp.hypot(jnp.diff(x), jnp.diff(y))
    progress = jnp.concatenate([jnp.zeros_like(x[:1]), prefix_sum(chord)])
    length = progress[last]
    progress = jnp.where(valid, progress, jnp.asarray(PADDED_PROGRESS, x.dtype))
    return Path(x, y, heading, progress, count, length)


def project(path: Path, px: jax.Array, py: jax.Array) -> jax.Array:
    """Arc length of the nearest point on the path, `[...]` points; first one on ties."""
    px, py = px[..., None], py[..., None]
    square, t = point_segment_sq(px, py, path.x[:-1], path.y[:-1], path.x[1:], path.y[1:])
    index = jnp.arange(path.x.shape[0] - 1)
    square = jnp.where(index < jnp.maximum(path.count - 1, 1), square, jnp.inf)
    best = jnp.argmin(square, axis=-1)
    t = jnp.take_along_axis(t, best[..., None], -1)[..., 0]
    start = path.progress[best]
    end = jnp.where(best + 1 < path.count, path.progress[best + 1], start)
    return start + t * (end - start)


_RUN = 32  # segments that `project_many` compares as one circle first


def project_many(path: Path, px: jax.Array, py: jax.Array) -> jax.Array:
    """`project` for many points `[N]`.

    Runs of segments, as circles, bound the distance from below; each point looks into the nearest
    runs until no other can hold a nearer segment.
    """
    size = path.x.shape[0] - 1
    spare = -size % _RUN
    index = jnp.arange(size + spare).reshape(-1, _RUN)
    begin, end = jnp.minimum(index, size), jnp.minimum(index + 1, size)
    used = index < jnp.maximum(path.count - 1, 1)
    ax, ay, bx, by = path.x[begin], path.y[begin], path.x[end], path.y[end]
    far = jnp.asarray(1e9, px.dtype)

    def middle(a, b):
        low = jnp.min(jnp.where(used, jnp.minimum(a, b), far), axis=1)
        high = jnp.max(jnp.where(used, jnp.maximum(a, b), -far), axis=1)
        return 0.5 * (low + high)

    cx, cy = middle(ax, bx), middle(ay, by)
    reach = jnp.maximum(
        jnp.hypot(ax - cx[:, None], ay - cy[:, None]),
        jnp.hypot(bx - cx[:, None], by - cy[:, None]),
    )
    radius = jnp.max(jnp.where(used, reach, 0), axis=1)
    # Squared like the distances. A little slack: rounding must not skip the nearest segment's run.
    low = jnp.hypot(px[:, None] - cx, py[:, None] - cy) - 1.0001 * radius - 1e-3
    low = jnp.where(jnp.any(used, axis=1), jnp.square(jnp.maximum(low, 0)), jnp.inf)
    start = path.progress[begin]
    stop = jnp.where(index + 1 < path.count, path.progress[end], start)
    table = jnp.stack([ax, ay, bx, by, start, stop])

    def look(state):
        low, least, progress = state
        run = jnp.argmin(low, axis=1)
        open_ = jnp.min(low, axis=1) <= least
        x0, y0, x1, y1, s0, s1 = table[:, run]
        square, t = point_segment_sq(px[:, None], py[:, None], x0, y0, x1, y1)
        square = jnp.where(used[run] & open_[:, None], square, jnp.inf)
        best = jnp.argmin(square, axis=1)[:, None]
        pick = lambda v: jnp.take_along_axis(v, best, axis=1)[:, 0]
        square, at = pick(square), pick(s0 + t * (s1 - s0))
        # Of equally near points the first on the path counts.
        better = (square < least) | ((square == least) & (at < progress))
        seen = jnp.arange(low.shape[1]) == run[:, None]
        return (
            jnp.where(seen, jnp.inf, low),
            jnp.where(better, square, least),
            jnp.where(better, at, progress),
        )

    some_open = lambda state: jnp.any(jnp.min(state[0], axis=1) < state[1])
    limit = jnp.full_like(px, jnp.inf)
    return jax.lax.while_loop(some_open, look, (low, limit, limit))[2]


def interpolate(path: Path, s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pose at arc lengths `[...]`, clipped to [1e-5, length]; heading wrapped to (-pi, pi].

    Source: tuplan_garage `PDMPath.interpolate`.
    """
    s = jnp.clip(s, jnp.minimum(jnp.asarray(1e-5, s.dtype), path.length), path.length)
    # Few points: count; many: bisect. (An unrolled bisection compiles for seconds.)
    method = "compare_all" if s.size * path.x.shape[0] <= 2**15 else "scan"
    index = jnp.searchsorted(path.progress, s, side="left", method=method)
    index = jnp.clip(index, 1, jnp.maximum(path.count - 1, 1))
    p0, p1 = path.progress[index - 1], path.progress[index]
    span = p1 - p0
    f = jnp.where(span > 0, (s - p0) / jnp.where(span > 0, span, 1), 0)

    def mix(values):
        return values[index - 1] + f * (values[index] - values[index - 1])

    return mix(path.x), mix(path.y), wrap(mix(path.heading))
