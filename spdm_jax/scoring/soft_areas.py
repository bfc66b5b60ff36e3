"""How far inside the road a point lies, smoothly: distances to the polygons that matter to it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import true_indices
from spdm_jax.geometry import crosses_upward_ray, point_segment_sq
from spdm_jax.scoring.smooth import safe_sqrt
from spdm_jax.types import Polygons

_KEPT = 4
"""Polygons kept per point. More than that overlap only where the point is inside anyway."""
_EDGES = 32  # edges looked at together
_NOWHERE = -1e6
"""Depth in a polygon that does not exist, m."""
_CEILING = 12.0
"""Margins end here, in units of the temperature: 1 - 6e-6 in a sigmoid."""


class Layer(NamedTuple):
    """Polygons and which of them count, `[R]` bool."""

    polygons: Polygons
    counts: jax.Array


class _Nearest(NamedTuple):
    """Depth `[K, N]` in the polygons points lie deepest in, and the nearest edges `[4, K, N]`."""

    depth: jax.Array
    edge: jax.Array


def _nearest_edge(polygons: Polygons, row: jax.Array, x: jax.Array, y: jax.Array):
    """Depth `[N]` of points in one polygon (negative outside) and the edge nearest to them."""
    begin, count = polygons.start[row], polygons.count[row]

    def look(part, carry):
        least, edge, odd = carry
        offset = part * _EDGES + jnp.arange(_EDGES, dtype=jnp.int32)
        real = (offset < count)[:, None]
        index = begin + jnp.where(real[:, 0], offset, 0)
        a, b = polygons.xy[index], polygons.next_xy[index]
        ax, ay, bx, by = (v[:, None] for v in (a[:, 0], a[:, 1], b[:, 0], b[:, 1]))
        square, _ = point_segment_sq(x, y, ax, ay, bx, by)
        square = jnp.where(real, square, jnp.inf)
        best = jnp.argmin(square, axis=0)
        nearest = jnp.min(square, axis=0)
        found = jnp.concatenate([a.T, b.T])[:, best]
        crossed = jnp.sum(real & crosses_upward_ray(x, y, ax, ay, bx, by), axis=0)
        nearer = nearest < least
        return (
            jnp.where(nearer, nearest, least),
            jnp.where(nearer, found, edge),
            odd ^ (crossed % 2 == 1),
        )

    start = (jnp.full_like(x, jnp.inf), jnp.zeros((4, *x.shape), x.dtype), jnp.zeros(x.shape, bool))
    parts = (count + _EDGES - 1) // _EDGES
    square, edge, inside = jax.lax.fori_loop(jnp.zeros_like(parts), parts, look, start)
    distance = jnp.sqrt(square)
    return jnp.where(inside, distance, -distance), edge


def _deepest(layers: tuple[Layer, ...], x: jax.Array, y: jax.Array) -> _Nearest:
    """The `_KEPT` polygons that each of `[N]` points lies deepest in."""
    kept = _Nearest(
        jnp.full((_KEPT, *x.shape), _NOWHERE, x.dtype), jnp.zeros((4, _KEPT, *x.shape), x.dtype)
    )
    slot = jnp.arange(_KEPT)[:, None]
    for polygons, counts in layers:
        used = counts & (polygons.count > 0)
        rows, _ = true_indices(used, used.shape[0])

        def visit(i, kept: _Nearest, polygons=polygons, rows=rows):
            depth, edge = _nearest_edge(polygons, rows[i], x, y)
            last = jnp.argmin(kept.depth, axis=0)
            into = (slot == last) & (depth > jnp.min(kept.depth, axis=0))
            return _Nearest(
                jnp.where(into, depth, kept.depth), jnp.where(into, edge[:, None], kept.edge)
            )

        count = jnp.sum(used, dtype=jnp.int32)
        kept = jax.lax.fori_loop(jnp.int32(0), count, visit, kept)
    return kept


def inside_margin(
    layers: tuple[Layer, ...], x: jax.Array, y: jax.Array, temperature: jax.Array
) -> jax.Array:
    """How surely points lie in the union of polygons, in units of the temperature.

    With d_j the signed distance to the edge of polygon j (m, positive inside), the membership is
    min(1, sum_j sigmoid(d_j / temperature)) and the margin its logit. Along an edge that two
    neighbours share the two terms add up to 1: a union has no seams. Deep inside one polygon or far
    outside all, the margin is d / temperature.

    Args:
      layers: polygons and which of them count.
      x: `[...]` points, m.
      y: `[...]`.
      temperature: m.

    Returns:
      `[...]`, at most 12; its gradient with respect to the points is that of the nearest edges.
    """
    shape = x.shape
    x, y = x.reshape(-1), y.reshape(-1)
    fixed = (jax.lax.stop_gradient(x), jax.lax.stop_gradient(y))
    depth, edge = jax.lax.stop_gradient(_deepest(layers, *fixed))
    square, _ = point_segment_sq(x, y, *edge)
    distance = safe_sqrt(square)
    signed = jnp.where(depth > 0, distance, -distance)
    signed = jnp.where(depth > _NOWHERE, signed, _NOWHERE)
    ceiling = -jnp.exp(jnp.asarray(-_CEILING, x.dtype))
    log_member = jax.nn.logsumexp(jax.nn.log_sigmoid(signed / temperature), axis=0)
    log_member = jnp.minimum(log_member, ceiling)
    return (log_member - jnp.log(-jnp.expm1(log_member))).reshape(shape)
