"""Strips along paths, and distances between shapes made of boxes.

A polyline buffered with flat ends and round joins is the union of one rectangle per segment and one
thin wedge per bend. Every shape here (a strip, a vehicle, a stop polygon's outline) is a list of
boxes in short blocks with a circle around each block; distances visit only the pairs of blocks
whose circles are close enough to matter.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.geometry import Box, box_distance, boxes_overlap

RUN = 4
"""Segments of a strip in one block."""
WIDTH = 3 * RUN
"""Boxes in one block: a rectangle and two chords of the wedge per segment."""
_WINDOW = 16
"""Runs of a strip that are searched together."""
_FAR = 1e9
_SLACK = 2e-3
"""Bounds are this much too wide, m: rounding must not part what touches."""
# Round joins have 16 segments per quarter circle; a bend gets round(angle / 5.625 deg) of them.
_TWO_CHORDS = float(np.cos(1.5 * np.pi / 2 / 16))


Circles: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]
"""Centre x, centre y and radius, `[B]` each, m; a negative radius marks an empty one."""


class Blocks(NamedTuple):
    """A shape.

    Attributes:
      box: `[B, WIDTH]` boxes; a chord or an edge is a box without width.
      used: `[B, WIDTH]` bool.
      x, y, radius: `[B]` circle around each block; a negative radius marks an empty one.
    """

    box: Box
    used: jax.Array
    x: jax.Array
    y: jax.Array
    radius: jax.Array


def _shortest(dtype) -> float:
    """Segments below this length, m, have no direction that rounding would leave intact."""
    return 1e-9 if dtype == jnp.float64 else 5e-3


def _segment_box(ax, ay, bx, by) -> Box:
    dx, dy = bx - ax, by - ay
    length = jnp.hypot(dx, dy)
    some = length > 0
    safe = jnp.where(some, length, 1)
    cos, sin = jnp.where(some, dx / safe, 1), dy / safe
    return Box(0.5 * (ax + bx), 0.5 * (ay + by), cos, sin, 0.5 * length, jnp.zeros_like(length))


def strip_boxes(x: jax.Array, y: jax.Array, half_width: jax.Array) -> tuple[Box, jax.Array]:
    """Boxes of the segments 1, 2, ... of a polyline; segment 0 only says where the bend begins.

    Args:
      x: `[..., N + 2]` vertices, m.
      y: `[..., N + 2]`.
      half_width: m.

    Returns:
      Boxes `[..., 3 N]` (rectangle, chord, chord for each segment) and which of them are real.
    """
    dx, dy = jnp.diff(x), jnp.diff(y)
    length = jnp.hypot(dx, dy)
    real = length > _shortest(x.dtype)
    safe = jnp.where(real, length, 1)
    cos, sin = jnp.where(real, dx / safe, 1), jnp.where(real, dy / safe, 0)
    used = real[..., 1:]
    c, s, c0, s0 = cos[..., 1:], sin[..., 1:], cos[..., :-1], sin[..., :-1]
    vx, vy = x[..., 1:-1], y[..., 1:-1]
    half = 0.5 * length[..., 1:]
    rectangle = Box(
        vx + half * c, vy + half * s, c, s, half, jnp.broadcast_to(half_width, half.shape)
    )
    # The wedge opens on the outer side of the bend.
    cross, dot = c0 * s - s0 * c, c0 * c + s0 * s
    bends = used & real[..., :-1] & (cross != 0)
    out = -jnp.sign(cross) * half_width
    ax, ay, bx, by = vx - out * s0, vy + out * c0, vx - out * s, vy + out * c
    two = dot < _TWO_CHORDS
    norm = jnp.hypot(c0 + c, s0 + s)
    norm = jnp.where(norm > 0, norm, 1)
    mx = jnp.where(two, vx - out * (s0 + s) / norm, bx)
    my = jnp.where(two, vy + out * (c0 + c) / norm, by)
    first, second = _segment_box(ax, ay, mx, my), _segment_box(mx, my, bx, by)

    def join(*values):
        stacked = jnp.stack(values, -1)
        return stacked.reshape(*stacked.shape[:-2], -1)

    boxes = jax.tree.map(join, rectangle, first, second)
    return boxes, join(used, bends, bends & two)


def _by_run(values: jax.Array, run: int = RUN) -> jax.Array:
    """Vertices `[B, run + 1]` of all runs; slices, which cost less than one gather of all."""
    return jnp.concatenate([values[:-1].reshape(-1, run), values[run::run, None]], axis=1)


def run_circles(x: jax.Array, y: jax.Array, half_width: jax.Array, run: int = RUN) -> Circles:
    """Circles around runs of segments of a strip with vertices `[run B + 1]`.

    Runs without extent get a negative radius.
    """
    px, py = _by_run(x, run), _by_run(y, run)
    low_x, high_x, low_y, high_y = px.min(1), px.max(1), py.min(1), py.max(1)
    cx, cy = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
    square = (px - cx[:, None]) ** 2 + (py - cy[:, None]) ** 2
    reach = jnp.sqrt(jnp.max(square, axis=1)) + half_width
    empty = (low_x == high_x) & (low_y == high_y)
    return cx, cy, jnp.where(empty, -1, reach)


def run_vertices(values: jax.Array, run: jax.Array) -> jax.Array:
    """Vertices `[RUN + 2]` that the boxes of one run need; the polyline's start is repeated."""
    index = run * RUN - 1 + jnp.arange(RUN + 2)
    return values[jnp.maximum(index, 0)]


