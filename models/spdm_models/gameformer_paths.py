"""GameFormer's reference path: the cheapest way onto a route lane, with limits and red lights.

Source: GameFormer-Planner, `LatticePlanner` and the annotations around it.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.geometry import Box, box_at, box_distance, wrap
from spdm_jax.types import Array

from .lattice import (
    COST_POINTS,
    KNOT_STRIDE,
    POINT_SPACING,
    Course,
    Polyline,
    lattice_paths,
    max_curvature,
    spline_course,
    swept_path_distance,
    swept_path_hits,
)

OBSTACLE_COST = 10.0
"""Costs are metres of distance to the centre line."""
BOUNDARY_COST = 2.0
CURVATURE_COST = 0.1
FREE_LANE_GAIN = 5.0
STAY_FACTOR = 5.0
"""Factor of the distance where lane changes are discouraged."""
FREE_POINTS = 50
"""Points of a path that moving vehicles must keep away from for its lane to count as free."""
FREE_GAP = 5.0
"""How far away, m."""
LENGTH_SLACK = 5.0
"""A lane that ends this much before the longest one does not count as free, m."""
MIN_LENGTH = 24.0
"""Shorter lanes are left out where there is a longer one, m."""
OBJECT_RANGE = 30.0
"""Objects farther from the ego's box play no part, m."""
STANDING_SPEED = 0.01
"""Vehicles slower than this are obstacles, m/s."""
CROWDED_LANES, CROWDED_SPEED = 4, 3.0
"""On so many lanes and at this speed (m/s) or below, lane changes are discouraged."""
SPEED_RANGE = (3.0, 15.0)
"""Speed limits are clipped to it, m/s."""
TURN_CURVATURE, TURN_SPEED = 0.1, 3.0
"""From the first point that is curved that much (1/m) on, the limit is low (m/s)."""
LIGHT_GAP = 0.5
"""Points this close to a red connector are occupied, m."""
LIGHT_POINTS = 80
"""Connectors with fewer points (shorter than 20 m) are left out."""


class Boundaries(struct.PyTreeNode, kw_only=True):
    """Outer edges of the lanes along each candidate: segments of sides without a neighbour lane.

    Attributes:
      ax, ay: `[C, E]` starts, m.
      bx, by: `[C, E]` ends, m.
      valid: `[C, E]` bool.
    """

    ax: Array
    ay: Array
    bx: Array
    by: Array
    valid: Array


class PathCosts(struct.PyTreeNode, kw_only=True):
    """Terms of the candidates' costs, all `[C, 4]` but one: lane, end of the Bezier curve.

    Attributes:
      curvature: largest of the first 25 m, 1/m.
      distance: `[C]` from the ego to the lane, m.
      lane_free: bool, no moving vehicle near and no end of the lane ahead.
      hits_obstacle: bool.
      leaves_boundary: bool.
      valid: bool, False where there is no such path.
    """

    curvature: Array
    distance: Array
    lane_free: Array
    hits_obstacle: Array
    leaves_boundary: Array
    valid: Array

    def total(self, stay: jax.Array) -> jax.Array:
        """Returns the costs `[C, 4]`, inf where there is no path; `stay` is a bool."""
        dtype = self.curvature.dtype
        distance = self.distance * jnp.where(stay, STAY_FACTOR, 1).astype(dtype)
        cost = (
            OBSTACLE_COST * self.hits_obstacle.astype(dtype)
            + BOUNDARY_COST * self.leaves_boundary.astype(dtype)
            + distance[:, None]
            + CURVATURE_COST * self.curvature
            - FREE_LANE_GAIN * self.lane_free.astype(dtype)
        )
        return jnp.where(self.valid, cost, jnp.inf)


class ReferencePath(struct.PyTreeNode, kw_only=True):
    """The path that a plan follows, one row every 0.1 m, in the ego frame.

    Attributes:
      path: `[P, 3]` x, y, heading; rows beyond the real ones repeat the last one.
      curvature: `[P]` 1/m, left positive.
      speed_limit: `[P]` m/s.
      red_light: `[P]` bool, within a connector whose light is red.
      valid: `[]` bool, False where no path was found.
    """

    path: Array
    curvature: Array
    speed_limit: Array
    red_light: Array
    valid: Array


def path_objects(
    boxes: Box, is_vehicle: jax.Array, is_static: jax.Array, speed: jax.Array, ego: Box
) -> tuple[jax.Array, jax.Array]:
    """Returns which objects `[A]` block a path, and which are moving vehicles.

    Args:
      boxes: `[A]`.
      is_vehicle: `[A]` bool.
      is_static: `[A]` bool: cones, barriers, signs, other objects.
      speed: `[A]` m/s.
      ego: the ego's box.
    """
    near = box_distance(ego, boxes) <= OBJECT_RANGE
    standing = speed < STANDING_SPEED
    return near & (is_static | (is_vehicle & standing)), near & is_vehicle & ~standing


def discourage_lane_change(
    light_data: jax.Array, num_lanes: jax.Array, speed: jax.Array
) -> jax.Array:
    """Whether distance to the ego's lane counts five times.

    Args:
      light_data: `[]` bool, the state of any traffic light is known.
      num_lanes: `[]` lanes of the road section that the ego is on.
      speed: `[]` longitudinal speed of the ego, m/s.
    """
    return light_data | ((num_lanes >= CROWDED_LANES) & (speed <= CROWDED_SPEED))


