"""Single polygons and polylines out of flat tables, addressed by their rows.

A row's edges are walked in blocks, so that the work follows the rows that are asked about and not
the size of the map.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from spdm_jax.arrays import prefix_sum
from spdm_jax.geometry import crosses_upward_ray, point_segment_sq
from spdm_jax.types import Polygons, Polylines

_BLOCK = 64
Carry = TypeVar("Carry")


def _walk(
    start: jax.Array,
    count: jax.Array,
    size: int,
    visit: Callable[[jax.Array, jax.Array, Carry], Carry],
    carry: Carry,
) -> Carry:
    """Visits entries `start ... start + count` of a table, for many rows `[...]` at a time.

    `visit` gets indices `[..., 64]`, which of them are real, and the carry.
    """
    offset = jnp.arange(_BLOCK, dtype=jnp.int32)

    def block(i, carry):
        place = i * _BLOCK + offset
        real = place < count[..., None]
        return visit(jnp.clip(start[..., None] + place, 0, size - 1), real, carry)

    return jax.lax.fori_loop(0, (jnp.max(count, initial=0) + _BLOCK - 1) // _BLOCK, block, carry)


def polygon_contains(polygons: Polygons, row: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether points `[...]` lie in the polygons of their rows `[...]` (even-odd rule)."""

    def visit(edge, real, odd):
        a, b = polygons.xy[edge], polygons.next_xy[edge]
        cross = crosses_upward_ray(
            x[..., None], y[..., None], a[..., 0], a[..., 1], b[..., 0], b[..., 1]
        )
        return odd ^ (jnp.sum(cross & real, axis=-1) % 2 == 1)

    start, count = polygons.start[row], polygons.count[row]
    odd = jnp.zeros(jnp.broadcast_shapes(row.shape, x.shape), bool)
    return _walk(start, count, polygons.xy.shape[0], visit, odd)


def polygon_distance(polygons: Polygons, row: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Distance from points `[...]` to the polygons of their rows `[...]`, 0 inside, m."""

    def visit(edge, real, carry):
        odd, least = carry
        a, b = polygons.xy[edge], polygons.next_xy[edge]
        ends = (x[..., None], y[..., None], a[..., 0], a[..., 1], b[..., 0], b[..., 1])
        square, _ = point_segment_sq(*ends)
        cross = crosses_upward_ray(*ends) & real
        least = jnp.minimum(least, jnp.min(jnp.where(real, square, jnp.inf), axis=-1))
        return odd ^ (jnp.sum(cross, axis=-1) % 2 == 1), least

    start, count = polygons.start[row], polygons.count[row]
    shape = jnp.broadcast_shapes(row.shape, x.shape)
    carry = (jnp.zeros(shape, bool), jnp.full(shape, jnp.inf, x.dtype))
    odd, least = _walk(start, count, polygons.xy.shape[0], visit, carry)
    return jnp.where(odd, 0, jnp.sqrt(least))


def arc_length_at(lines: Polylines, row: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Arc length of the nearest point on the polylines of rows `[...]`, m; first one on ties."""
    size = lines.points.shape[0]

    def visit(point, real, carry):
        least, at, before = carry
        following = jnp.minimum(point + 1, size - 1)
        a, b = lines.points[point, :2], lines.points[following, :2]
        square, t = point_segment_sq(
            x[..., None], y[..., None], a[..., 0], a[..., 1], b[..., 0], b[..., 1]
        )
        length = jnp.where(real, jnp.hypot(b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]), 0)
        end = prefix_sum(length)
        square = jnp.where(real, square, jnp.inf)
        best = jnp.argmin(square, axis=-1)[..., None]
        pick = lambda v: jnp.take_along_axis(v, best, axis=-1)[..., 0]
        here = before + pick(end - length + t * length)
        nearer = pick(square) < least
        return (
            jnp.where(nearer, pick(square), least),
            jnp.where(nearer, here, at),
            before + end[..., -1],
        )

    zero = jnp.zeros(jnp.broadcast_shapes(row.shape, x.shape), x.dtype)
    # A segment per point but the last.
    count = jnp.maximum(lines.count[row] - 1, 0)
    return _walk(lines.start[row], count, size, visit, (zero + jnp.inf, zero, zero))[1]


def line_ends(lines: Polylines, row: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First and last points of the polylines of rows `[...]`, `[..., 2]` each."""
    first = lines.start[row]
    last = first + jnp.maximum(lines.count[row] - 1, 0)
    return lines.points[first, :2], lines.points[last, :2]
