"""Driving corridors: the strip along a path in which an object counts as a leader.

The reference buffers the path with square caps and round joins. Here the strip is never built: it
is the union of one rectangle per segment and one small wedge per bend, tested against each object.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.observation import RedLights
from spdm_jax.arrays import visit_true
from spdm_jax.geometry import (
    Box,
    Path,
    boxes_overlap,
    crosses_upward_ray,
    interpolate,
    point_segment_sq,
    segment_meets_box,
)
from spdm_jax.types import AgentForecast

# The reference's round joins have 16 segments per quarter circle (shapely's quad_segs).
_JOIN_ANGLE = jnp.pi / 2 / 16
BLOCK = 8
"""Segments in a run that is compared as one circle first."""
PAIRS = 256
"""(run, object) pairs tested exactly at a time."""


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


def _blocks(x: jax.Array, y: jax.Array, reach: jax.Array, used: jax.Array) -> _Blocks:
    """Circles around runs of pieces `[L, M]` that extend `reach` from their middle."""
    group = lambda v: v.reshape(*v.shape[:-1], -1, BLOCK)
    x, y, reach, used = group(x), group(y), group(reach), group(used)
    far = jnp.asarray(1e9, x.dtype)
    low = lambda v: jnp.min(jnp.where(used, v, far), axis=-1)
    high = lambda v: jnp.max(jnp.where(used, v, -far), axis=-1)
    cx, cy = 0.5 * (low(x) + high(x)), 0.5 * (low(y) + high(y))
    distance = jnp.hypot(x - cx[..., None], y - cy[..., None]) + reach
    radius = jnp.max(jnp.where(used, distance, -1), axis=-1)
    some = radius > 0
    return _Blocks(jnp.where(some, cx, 0), jnp.where(some, cy, 0), radius)


class _Strips(NamedTuple):
    """Rectangles around all centres of each object, `[N]` each."""

    cos: jax.Array  # direction from the first to the last centre
    sin: jax.Array
    along: jax.Array  # middle
    across: jax.Array
    half_along: jax.Array
    half_across: jax.Array
    present: jax.Array


def _strips(box: Box, present: jax.Array) -> _Strips:
    """Rectangles around the centres `[S, N]`; direction of travel is the long axis."""
    dx, dy = box.x[-1] - box.x[0], box.y[-1] - box.y[0]
    length = jnp.hypot(dx, dy)
    moves = length > 0
    cos = jnp.where(moves, dx / jnp.where(moves, length, 1), 1)
    sin = jnp.where(moves, dy / jnp.where(moves, length, 1), 0)
    along, across = box.x * cos + box.y * sin, box.y * cos - box.x * sin
    far = jnp.asarray(1e9, box.x.dtype)
    low = lambda v: jnp.min(jnp.where(present, v, far), axis=0)
    high = lambda v: jnp.max(jnp.where(present, v, -far), axis=0)
    ends = low(along), high(along), low(across), high(across)
    return _Strips(
        cos,
        sin,
        0.5 * (ends[0] + ends[1]),
        0.5 * (ends[2] + ends[3]),
        0.5 * (ends[1] - ends[0]),
        0.5 * (ends[3] - ends[2]),
        jnp.any(present, axis=0),
    )


def _blocks_near(blocks: _Blocks, strips: _Strips, margin: jax.Array) -> jax.Array:
    """Whether each run comes within a margin `[N]` of each strip, `[L, M / BLOCK, N]` bool."""
    bx, by, radius = (v[..., None] for v in blocks)
    # A little slack: rounding must not lose a touching pair.
    reach = 1.0001 * (radius + margin) + 1e-3
    along = jnp.abs(bx * strips.cos + by * strips.sin - strips.along)
    across = jnp.abs(by * strips.cos - bx * strips.sin - strips.across)
    near = (along <= strips.half_along + reach) & (across <= strips.half_across + reach)
    return near & (radius > 0) & strips.present


def _for_pairs(near: jax.Array, visit, start):
    """Visits all (path, run, object) triples that are near, a fixed number at a time.

    Args:
      near: `[L, B, N]` bool.
      visit: called with path, run and object `[PAIRS]`, which of them are real, and the carry.
      start: first carry.
    """

    def some(index, real, carry):
        return visit(*jnp.unravel_index(index, near.shape), real, carry)

    return visit_true(near.reshape(-1), PAIRS, some, start)


class _Table(NamedTuple):
    """A pytree of `[L, M]` arrays as one, so that a run of all of them is a single gather."""

    values: jax.Array  # [F, L, M]
    tree: Any
    dtypes: tuple

    def run(self, path: jax.Array, run: jax.Array) -> jax.Array:
        """The `BLOCK` entries of each (path, run), `[F, BLOCK, PAIRS]`."""
        index = run * BLOCK + jnp.arange(BLOCK, dtype=run.dtype)[:, None]
        return self.values[:, path, index]

    def unpack(self, values: jax.Array):
        """The pytree from its fields `[F, ...]`."""
        leaves = [v.astype(t) for v, t in zip(values, self.dtypes, strict=True)]
        return jax.tree.unflatten(self.tree, leaves)


def _table(values) -> _Table:
    leaves, tree = jax.tree.flatten(values)
    dtype = jnp.result_type(*(leaf.dtype for leaf in leaves if leaf.dtype != bool))
    stacked = jnp.stack([leaf.astype(dtype) for leaf in leaves])
    return _Table(stacked, tree, tuple(leaf.dtype for leaf in leaves))


def _pad_to_blocks(values: jax.Array) -> jax.Array:
    return jnp.pad(values, ((0, 0), (0, -values.shape[1] % BLOCK)))


def corridors_hit_boxes(
    axes: Corridor, half_width: jax.Array, box: Box, present: jax.Array
) -> jax.Array:
    """Whether each corridor shares a point with each object at each sample.

    Runs of segments (as circles) are first compared with the strips that the objects sweep in a
    window of time; the few pairs that are close are collected and tested exactly, until all are
    done.

    Args:
      axes: `[L, M]` corridors.
      half_width: m.
      box: `[W, S, N]` boxes of N objects at S samples of W windows.
      present: `[W, S, N]` bool, boxes that exist; the others hit nothing.

    Returns:
      `[W, L, S, N]` bool.
    """
    pieces = jax.tree.map(_pad_to_blocks, jax.vmap(_segments, (0, None))(axes, half_width))
    # A wedge lies within half a width of a rectangle's end, hence inside the same circle.
    reach = jnp.hypot(pieces.box.half_length, pieces.box.half_width)
    blocks = _blocks(pieces.box.x, pieces.box.y, reach, pieces.used)
    table = _table(pieces)
    num_paths, (num_samples, num_objects) = axes.x.shape[0], present.shape[1:]
    sample = jnp.arange(num_samples, dtype=jnp.int32)[:, None]

    def window(given):
        box, present = given
        size = jnp.max(jnp.hypot(box.half_length, box.half_width), axis=0)
        near = _blocks_near(blocks, _strips(box, present), size)
        boxes = jnp.stack(box)

        def visit(path, run, item, real, hit):
            here, target = table.run(path, run), Box(*boxes[:, :, item])

            def one_segment(i, touched):
                return touched | _piece_meets_box(table.unpack(here[:, i]), target)

            none = jnp.zeros((num_samples, PAIRS), bool)
            touched = jax.lax.fori_loop(0, BLOCK, one_segment, none)
            touched &= real & present[:, item]
            where = (path * num_samples + sample) * num_objects + item
            return hit.at[jnp.where(touched, where, hit.shape[0])].set(True, mode="drop")

        hit = _for_pairs(near, visit, jnp.zeros(num_paths * num_samples * num_objects, bool))
        return hit.reshape(num_paths, num_samples, num_objects)

    return jax.lax.map(window, (box, present))


def project_where(paths: Path, half_width: jax.Array, box: Box, wanted: jax.Array) -> jax.Array:
    """`geometry.project` of box centres onto several paths, where the corridors hit the boxes.

    Args:
      paths: `[L, M]` paths.
      half_width: of the corridors, m; a wanted box touches its corridor.
      box: `[W, S, N]` boxes.
      wanted: `[W, L, S, N]` bool.

    Returns:
      `[W, L, S, N]` arc lengths, 0 where not wanted.
    """
    index = jnp.arange(paths.x.shape[1] - 1)
    used = index < jnp.maximum(paths.count - 1, 1)[:, None]
    ax, ay, bx, by = paths.x[:, :-1], paths.y[:, :-1], paths.x[:, 1:], paths.y[:, 1:]
    begin = paths.progress[:, :-1]
    end = jnp.where(index + 1 < paths.count[:, None], paths.progress[:, 1:], begin)
    reach = 0.5 * jnp.hypot(bx - ax, by - ay) + 1e-3
    blocks = _blocks(*(_pad_to_blocks(v) for v in (0.5 * (ax + bx), 0.5 * (ay + by), reach, used)))
    table = _table(jax.tree.map(_pad_to_blocks, (ax, ay, bx, by, begin, end, used)))
    num_samples, num_objects = wanted.shape[2:]
    sample = jnp.arange(num_samples, dtype=jnp.int32)[:, None]

    def window(given):
        box, wanted = given
        size = jnp.max(jnp.hypot(box.half_length, box.half_width), axis=0)
        # From a centre to the corridor, and from there to the path, in the corner of a cap at most.
        margin = size + 1.5 * half_width
        near = _blocks_near(blocks, _strips(box, jnp.any(wanted, axis=0)), margin)
        near &= jnp.any(wanted, axis=1)[:, None]
        flat = wanted.reshape(-1)
        nowhere = flat.shape[0]

        def visit(path, run, item, real, carry):
            least, progress = carry
            px, py = box.x[:, item], box.y[:, item]
            here = table.run(path, run)

            def one_segment(i, best):
                x0, y0, x1, y1, s0, s1, used = table.unpack(here[:, i])
                square, t = point_segment_sq(px, py, x0, y0, x1, y1)
                closer = (square < best[0]) & used
                at = s0 + t * (s1 - s0)
                return jnp.where(closer, square, best[0]), jnp.where(closer, at, best[1])

            start = (jnp.full_like(px, jnp.inf), jnp.zeros_like(px))
            square, at = jax.lax.fori_loop(0, BLOCK, one_segment, start)
            where = (path * num_samples + sample) * num_objects + item
            where = jnp.where(flat[where] & real, where, nowhere)
            closer = least.at[where].min(square, mode="drop")
            progress = jnp.where(closer < least, jnp.inf, progress)
            # Of equally near points the first on the path counts.
            best = square == closer[jnp.minimum(where, nowhere - 1)]
            progress = progress.at[jnp.where(best, where, nowhere)].min(at, mode="drop")
            return closer, progress

        far = jnp.full(flat.shape, jnp.inf, box.x.dtype)
        _, progress = _for_pairs(near, visit, (far, far))
        return jnp.where(wanted, progress.reshape(wanted.shape), 0)

    return jax.lax.map(window, (box, wanted))


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