def path_costs(
    lines: Polyline,
    line_valid: jax.Array,
    ego: tuple[jax.Array, jax.Array, jax.Array],
    boxes: Box,
    obstacle: jax.Array,
    moving: jax.Array,
    boundaries: Boundaries,
) -> PathCosts:
    """Prices the paths onto the candidate lanes.

    Args:
      lines: `[C, M]` centre lines, points 0.25 m apart.
      line_valid: `[C]` bool.
      ego: x, y, heading of the rear axle in the frame of the lines, each `[]`.
      boxes: `[A]` objects in the same frame.
      obstacle: `[A]` bool, of `path_objects`.
      moving: `[A]` bool, of `path_objects`.
      boundaries: in the same frame.
    """
    paths = jax.vmap(lattice_paths, (0, None, None, None))(lines, *ego)
    # The first path has one point less than the line that is left ahead.
    points = paths.count[:, 0] + 1
    length = POINT_SPACING * points.astype(lines.x.dtype)
    usable = line_valid & (points >= 3)
    longest = jnp.max(jnp.where(usable, length, 0))
    usable = usable & (length >= jnp.minimum(MIN_LENGTH, longest))

    def price(x, y, count, edges: Boundaries):
        ahead = slice(0, COST_POINTS), slice(0, FREE_POINTS)
        ends = [jnp.minimum(count, s.stop) for s in ahead]
        hits = swept_path_hits(x[ahead[0]], y[ahead[0]], ends[0], boxes, obstacle)
        gap = swept_path_distance(x[ahead[1]], y[ahead[1]], ends[1], boxes, moving)
        lines = _segment_boxes(edges)
        leaves = swept_path_hits(x[ahead[0]], y[ahead[0]], ends[0], lines, edges.valid)
        free = jnp.min(gap, initial=jnp.inf) >= FREE_GAP
        return max_curvature(x, y, count), free, jnp.any(hits), jnp.any(leaves)

    over_ends = jax.vmap(price, (0, 0, 0, None))
    terms = jax.vmap(over_ends)(paths.x, paths.y, paths.count, boundaries)
    curvature, free, hits, leaves = terms
    long_enough = jnp.abs(length - longest) <= LENGTH_SLACK
    return PathCosts(
        curvature=curvature,
        distance=paths.distance,
        lane_free=free & long_enough[:, None],
        hits_obstacle=hits,
        leaves_boundary=leaves,
        valid=paths.valid & usable[:, None],
    )


def _segment_boxes(edges: Boundaries) -> Box:
    """Segments as boxes without width."""
    dx, dy = edges.bx - edges.ax, edges.by - edges.ay
    return box_at(
        0.5 * (edges.ax + edges.bx),
        0.5 * (edges.ay + edges.by),
        jnp.arctan2(dy, dx),
        0.5 * jnp.hypot(dx, dy),
        jnp.zeros_like(dx),
    )


def cheapest_course(
    lines: Polyline, ego: tuple[jax.Array, jax.Array, jax.Array], cost: jax.Array
) -> tuple[Course, jax.Array]:
    """Returns the spline along the cheapest path, in the ego frame, and whether there is one.

    Args:
      lines: `[C, M]` as in `path_costs`.
      ego: as in `path_costs`.
      cost: `[C, 4]` of `PathCosts.total`.
    """
    x0, y0, heading = ego
    best = jnp.argmin(cost)
    line, end = best // cost.shape[1], best % cost.shape[1]
    path = lattice_paths(jax.tree.map(lambda v: v[line], lines), x0, y0, heading)
    knots = (path.count[end] + KNOT_STRIDE - 1) // KNOT_STRIDE
    dx, dy = path.x[end, ::KNOT_STRIDE] - x0, path.y[end, ::KNOT_STRIDE] - y0
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    course = spline_course(dx * cos + dy * sin, dy * cos - dx * sin, knots)
    course = course.replace(heading=wrap(course.heading))
    return course, jnp.isfinite(jnp.min(cost)) & (knots > 1)


def annotate(
    course: Course,
    valid: jax.Array,
    speed_limit: jax.Array,
    red: Polyline,
) -> ReferencePath:
    """Adds speed limits and red lights to a path.

    Args:
      course: `[P]` in the ego frame.
      valid: `[]` bool, whether there is one.
      speed_limit: `[]` of the ego's road, m/s.
      red: `[R, K]` centre lines of connectors with a red light, in the ego frame; count 0 pads.
    """
    limit = jnp.clip(speed_limit, *SPEED_RANGE)
    curved = jnp.abs(course.curvature) > TURN_CURVATURE
    turn = jnp.argmax(curved)
    row = jnp.arange(course.x.shape[0])
    # A path that is curved from its first row on keeps its limit, as in the reference.
    slow = (turn > 0) & (row >= turn)
    counts = jnp.where(red.count >= LIGHT_POINTS, red.count, 0)

    def near(x, y, count):
        square = (course.x[:, None] - x) ** 2 + (course.y[:, None] - y) ** 2
        return jnp.any((square < LIGHT_GAP**2) & (jnp.arange(x.shape[0]) < count), axis=1)

    return ReferencePath(
        path=jnp.stack([course.x, course.y, course.heading], axis=-1),
        curvature=course.curvature,
        speed_limit=jnp.where(slow, TURN_SPEED, limit).astype(course.x.dtype),
        red_light=jnp.any(jax.vmap(near)(red.x, red.y, counts), axis=0),
        valid=valid,
    )
