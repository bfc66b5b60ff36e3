"""Lane look-ups on the device: starting lane, drivable map near the ego, paths from lanes."""

import jax
import jax.numpy as jnp

from spdm_jax.config import VehicleParams
from spdm_jax.geometry import (
    Box,
    Path,
    crosses_upward_ray,
    ego_box,
    make_path,
    segment_box_distance,
    segment_meets_box,
    wrap,
)
from spdm_jax.scoring.areas import AreaMasks, pack_bits
from spdm_jax.types import EgoState, Polygons, Polylines, Route, ScenarioMap


def polygons_containing(polygons: Polygons, x: jax.Array, y: jax.Array, num: int) -> jax.Array:
    """Which of `num` polygons contain one point, `[num]` bool, by the even-odd rule."""
    crossing = crosses_upward_ray(
        x, y, polygons.xy[:, 0], polygons.xy[:, 1], polygons.next_xy[:, 0], polygons.next_xy[:, 1]
    )
    parity = jax.ops.segment_sum(
        (crossing & polygons.valid).astype(jnp.int32), polygons.row, num_segments=num
    )
    return parity % 2 == 1


def polygons_meeting_box(polygons: Polygons, box: Box, num: int) -> jax.Array:
    """Which of `num` polygons share a point with one box, `[num]` bool."""
    meets = segment_meets_box(
        polygons.xy[:, 0], polygons.xy[:, 1], polygons.next_xy[:, 0], polygons.next_xy[:, 1], box
    )
    touched = jax.ops.segment_max(
        (meets & polygons.valid).astype(jnp.int32), polygons.row, num_segments=num
    )
    return (touched > 0) | polygons_containing(polygons, box.x, box.y, num)