def one_box(box: Box) -> Blocks:
    """A single box (scalars) as a shape of one block."""
    fill = jax.tree.map(lambda v: jnp.broadcast_to(v, (1, WIDTH)), box)
    radius = jnp.hypot(box.half_length, box.half_width)
    first = jnp.arange(WIDTH)[None] == 0
    return Blocks(fill, first, box.x[None], box.y[None], radius[None])


def vehicle_shape(x: jax.Array, y: jax.Array, half_width: jax.Array, body: Box) -> Blocks:
    """A strip with vertices `[RUN B + 1]` united with a box: `[B + 1]` blocks, the box last."""
    runs = np.arange(x.shape[0] // RUN)
    vertices = jax.vmap(lambda v, run: run_vertices(v, run), in_axes=(None, 0))
    boxes, used = strip_boxes(vertices(x, runs), vertices(y, runs), half_width)
    circles = run_circles(x, y, half_width)
    strip = Blocks(boxes, used, *circles)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), strip, one_box(body))


def outline_shape(edges: jax.Array, valid: jax.Array, num_blocks: int) -> Blocks:
    """The edges `[E, 4]` of a polygon as a shape of `num_blocks` blocks; E = that x WIDTH."""
    ax, ay, bx, by = edges.reshape(num_blocks, WIDTH, 4).transpose(2, 0, 1)
    used = valid.reshape(num_blocks, WIDTH)
    boxes = _segment_box(ax, ay, bx, by)
    far = jnp.asarray(_FAR, ax.dtype)
    low = lambda a, b: jnp.min(jnp.where(used, jnp.minimum(a, b), far), axis=1)
    high = lambda a, b: jnp.max(jnp.where(used, jnp.maximum(a, b), -far), axis=1)
    x0, x1, y0, y1 = low(ax, bx), high(ax, bx), low(ay, by), high(ay, by)
    some = jnp.any(used, axis=1)
    cx, cy = jnp.where(some, 0.5 * (x0 + x1), 0), jnp.where(some, 0.5 * (y0 + y1), 0)
    radius = jnp.where(some, 0.5 * jnp.hypot(x1 - x0, y1 - y0), -1)
    return Blocks(boxes, used, cx, cy, radius)


def shape_circle(shape: Blocks) -> jax.Array:
    """Circle around a whole shape: x, y, radius `[3]`; an empty shape has a negative radius."""
    some = shape.radius >= 0
    far = jnp.asarray(_FAR, shape.x.dtype)
    low = lambda v: jnp.min(jnp.where(some, v - shape.radius, far))
    high = lambda v: jnp.max(jnp.where(some, v + shape.radius, -far))
    any_ = jnp.any(some)
    x = jnp.where(any_, 0.5 * (low(shape.x) + high(shape.x)), 0)
    y = jnp.where(any_, 0.5 * (low(shape.y) + high(shape.y)), 0)
    reach = jnp.sqrt((shape.x - x) ** 2 + (shape.y - y) ** 2) + shape.radius
    return jnp.stack([x, y, jnp.max(jnp.where(some, reach, -1))])


def _around_runs(x: jax.Array, y: jax.Array, half_width: jax.Array) -> Box:
    """Boxes `[B]` that hold the runs of a strip with vertices `[RUN B + 1]`."""
    px, py = _by_run(x), _by_run(y)
    axis = _segment_box(px[:, 0], py[:, 0], px[:, -1], py[:, -1])
    return _aligned(axis, px, py, half_width, half_width)


def _around_blocks(shape: Blocks) -> Box:
    """Boxes `[B]` that hold the blocks of a shape; those of empty ones mean nothing."""
    box = shape.box
    axis = jax.tree.map(lambda v: v[:, 0], box)
    cos, sin = axis.cos[:, None], axis.sin[:, None]
    along = jnp.abs(box.cos * cos + box.sin * sin)
    across = jnp.abs(box.sin * cos - box.cos * sin)
    length = box.half_length * along + box.half_width * across
    width = box.half_length * across + box.half_width * along
    return _aligned(axis, box.x, box.y, length, width, shape.used)


