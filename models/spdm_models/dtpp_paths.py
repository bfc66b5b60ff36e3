"""DTPP's reference paths: the cheapest ways onto the route's lanes, as splines in the ego frame.

Source: DTPP, `TreePlanner.generate_paths`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import order_of
from spdm_jax.geometry import Box
from spdm_models.lattice import (
    COST_POINTS,
    KNOT_STRIDE,
    Course,
    Polyline,
    lattice_paths,
    max_curvature,
    spline_course,
    swept_path_hits,
)

OBSTACLE_COST = 10.0
"""Cost of a path that an obstacle blocks, in metres of distance to the centre line."""
CURVATURE_COST = 0.1
"""Cost of curvature, m per 1/m."""
STANDING_SPEED = 0.1
"""Vehicles slower than this are obstacles, m/s."""


class ReferencePaths(struct.PyTreeNode):
    """The best paths onto the route's lanes, cheapest first.

    Attributes:
      course: `[R, L]` in the ego frame.
      valid: `[R]` bool.
      cost: `[C, 4]` of every candidate, m; inf where there is none.
    """

    course: Course
    valid: jax.Array
    cost: jax.Array


def is_obstacle(is_vehicle: jax.Array, is_static: jax.Array, speed: jax.Array) -> jax.Array:
    """Objects that block a path: static ones, and vehicles that stand.

    Args:
      is_vehicle: `[A]` bool.
      is_static: `[A]` bool, cones, barriers and the like.
      speed: `[A]` m/s.
    """
    return is_static | (is_vehicle & (speed < STANDING_SPEED))


def reference_paths(
    lines: Polyline,
    line_valid: jax.Array,
    ego: tuple[jax.Array, jax.Array, jax.Array],
    obstacles: Box,
    obstacle_valid: jax.Array,
    num_paths: int,
) -> ReferencePaths:
    """Picks the cheapest paths onto the candidate lanes and turns them into splines.

    Of paths with exactly the same cost only the last one counts, as in the reference.

    Args:
      lines: `[C, M]` centre lines, points 0.25 m apart.
      line_valid: `[C]` bool.
      ego: x, y, heading of the rear axle in the frame of the lines, each `[]`.
      obstacles: `[A]` boxes in the same frame.
      obstacle_valid: `[A]` bool.
      num_paths: R, paths to keep.
    """
    paths = jax.vmap(lattice_paths, (0, None, None, None))(lines, *ego)

    def price(x, y, count, distance):
        ahead = (jnp.minimum(count, COST_POINTS) + KNOT_STRIDE - 1) // KNOT_STRIDE
        thin = slice(0, COST_POINTS, KNOT_STRIDE)
        hits = swept_path_hits(x[thin], y[thin], ahead, obstacles, obstacle_valid)
        blocked = jnp.any(hits).astype(x.dtype)
        return OBSTACLE_COST * blocked + distance + CURVATURE_COST * max_curvature(x, y, count)

    over_ends = jax.vmap(price, (0, 0, 0, None))
    cost = jax.vmap(over_ends)(paths.x, paths.y, paths.count, paths.distance)
    cost = jnp.where(paths.valid & line_valid[:, None], cost, jnp.inf)
    flat = cost.reshape(-1)
    index = jnp.arange(flat.shape[0])
    replaced = jnp.any((flat[:, None] == flat) & (index[:, None] < index), axis=1)
    order = order_of(jnp.where(replaced, jnp.inf, flat))[:num_paths]
    x0, y0, heading = ego
    cos, sin = jnp.cos(heading), jnp.sin(heading)

    def course(i):
        dx = paths.x.reshape(flat.shape[0], -1)[i, ::KNOT_STRIDE] - x0
        dy = paths.y.reshape(flat.shape[0], -1)[i, ::KNOT_STRIDE] - y0
        knots = (paths.count.reshape(-1)[i] + KNOT_STRIDE - 1) // KNOT_STRIDE
        return spline_course(dx * cos + dy * sin, dy * cos - dx * sin, knots), knots > 1

    courses, long_enough = jax.vmap(course)(order)
    valid = jnp.isfinite(flat[order]) & ~replaced[order] & long_enough
    return ReferencePaths(courses, valid, cost)
