"""Driving corridors: the strip along a path in which an object counts as a leader.

The reference buffers the path with square caps and round joins. Here the strip is never built: it
is the union of one rectangle per segment and one small wedge per bend, tested against each object.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.observation import RedLights
from spdm_jax.arrays import nth_true, prefix_count
from spdm_jax.geometry import (
    Box,
    Path,
    boxes_overlap,
    crosses_upward_ray,
    interpolate,
    project,
    segment_meets_box,
)
from spdm_jax.types import AgentForecast

# The reference's round joins have 16 segments per quarter circle (shapely's quad_segs).
_JOIN_ANGLE = jnp.pi / 2 / 16
BLOCK = 8
"""Segments in a run that is compared as one circle first."""
BOXES = 128
"""Boxes near a corridor that are looked at together."""
PAIRS = 512
"""(run, box) pairs tested exactly at a time."""
POINTS = 128
"""Points projected at a time."""


class Corridor(struct.PyTreeNode):
    """Corridor of one path.

    Attributes:
      x, y: `[M]` vertices of its axis; padding repeats the last one.
      count: `[]` int32 number of real vertices.
    """

    x: jax.Array
    y: jax.Array
    count: jax.Array


def corridor_axis(path: Path, start: jax.Array, end: jax.Array) -> Corridor:
    """Cuts the axis out of a path: its own vertices between two arc lengths.

    With fewer than two vertices in between, the exact piece of the path takes their place.

    Source: tuplan_garage `PDMGenerator._initialize_proposals` / `PDMPath.substring`.
    """
    start = jnp.clip(start, 0, path.length)
    end = jnp.clip(end, 0, path.length)
    index = jnp.arange(path.x.shape[0])
    inside = (path.progress >= start) & (path.progress <= end) & (index < path.count)
    count = jnp.sum(inside)
    first = jnp.argmax(inside)
    pick = jnp.minimum(first + index, first + jnp.maximum(count - 1, 0))
    x0, y0, _ = interpolate(path, start)
    x1, y1, _ = interpolate(path, end)
    # Short piece: start, the vertex in between if there is one, end.
    few = count < 2
    middle = first
    has_middle = count == 1

    def choose(whole, begin, values, finish):
        short = jnp.full_like(whole, finish)
        short = short.at[0].set(begin)
        short = short.at[1].set(jnp.where(has_middle, values[middle], finish))
        return jnp.where(few, short, whole)

    return Corridor(
        choose(path.x[pick], x0, path.x, x1),
        choose(path.y[pick], y0, path.y, y1),
        jnp.where(few, jnp.where(has_middle, 3, 2), count).astype(jnp.int32),
    )


class _Segments(NamedTuple):
    """Pieces of a corridor, `[M - 1]` each: a rectangle and the wedge at its start."""

    box: Box
    used: jax.Array
    # Wedge between the previous segment and this one, around the shared vertex.
    vx: jax.Array
    vy: jax.Array
    in_cos: jax.Array  # direction of the previous segment
    in_sin: jax.Array
    side: jax.Array  # +1 if the wedge opens to the left, -1 to the right, 0 for none
    chord: jax.Array  # distance of the wedge's chord from the vertex
    coarse: jax.Array  # wedge with several chords: compare distances instead
    mid_cos: jax.Array  # direction of the middle of the wedge
    mid_sin: jax.Array


def _segments(axis: Corridor, half_width: jax.Array) -> _Segments:
    dx, dy = jnp.diff(axis.x), jnp.diff(axis.y)
    length = jnp.hypot(dx, dy)
    index = jnp.arange(length.shape[0])
    used = (index < axis.count - 1) & (length > 0)
    safe = jnp.where(used, length, 1)
    # A corridor without extent is a square along the x axis, as a buffered point is.
    point = ~jnp.any(used)
    used = jnp.where(point, index == 0, used)
    cos, sin = jnp.where(length > 0, dx / safe, 1), jnp.where(length > 0, dy / safe, 0)
    first = index == jnp.argmax(used)
    last = index == length.shape[0] - 1 - jnp.argmax(used[::-1])
    before = jnp.where(first, half_width, 0)
    after = jnp.where(last, half_width, 0)
    middle = 0.5 * (length + after - before)
    box = Box(
        axis.x[:-1] + middle * cos,
        axis.y[:-1] + middle * sin,
        cos,
        sin,
        0.5 * (length + before + after),
        jnp.broadcast_to(half_width, length.shape),
    )
    # Duplicate points leave unused segments: look back to the last used one.
    previous = jax.lax.cummax(jnp.where(used, index, -1))
    previous = jnp.concatenate([jnp.full(1, -1, previous.dtype), previous[:-1]])
    in_cos, in_sin = cos[previous], sin[previous]
    turn = jnp.arctan2(in_cos * sin - in_sin * cos, in_cos * cos + in_sin * sin)
    bends = used & (previous >= 0) & (turn != 0)
    side = jnp.where(bends, -jnp.sign(turn), 0)  # the wedge opens on the outer side
    angle = jnp.abs(turn)
    chords = jnp.maximum(jnp.floor(angle / _JOIN_ANGLE + 0.5), 1)
    mx, my = -side * (in_sin + sin), side * (in_cos + cos)
    norm = jnp.hypot(mx, my)
    norm = jnp.where(norm > 0, norm, 1)
    chord = half_width * jnp.where(
        chords > 1, 0.5 * (1 + jnp.cos(0.5 * angle / chords)), jnp.cos(0.5 * angle)
    )
    return _Segments(
        box,
        used,
        axis.x[:-1],
        axis.y[:-1],
        in_cos,
        in_sin,
        side,
        chord,
        chords > 1,
        mx / norm,
        my / norm,
    )


def _piece_meets_box(piece: _Segments, box: Box) -> jax.Array:
    """Whether one corridor piece (scalars) shares a point with boxes."""
    hit = boxes_overlap(piece.box, box)
    # Nearest point of the box seen from the vertex, back in map axes.
    dx, dy = piece.vx - box.x, piece.vy - box.y
    px, py = dx * box.cos + dy * box.sin, dy * box.cos - dx * box.sin
    ux = jnp.clip(px, -box.half_length, box.half_length) - px
    uy = jnp.clip(py, -box.half_width, box.half_width) - py
    wx, wy = ux * box.cos - uy * box.sin, ux * box.sin + uy * box.cos
    beyond = (wx * piece.in_cos + wy * piece.in_sin >= 0) & (
        wx * piece.box.cos + wy * piece.box.sin <= 0
    )
    along = wx * piece.mid_cos + wy * piece.mid_sin
    near = jnp.where(
        piece.coarse, wx * wx + wy * wy <= piece.chord * piece.chord, along <= piece.chord
    )
    wedge = (piece.side != 0) & beyond & (along >= 0) & near
    return (hit | wedge) & piece.used


class _Blocks(NamedTuple):
    """Circles around runs of segments, `[L, M / BLOCK]` each."""

    x: jax.Array
    y: jax.Array
    radius: jax.Array  # negative where the run has no used segment


def _blocks(axes: Corridor, pieces: _Segments, half_width: jax.Array) -> _Blocks:
    size = pieces.used.shape[1] // BLOCK
    group = lambda v: v.reshape(v.shape[0], size, BLOCK)
    used = group(pieces.used)
    far = jnp.asarray(1e9, half_width.dtype)
    x, y = group(pieces.box.x), group(pieces.box.y)
    low = lambda v: jnp.min(jnp.where(used, v, far), axis=2)
    high = lambda v: jnp.max(jnp.where(used, v, -far), axis=2)
    cx, cy = 0.5 * (low(x) + high(x)), 0.5 * (low(y) + high(y))
    reach = jnp.hypot(x - cx[..., None], y - cy[..., None]) + jnp.hypot(
        group(pieces.box.half_length), half_width
    )
    # A wedge lies within half a width of a rectangle's end, hence inside the same circle.
    radius = jnp.max(jnp.where(used, reach, -1), axis=2)
    some = radius > 0
    return _Blocks(jnp.where(some, cx, 0), jnp.where(some, cy, 0), radius)


def corridors_hit_boxes(
    axes: Corridor, half_width: jax.Array, box: Box, present: jax.Array
) -> jax.Array:
    """Whether each corridor shares a point with each box.

    Runs of segments and boxes are first compared as circles; the few pairs that are close are
    collected and tested exactly, a fixed number at a time, until all are done.

    Args:
      axes: `[L, M]` corridors.
      half_width: m.
      box: `[N]` boxes.
      present: `[N]` bool, boxes that exist; the others hit nothing.

    Returns:
      `[L, N]` bool.
    """
    num_boxes = box.x.shape[0]
    pieces = jax.vmap(_segments, (0, None))(axes, half_width)
    spare = -pieces.used.shape[1] % BLOCK
    pieces = jax.tree.map(lambda v: jnp.pad(v, ((0, 0), (0, spare))), pieces)
    blocks = _blocks(axes, pieces, half_width)
    reach = jnp.hypot(box.half_length, box.half_width)
    dx = blocks.x[..., None] - box.x
    dy = blocks.y[..., None] - box.y
    limit = blocks.radius[..., None] + reach
    # A little slack: rounding must not lose a touching pair.
    near = (dx * dx + dy * dy <= limit * limit * 1.0001) & present
    near &= (blocks.radius > 0)[..., None]
    # First the boxes that are near anything, then their (path, run) pairs.
    boxes = prefix_count(jnp.any(near, axis=(0, 1)))
    lane = jnp.arange(BLOCK)
    num_paths, num_blocks = near.shape[:2]

    def some_boxes(carry):
        chunk, hit = carry
        number = chunk * BOXES + jnp.arange(BOXES, dtype=jnp.int32)
        row = nth_true(boxes, number + 1)
        close = near[:, :, row] & (number < boxes[-1])
        pairs = prefix_count(close.reshape(-1))

        def some_pairs(carry):
            part, hit = carry
            wanted = part * PAIRS + jnp.arange(PAIRS, dtype=jnp.int32)
            index = nth_true(pairs, wanted + 1)
            path, block, column = jnp.unravel_index(index, (num_paths, num_blocks, BOXES))
            segment = block[:, None] * BLOCK + lane
            piece = jax.tree.map(lambda v: v[path[:, None], segment], pieces)
            target = jax.tree.map(lambda v: v[row[column]][:, None], box)
            touch = jnp.any(_piece_meets_box(piece, target), axis=1) & (wanted < pairs[-1])
            where = jnp.where(touch, path * num_boxes + row[column], hit.shape[0])
            return part + 1, hit.at[where].set(True, mode="drop")

        _, hit = jax.lax.while_loop(
            lambda carry: carry[0] * PAIRS < pairs[-1], some_pairs, (jnp.int32(0), hit)
        )
        return chunk + 1, hit

    start = (jnp.int32(0), jnp.zeros(num_paths * num_boxes, bool))
    _, hit = jax.lax.while_loop(lambda carry: carry[0] * BOXES < boxes[-1], some_boxes, start)
    return hit.reshape(num_paths, num_boxes)


def corridor_hits_lights(axis: Corridor, half_width: jax.Array, red: RedLights) -> jax.Array:
    """Whether the corridor shares a point with each red area, `[R]` bool."""
    pieces = _segments(axis, half_width)
    ax, ay, bx, by = red.edges.T

    def visit(i, hit):
        return (
            hit
            | segment_meets_box(ax, ay, bx, by, jax.tree.map(lambda v: v[i], pieces.box))
            & (pieces.used[i])
        )

    edge = jax.lax.fori_loop(0, jnp.maximum(axis.count - 1, 1), visit, jnp.zeros(ax.shape, bool))
    inside = crosses_upward_ray(axis.x[0], axis.y[0], ax, ay, bx, by)
    num = red.valid.shape[0]
    edge = (edge & red.edge_valid).astype(jnp.int32)
    inside = (inside & red.edge_valid).astype(jnp.int32)
    touched = jax.ops.segment_max(edge, red.slot, num_segments=num) > 0
    parity = jax.ops.segment_sum(inside, red.slot, num_segments=num)
    return red.valid & (touched | (parity % 2 == 1))


def object_boxes(forecast: AgentForecast) -> Box:
    """Forecast boxes `[S, A]`."""
    heading = forecast.heading.T
    return Box(
        forecast.x.T,
        forecast.y.T,
        jnp.cos(heading),
        jnp.sin(heading),
        jnp.broadcast_to(0.5 * forecast.length, heading.shape),
        jnp.broadcast_to(0.5 * forecast.width, heading.shape),
    )


def project_where(paths: Path, px: jax.Array, py: jax.Array, wanted: jax.Array) -> jax.Array:
    """`geometry.project` onto several paths, only where asked.

    Args:
      paths: `[L, M]` paths.
      px: `[N]` points.
      py: `[N]`.
      wanted: `[L, N]` bool.

    Returns:
      `[L, N]` arc lengths, 0 where not asked.
    """
    num = px.shape[0]
    flat = wanted.reshape(-1)
    counts = prefix_count(flat)

    def some_points(carry):
        chunk, out = carry
        number = chunk * POINTS + jnp.arange(POINTS, dtype=jnp.int32)
        index = nth_true(counts, number + 1)
        path, row = index // num, index % num
        one = lambda p, x, y: project(jax.tree.map(lambda v: v[p], paths), x, y)
        progress = jax.vmap(one)(path, px[row], py[row])
        where = jnp.where(number < counts[-1], index, out.shape[0])
        return chunk + 1, out.at[where].set(progress, mode="drop")

    start = (jnp.int32(0), jnp.zeros(flat.shape, px.dtype))
    _, out = jax.lax.while_loop(lambda carry: carry[0] * POINTS < counts[-1], some_points, start)
    return out.reshape(wanted.shape)