def _aligned(axis: Box, x, y, half_length, half_width, used: jax.Array | bool = True) -> Box:
    """Boxes `[B]` in the direction of `axis` around used points `[B, N]` with their extents."""
    cos, sin = axis.cos[:, None], axis.sin[:, None]
    dx, dy = x - axis.x[:, None], y - axis.y[:, None]

    def span(at, half):
        low = jnp.min(jnp.where(used, at - half, _FAR), axis=1)
        high = jnp.max(jnp.where(used, at + half, -_FAR), axis=1)
        return 0.5 * (low + high), 0.5 * (high - low)

    along, length = span(dx * cos + dy * sin, half_length)
    aside, width = span(dy * cos - dx * sin, half_width)
    return axis._replace(
        x=axis.x + along * axis.cos - aside * axis.sin,
        y=axis.y + along * axis.sin + aside * axis.cos,
        half_length=length + _SLACK,
        half_width=width + _SLACK,
    )


def circle_gap(ax, ay, ar, bx, by, br) -> jax.Array:
    """Lower bound of the distance between what circles `[A]` and `[B]` hold, `[A, B]`.

    inf where one is empty. A little slack: rounding must not skip a pair that matters.
    """
    ax, ay, ar = ax[:, None], ay[:, None], ar[:, None]
    dx, dy, reach = ax - bx, ay - by, ar + br
    gap = jnp.sqrt(dx * dx + dy * dy) - 1.00001 * reach - 1e-3
    return jnp.where((ar >= 0) & (br >= 0), gap, jnp.inf)


def _search(low: jax.Array, limit: jax.Array, measure) -> jax.Array:
    """Least value over pairs of blocks, nearest bound first; `limit` if none is below it."""

    def more(state):
        low, best = state
        return (best > 0) & (jnp.min(low) < best)

    def visit(state):
        low, best = state
        i, j = jnp.unravel_index(jnp.argmin(low), low.shape)
        return low.at[i, j].set(jnp.inf), jnp.minimum(best, measure(i, j))

    return jax.lax.while_loop(more, visit, (low, limit))[1]


def _block(blocks: Blocks, i: jax.Array) -> tuple[Box, jax.Array]:
    return jax.tree.map(lambda v: v[i], blocks.box), blocks.used[i]


def shapes_distance(a: Blocks, b: Blocks, limit: jax.Array) -> jax.Array:
    """Distance between two shapes, m, or `limit` if they are farther apart than that."""

    def measure(i, j):
        (one, one_used), (other, other_used) = _block(a, i), _block(b, j)
        distance = box_distance(jax.tree.map(lambda v: v[:, None], one), other)
        return jnp.min(jnp.where(one_used[:, None] & other_used, distance, jnp.inf))

    return _search(circle_gap(a.x, a.y, a.radius, b.x, b.y, b.radius), limit, measure)


def strip_meets(
    x: jax.Array,
    y: jax.Array,
    half_width: jax.Array,
    circles: Circles,
    shape: Blocks,
    circle: jax.Array,
) -> jax.Array:
    """Whether the strip along `[RUN B + 1]` vertices shares a point with a shape.

    The runs near the shape mostly lie together, so they are searched a window at a time.

    Args:
      x: vertices, m.
      y: vertices, m.
      half_width: m.
      circles: `run_circles` of the strip.
      shape: the other shape.
      circle: `shape_circle` of it.
    """
    num = circles[0].shape[0]
    size = min(_WINDOW, num)
    near = circle_gap(*circles, circle[0, None], circle[1, None], circle[2, None])[:, 0] < 0
    last = num - 1 - jnp.argmax(near[::-1])

    def measure(i, j):
        boxes, used = strip_boxes(run_vertices(x, i), run_vertices(y, i), half_width)
        other, other_used = _block(shape, j)
        meet = boxes_overlap(jax.tree.map(lambda v: v[:, None], boxes), other)
        return jnp.where(jnp.any(meet & used[:, None] & other_used), 0, 1).astype(x.dtype)

    def more(state):
        start, apart = state
        return (apart > 0) & (start <= last)

    def window(state):
        start, apart = state
        begin = jnp.minimum(start, num - size)
        sx, sy, sr = (jax.lax.dynamic_slice_in_dim(v, begin, size) for v in circles)
        low = circle_gap(sx, sy, sr, shape.x, shape.y, shape.radius)
        # Circles of a car on the lane beside touch, boxes along both lanes do not. All bounds have
        # some slack, so that every pair that meets is left.
        vertices = lambda v: jax.lax.dynamic_slice_in_dim(v, begin * RUN, size * RUN + 1)
        runs = _around_runs(vertices(x), vertices(y), half_width)
        touch = boxes_overlap(jax.tree.map(lambda v: v[:, None], runs), blocks)
        low = jnp.where((low < 0) & touch, low, jnp.inf)
        return start + size, _search(low, apart, lambda i, j: measure(begin + i, j))

    blocks = _around_blocks(shape)
    first = jnp.where(jnp.any(near), jnp.argmax(near), num)
    return jax.lax.while_loop(more, window, (first, jnp.ones_like(half_width)))[1] <= 0
