"""Paths from the ego onto centre lines, and natural cubic splines along them.

A path joins a cubic Bezier curve, from the ego's pose to a pose some metres down a centre line,
with the rest of that line. Arrays are padded: the first `count` points are real.

Source: GameFormer-Planner and DTPP, state lattice path planners.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum
from spdm_jax.geometry import Box, box_distance, boxes_overlap, segment_box_distance

POINT_SPACING = 0.25
"""Distance between points of a centre line, m."""
NUM_TARGETS = 4
"""Bezier curves per centre line."""
TARGET_STEP = 20
"""Points of a centre line between the ends of those curves (5 m)."""
COST_POINTS = 100
"""A path's cost looks at this many points of it (25 m)."""
EGO_HALF_WIDTH = 0.5 * 2.297
"""Half the width that a path sweeps, m (nuPlan's Pacifica)."""
KNOT_STRIDE = 10
"""Every tenth point of a path becomes a knot of its spline."""
ROW_SPACING = 0.1
"""Arc length between rows of a spline, m."""
NUM_ROWS = 1200
"""Rows of a spline at most (120 m)."""

# Arc length given to padded knots, m: beyond any road.
_FAR = 1e9


class Polyline(struct.PyTreeNode):
    """Points in a row.

    Attributes:
      x, y: `[..., M]` m.
      heading: `[..., M]` rad.
      count: `[...]` int32 number of real points.
    """

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    count: jax.Array


class Course(struct.PyTreeNode):
    """A curve sampled every 0.1 m; rows beyond `count` repeat the last real one.

    Attributes:
      x, y: `[..., L]` m.
      heading: `[..., L]` rad.
      curvature: `[..., L]` 1/m, left positive.
      count: `[...]` int32 number of real rows.
    """

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    curvature: jax.Array
    count: jax.Array


class LatticePaths(struct.PyTreeNode):
    """Paths onto one centre line, one per end of the Bezier curve, nearest end first.

    Attributes:
      x, y: `[4, M]` m.
      count: `[4]` int32 number of real points.
      valid: `[4]` bool, False where the line is too short for another path.
      distance: `[]` from the ego to the line's nearest point, m.
    """

    x: jax.Array
    y: jax.Array
    count: jax.Array
    valid: jax.Array
    distance: jax.Array


