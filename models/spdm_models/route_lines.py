"""Centre lines that the ego may follow from where it is: one per lane and branch of the route.

Source: GameFormer-Planner and DTPP, candidate edges and depth-first search. Differs: lanes and
branches are those of `Route`, and points lie 0.25 m apart by arc length, from the point nearest to
the ego on.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import order_of
from spdm_jax.geometry import interpolate, project
from spdm_jax.map_rows import polygon_distance
from spdm_jax.proposals.lanes import sequence_path
from spdm_jax.types import Array, EgoState, Route, ScenarioMap

from .lattice import POINT_SPACING, Polyline

BLOCK_REACH = 5.0
"""Farther than this from every route lane the ego has no start block, m."""
LANE_REACH = 4.0
"""Lanes of the start block within this of the rear axle are candidates, m."""


@dataclass(frozen=True)
class RouteLineConfig:
    """Static settings.

    Attributes:
      num_lines: C, room for candidates.
      num_points: M, points of a line (0.25 m apart).
      max_path_points: room for the map's points from the first lane's start on.
      min_length: shorter lines are left out where there is a longer one, m (GameFormer 24, DTPP
        60).
    """

    num_lines: int = 8
    num_points: int = 521
    max_path_points: int = 2048
    min_length: float = 60.0


class RouteLines(struct.PyTreeNode, kw_only=True):
    """Candidates, in the order of the route's branches.

    Attributes:
      line: `[C, M]` points in the scenario's frame, the first one beside the ego.
      valid: `[C]` bool.
      lane: `[C]` int32 first lane, -1 where not valid.
      sequence: `[C, S]` int32 lanes from the first one on, -1 padded.
      begin: `[C]` arc length of the first lane before the line's first point, m.
      overflow: `[]` bool, there are more candidates or points than room.
    """

    line: Polyline
    valid: Array
    lane: Array
    sequence: Array
    begin: Array
    overflow: Array


def route_lines(
    scene: ScenarioMap, route: Route, ego: EgoState, config: RouteLineConfig
) -> RouteLines:
    """Finds the candidates.

    Args:
      scene: the map.
      route: the corrected route.
      ego: current state, scalars.
      config: static settings.

    Returns:
      `RouteLines`; none is valid where the ego is more than 5 m away from the route's lanes.
    """
    lanes = scene.lanes
    rows = jnp.arange(lanes.valid.shape[0], dtype=jnp.int32)
    gap = polygon_distance(lanes.polygon, rows, ego.x, ego.y)
    gap = jnp.where(route.lane_on_route & lanes.valid, gap, jnp.inf)
    # Of equally near lanes the first on the route counts.
    nearest = jnp.argmin(jnp.where(gap <= jnp.min(gap), route.slot_of_lane, rows.shape[0]))
    in_block = lanes.roadblock == lanes.roadblock[nearest]
    beside = in_block & (gap < LANE_REACH)
    beside = jnp.where(jnp.any(beside), beside, rows == nearest) & (gap[nearest] <= BLOCK_REACH)

    first = route.branch_start
    wanted = (first >= 0) & beside[first]
    branch = order_of(~wanted)[: config.num_lines]
    path, cut = jax.vmap(
        lambda sequence: sequence_path(lanes.centerline, sequence, config.max_path_points)
    )(route.branch_lanes[branch])
    steps = jnp.arange(config.num_points, dtype=ego.x.dtype) * POINT_SPACING

    def points(line):
        begin = project(line, ego.x, ego.y)
        x, y, _ = interpolate(line, begin + steps)
        count = 1 + jnp.floor((line.length - begin) / POINT_SPACING).astype(jnp.int32)
        return x, y, jnp.clip(count, 1, config.num_points), begin

    x, y, count, begin = jax.vmap(points)(path)
    dx, dy = jnp.diff(x, axis=1), jnp.diff(y, axis=1)
    heading = jnp.arctan2(dy, dx)
    # The last point takes over the heading of the step before it.
    last = jnp.take_along_axis(heading, jnp.maximum(count - 2, 0)[:, None], axis=1)
    heading = jnp.pad(heading, ((0, 0), (0, 1)))
    heading = jnp.where(jnp.arange(config.num_points) < count[:, None] - 1, heading, last)

    valid = wanted[branch] & (count >= 3)
    longest = jnp.max(jnp.where(valid, count, 0))
    enough = jnp.minimum(jnp.asarray(config.min_length / POINT_SPACING, jnp.int32), longest)
    valid = valid & (count >= enough)
    short = cut & (count < config.num_points) & wanted[branch]
    overflow = (jnp.sum(wanted) > config.num_lines) | jnp.any(short)
    return RouteLines(
        line=Polyline(x, y, heading, count),
        valid=valid,
        lane=jnp.where(valid, first[branch], -1).astype(jnp.int32),
        sequence=route.branch_lanes[branch],
        begin=begin,
        overflow=overflow,
    )


def first_speed_limit(scene: ScenarioMap, route: Route, lines: RouteLines, unknown: float) -> Array:
    """Speed limit of the first candidate lane on the route, `[]` m/s.

    Args:
      scene: the map.
      route: the corrected route.
      lines: candidates.
      unknown: taken where the map knows no limit or there is no candidate, m/s.
    """
    far = jnp.iinfo(jnp.int32).max
    slot = jnp.where(lines.valid, route.slot_of_lane[lines.lane], far)
    limit = scene.lanes.speed_limit[lines.lane[jnp.argmin(slot)]]
    known = jnp.any(lines.valid) & ~jnp.isnan(limit)
    return jnp.where(known, limit, jnp.asarray(unknown, limit.dtype))
