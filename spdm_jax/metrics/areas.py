"""Drivable-area compliance: corners outside, and how far."""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_count, visit_true
from spdm_jax.geometry import crosses_upward_ray, point_segment_sq
from spdm_jax.metrics.motion import Motion
from spdm_jax.metrics.params import MetricParams
from spdm_jax.types import Array, Polygons, ScenarioMap

_CORNERS = 32  # corners that are looked at together


class DrivableArea(struct.PyTreeNode, kw_only=True):
    """Drivable-area compliance of one run.

    Attributes:
      outside: `[T, 4]` bool, the corner is in no lane and in no drivable polygon.
      far: `[T, 4]` bool, outside by the tolerance or more.
      inside: `[T]` bool, no corner is outside.
      always_inside: `[]` bool.
      score: `[]` 0 or 1.
    """

    outside: Array
    far: Array
    inside: Array
    always_inside: Array
    score: Array


def _in_any(polygons: Polygons, x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether points `[N]` lie in any polygon (even-odd rule each), `[N]` bool."""
    a, b = polygons.xy, polygons.next_xy
    cross = crosses_upward_ray(x[:, None], y[:, None], a[:, 0], a[:, 1], b[:, 0], b[:, 1])
    # Rows are contiguous, so differences of running counts are their crossings.
    total = jnp.pad(prefix_count(cross & polygons.valid), ((0, 0), (1, 0)))
    crossings = total[:, polygons.start + polygons.count] - total[:, polygons.start]
    return jnp.any((crossings % 2 == 1) & (polygons.count > 0), axis=1)


def _distance(polygons: Polygons, counts: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Distance from points `[N]` to the nearest of the edges that count `[N, V]`, m."""
    a, b = polygons.xy, polygons.next_xy
    square, _ = point_segment_sq(x[:, None], y[:, None], a[:, 0], a[:, 1], b[:, 0], b[:, 1])
    return jnp.sqrt(jnp.min(jnp.where(counts, square, jnp.inf), axis=1))


def drivable_area(
    scene_map: ScenarioMap,
    move: Motion,
    corners: jax.Array,
    route: jax.Array,
    valid: jax.Array,
    params: MetricParams,
) -> DrivableArea:
    """Judges the box's corners.

    A corner outside is far unless it is nearer than the tolerance to a lane of the box centre's
    route or to a drivable polygon.

    Args:
      scene_map: the world.
      move: `[T]` the ego's box.
      corners: `[T, 4, L]` bool, lanes of each corner.
      route: `[T, L]` bool, lanes of the centre.
      valid: `[T]` bool, a prefix.
      params: tolerance.

    Source: nuPlan `drivable_area_compliance`.
    """
    steps = valid.shape[0]
    x, y = move.corner_x.reshape(-1), move.corner_y.reshape(-1)
    lane_polygons, drivable = scene_map.lanes.polygon, scene_map.drivable
    suspects = (~jnp.any(corners, axis=-1) & valid[:, None]).reshape(-1)

    def look(corner, real, flags):
        px, py = x[corner], y[corner]
        outside = ~_in_any(drivable, px, py) & real
        of_route = route[corner // 4][:, lane_polygons.row] & lane_polygons.valid
        near = _distance(lane_polygons, of_route, px, py) < params.max_outside
        near |= _distance(drivable, drivable.valid, px, py) < params.max_outside
        place = jnp.where(real, corner, 4 * steps)
        return tuple(
            flag.at[place].set(value, mode="drop")
            for flag, value in zip(flags, (outside, outside & ~near), strict=True)
        )

    nowhere = jnp.zeros(4 * steps, bool)
    outside, far = (
        flag.reshape(steps, 4) for flag in visit_true(suspects, _CORNERS, look, (nowhere, nowhere))
    )
    inside = ~jnp.any(outside, axis=1)
    return DrivableArea(
        outside=outside,
        far=far,
        inside=inside,
        always_inside=jnp.all(inside),
        score=(~jnp.any(far)).astype(x.dtype),
    )