def bezier_points(
    start: tuple[jax.Array, jax.Array, jax.Array],
    end: tuple[jax.Array, jax.Array, jax.Array],
    share: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Points of a cubic Bezier between two poses, control points a third of the gap away.

    Args:
      start: x, y, heading.
      end: x, y, heading.
      share: `[N]` from 0 (start) to 1 (end).

    Returns:
      x and y `[N]`.
    """
    (x0, y0, h0), (x3, y3, h3) = start, end
    third = jnp.hypot(x3 - x0, y3 - y0) / 3
    rest = 1 - share

    def curve(p0, p1, p2, p3):
        return rest**3 * p0 + 3 * share * rest * (rest * p1 + share * p2) + share**3 * p3

    return (
        curve(x0, x0 + third * jnp.cos(h0), x3 - third * jnp.cos(h3), x3),
        curve(y0, y0 + third * jnp.sin(h0), y3 - third * jnp.sin(h3), y3),
    )


def lattice_paths(
    line: Polyline, ego_x: jax.Array, ego_y: jax.Array, ego_heading: jax.Array
) -> LatticePaths:
    """Builds the paths from the ego onto one centre line.

    The line is cut at its point nearest to the ego. Behind the end of the k-th curve (k = 0, 1,
    ...) k points of the line are left out, as in the reference, which shortens the line anew for
    every curve.

    Args:
      line: `[M]` points 0.25 m apart.
      ego_x: `[]` rear axle, m, in the frame of the line.
      ego_y: `[]` m.
      ego_heading: `[]` rad.
    """
    size = line.x.shape[0]
    position = jnp.arange(size)
    gap = jnp.hypot(line.x - ego_x, line.y - ego_y)
    gap = jnp.where(position < line.count, gap, jnp.inf)
    first = jnp.argmin(gap)
    left = line.count - first

    def path(k):
        target = jnp.where(left > TARGET_STEP + 1, TARGET_STEP * (k + 1), 1)
        at = jnp.minimum(first + target, line.count - 1)
        share = jnp.minimum(position / jnp.maximum(target - 1, 1), 1).astype(line.x.dtype)
        end = line.x[at], line.y[at], line.heading[at]
        x, y = bezier_points((ego_x, ego_y, ego_heading), end, share)
        on_curve = position < target
        behind = jnp.clip(first + target + k + 1 + position - target, 0, size - 1)
        count = target + jnp.maximum(left - (target + k + 1), 0)
        return (
            jnp.where(on_curve, x, line.x[behind]),
            jnp.where(on_curve, y, line.y[behind]),
            count,
        )

    index = jnp.arange(NUM_TARGETS)
    x, y, count = jax.vmap(path)(index)
    reaches = left > TARGET_STEP * (index + 1) + 1
    valid = jnp.where(index == 0, left > 0, reaches)
    return LatticePaths(x, y, count, valid, jnp.min(gap))


def max_curvature(x: jax.Array, y: jax.Array, count: jax.Array) -> jax.Array:
    """Largest curvature of a path's first 100 points, by central differences over the index.

    Args:
      x: `[M]` m.
      y: `[M]` m.
      count: `[]` real points.

    Returns:
      `[]` 1/m.
    """
    x, y = x[:COST_POINTS], y[:COST_POINTS]
    count = jnp.minimum(count, x.shape[0])
    position = jnp.arange(x.shape[0])
    after = jnp.minimum(position + 1, count - 1)
    before = jnp.maximum(jnp.minimum(position, count - 1) - 1, 0)
    span = jnp.maximum(after - before, 1)

    def slope(values):
        return (values[after] - values[before]) / span.astype(values.dtype)

    dx, dy = slope(x), slope(y)
    square = dx * dx + dy * dy
    safe = jnp.where(square > 0, square, 1)
    curvature = jnp.abs(dx * slope(dy) - slope(dx) * dy) / (safe * jnp.sqrt(safe))
    return jnp.max(jnp.where((position < count) & (square > 0), curvature, 0))


def swept_path_hits(
    x: jax.Array, y: jax.Array, count: jax.Array, boxes: Box, present: jax.Array
) -> jax.Array:
    """Whether the strip that the ego sweeps along a path meets each box.

    The strip has round corners and square ends, as shapely's `buffer(cap_style="square")`.

    Args:
      x: `[M]` m.
      y: `[M]` m.
      count: `[]` real points.
      boxes: `[A]` boxes.
      present: `[A]` bool.

    Returns:
      `[A]` bool.
    """
    near, caps = _swept_parts(x, y, count, boxes)
    hit = jnp.min(near, axis=1) <= EGO_HALF_WIDTH
    for cap in caps:
        hit = hit | (boxes_overlap(cap, boxes) & (count > 1))
    return present & hit


def swept_path_distance(
    x: jax.Array, y: jax.Array, count: jax.Array, boxes: Box, present: jax.Array
) -> jax.Array:
    """Distance of the strip that the ego sweeps along a path to each box.

    Args:
      x: `[M]` m.
      y: `[M]` m.
      count: `[]` real points.
      boxes: `[A]` boxes.
      present: `[A]` bool.

    Returns:
      `[A]` m, 0 where they meet, inf where no box is present.
    """
    near, caps = _swept_parts(x, y, count, boxes)
    distance = jnp.maximum(jnp.min(near, axis=1) - EGO_HALF_WIDTH, 0)
    for cap in caps:
        to_cap = jnp.where(count > 1, box_distance(cap, boxes), jnp.inf)
        distance = jnp.minimum(distance, to_cap)
    return jnp.where(present, distance, jnp.inf)


def _swept_parts(
    x: jax.Array, y: jax.Array, count: jax.Array, boxes: Box
) -> tuple[jax.Array, tuple[Box, Box]]:
    """Distances of the path's segments to boxes `[A, M - 1]`, and the strip's two end caps."""
    real = jnp.arange(x.shape[0] - 1) + 1 < count
    each = jax.tree.map(lambda v: jnp.atleast_1d(v)[:, None], boxes)
    near = segment_box_distance(x[:-1], y[:-1], x[1:], y[1:], each)

    def end_cap(tip, inner):
        dx, dy = x[tip] - x[inner], y[tip] - y[inner]
        length = jnp.hypot(dx, dy)
        scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 0)
        cos, sin = jnp.where(length > 0, dx * scale, 1), dy * scale
        half = jnp.asarray(0.5 * EGO_HALF_WIDTH, x.dtype)
        return Box(x[tip] + half * cos, y[tip] + half * sin, cos, sin, half, 2 * half)

    last = jnp.maximum(count - 1, 1)
    caps = end_cap(0, 1), end_cap(last, last - 1)
    return jnp.where(real, near, jnp.inf), caps


def spline_course(x: jax.Array, y: jax.Array, count: jax.Array, num_rows: int = NUM_ROWS) -> Course:
    """Natural cubic splines x(s), y(s) over the chord length, sampled every 0.1 m.

    Args:
      x: `[K]` knots, m.
      y: `[K]` m.
      count: `[]` real knots, at least 2.
      num_rows: L; a longer curve is cut there.
    """
    size = x.shape[0]
    index = jnp.arange(size)
    step = jnp.hypot(jnp.diff(x), jnp.diff(y))
    step = jnp.where((index[1:] < count) & (step > 0), step, 1)
    arc = jnp.concatenate([jnp.zeros_like(x[:1]), prefix_sum(step)])
    length = arc[count - 1]
    row = jnp.arange(num_rows, dtype=x.dtype)
    wanted = jnp.ceil(length / ROW_SPACING).astype(jnp.int32)
    rows = jnp.clip(wanted, 1, num_rows)
    s = jnp.minimum(row, rows.astype(x.dtype) - 1) * ROW_SPACING
    starts = jnp.where(index < count - 1, arc, _FAR)
    piece = jnp.sum(starts <= s[:, None], axis=1) - 1
    t = s - arc[piece]
    x, dx, ddx = _natural_spline(x, step, count, piece, t)
    y, dy, ddy = _natural_spline(y, step, count, piece, t)
    square = dx * dx + dy * dy
    safe = jnp.where(square > 0, square, 1)
    curvature = (ddy * dx - ddx * dy) / (safe * jnp.sqrt(safe))
    return Course(x, y, jnp.arctan2(dy, dx), curvature, rows)


def _natural_spline(
    values: jax.Array, step: jax.Array, count: jax.Array, piece: jax.Array, t: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value and two derivatives of the spline through `values`, `t` into each `piece`."""
    index = jnp.arange(values.shape[0])
    inner = (index > 0) & (index < count - 1)
    slope = jnp.diff(values) / step
    before = jnp.concatenate([step[:1], step])
    after = jnp.concatenate([step, step[-1:]])
    change = jnp.pad(jnp.diff(slope), 1)
    # Rows without an inner knot read c = 0.
    lower = jnp.where(inner, before, 0)
    upper = jnp.where(inner, after, 0)
    diagonal = jnp.where(inner, 2 * (before + after), 1)
    right = jnp.where(inner, 3 * change, 0)
    c = jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, right[:, None])[:, 0]
    d = jnp.diff(c) / (3 * step)
    b = slope - step * (c[1:] + 2 * c[:-1]) / 3
    a0, b0, c0, d0 = values[piece], b[piece], c[piece], d[piece]
    value = a0 + t * (b0 + t * (c0 + t * d0))
    return value, b0 + t * (2 * c0 + t * 3 * d0), 2 * c0 + 6 * d0 * t