def drivable_lanes(
    scene: ScenarioMap, center_x: jax.Array, center_y: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Lanes `[L]` and car parks `[C]` of the drivable map around the ego.

    All lanes of every roadblock whose area meets the axis-aligned square of half side `radius`
    around the ego's centre, and the car parks that meet it.

    Source: tuplan_garage `PDMDrivableMap`.
    """
    one, zero = jnp.ones_like(center_x), jnp.zeros_like(center_x)
    square = Box(center_x, center_y, one, zero, one * radius, one * radius)
    blocks = polygons_meeting_box(scene.roadblocks.polygon, square, scene.roadblocks.valid.shape[0])
    lanes = scene.lanes.valid & (scene.lanes.roadblock >= 0) & blocks[scene.lanes.roadblock]
    parks = polygons_meeting_box(scene.car_parks, square, scene.car_parks.start.shape[0])
    return lanes, parks & (scene.car_parks.count > 0)


def area_masks(
    scene: ScenarioMap, lane_on_route: jax.Array, lanes: jax.Array, parks: jax.Array
) -> AreaMasks:
    """Bit masks of this step's drivable map for the scorer."""
    words = scene.grid.masks.shape[1]
    crossings = scene.intersections.count > 0
    none = [jnp.zeros_like(flags) for flags in (lanes, parks, crossings)]
    return AreaMasks(
        drivable=pack_bits(jnp.concatenate([lanes, parks, none[2]]), words),
        on_route=pack_bits(jnp.concatenate([lanes & lane_on_route, none[1], none[2]]), words),
        intersection=pack_bits(jnp.concatenate([none[0], none[1], crossings]), words),
    )


def nearest_heading(lines: Polylines, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance to and heading of the nearest stored point of each polyline, `[L]` each."""
    num = lines.start.shape[0]
    square = (lines.points[:, 0] - x) ** 2 + (lines.points[:, 1] - y) ** 2
    square = jnp.where(lines.valid, square, jnp.inf)
    least = jax.ops.segment_min(square, lines.row, num_segments=num)
    index = jnp.where(square <= least[lines.row], jnp.arange(square.shape[0]), square.shape[0])
    first = jax.ops.segment_min(index, lines.row, num_segments=num)
    heading = lines.points[jnp.minimum(first, square.shape[0] - 1), 2]
    return jnp.sqrt(least), heading


def starting_lane(
    scene: ScenarioMap, route: Route, lanes: jax.Array, ego: EgoState, vehicle: VehicleParams
) -> jax.Array:
    """The route lane the ego is on, `[]` int32 (-1 if the route has none).

    Among on-route lanes of the drivable map that contain the rear axle, the one with the smallest
    heading error at its nearest baseline point; else the first route lane that contains the ego's
    centre; else the one nearest to the footprint.

    Args:
      scene: map.
      route: route.
      lanes: `[L]` bool drivable map of this step.
      ego: current state, scalars.
      vehicle: ego dimensions.

    Source: tuplan_garage `AbstractPDMPlanner._get_starting_lane`.
    """
    num = scene.lanes.valid.shape[0]
    polygon = scene.lanes.polygon
    on_route = route.lane_on_route & scene.lanes.valid
    _, heading = nearest_heading(scene.lanes.centerline, ego.x, ego.y)
    error = jnp.abs(wrap(heading - ego.heading))
    here = polygons_containing(polygon, ego.x, ego.y, num) & on_route & lanes
    by_heading = jnp.argmin(jnp.where(here, error, jnp.inf))

    box = ego_box(ego, vehicle)
    # "First" is in the order of the route's slots.
    order = jnp.where(on_route, route.slot_of_lane, num)
    inside = polygons_containing(polygon, box.x, box.y, num) & on_route
    first = jnp.argmin(jnp.where(inside, order, num))
    edge = segment_box_distance(
        polygon.xy[:, 0], polygon.xy[:, 1], polygon.next_xy[:, 0], polygon.next_xy[:, 1], box
    )
    distance = jax.ops.segment_min(
        jnp.where(polygon.valid, edge, jnp.inf), polygon.row, num_segments=num
    )
    distance = jnp.where(on_route, distance, jnp.inf)
    tied = distance <= jnp.min(distance)
    nearest = jnp.argmin(jnp.where(tied & on_route, order, num))
    lane = jnp.where(jnp.any(here), by_heading, jnp.where(jnp.any(inside), first, nearest))
    return jnp.where(jnp.any(on_route), lane, -1).astype(jnp.int32)


def sequence_path(lines: Polylines, lanes: jax.Array, max_points: int) -> tuple[Path, jax.Array]:
    """Joins the baselines of a lane sequence into one path.

    Args:
      lines: baselines.
      lanes: `[S]` int32 lane indices, -1 padded.
      max_points: M.

    Returns:
      `Path` `[M]` (points where lanes join are kept twice, as in the reference) and whether it
      did not fit.

    Source: tuplan_garage `AbstractPDMPlanner._get_discrete_centerline`.
    """
    count = jnp.where(lanes >= 0, lines.count[lanes], 0)
    end = jnp.cumsum(count)
    index = jnp.arange(max_points)
    part = jnp.sum(index[:, None] >= end[None, :], axis=1)
    part = jnp.minimum(part, lanes.shape[0] - 1)
    offset = index - (end - count)[part]
    total = end[-1]
    source = jnp.clip(lines.start[lanes[part]] + offset, 0, lines.points.shape[0] - 1)
    points = lines.points[jnp.where(index < total, source, 0)]
    kept = jnp.minimum(total, max_points).astype(jnp.int32)
    return make_path(points[:, 0], points[:, 1], points[:, 2], kept), total > max_points


def parallel_path(path: Path, offset: jax.Array) -> Path:
    """Moves every point sideways (left positive), same headings.

    Source: tuplan_garage `parallel_discrete_path`.
    """
    left = path.heading + 0.5 * jnp.pi
    return make_path(
        path.x + offset * jnp.cos(left),
        path.y + offset * jnp.sin(left),
        path.heading,
        path.count,
    )
