"""Lanes as interPlan asks for them: where a vehicle is, and chains of lanes as one line."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import LineString

from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.raw import RawMap

_HEADING_STEP = 0.5
"""The heading at a point of a line is that towards the point so far on, m (nuPlan)."""


def lane_at(query: MapQuery, pose: np.ndarray) -> str | None:
    """Returns the lane of a vehicle.

    Among the lanes that contain it, or within an intersection the connectors, that whose baseline
    has the heading nearest to the vehicle's, not wrapped (as published).

    Args:
      query: the map.
      pose: `[3]` box centre.

    Returns:
      Lane id; None off all lanes.

    Source: interPlan `get_starting_segment`; differs: a centre between connectors is off all lanes,
    where interPlan looks at the corners.
    """
    point = pose[None, :2]
    (found,) = query.containing(MapLayer.LANE, point)
    if not found and query.containing(MapLayer.INTERSECTION, point)[0]:
        (found,) = query.containing(MapLayer.LANE_CONNECTOR, point)
    if not found:
        return None
    error = [abs(query.project(lane, pose[:2]).pose[2] - pose[2]) for lane in found]
    return found[int(np.argmin(error))]


def block_at(query: MapQuery, point: Sequence[float] | np.ndarray) -> str | None:
    """Returns the roadblock that contains a point, else the first such connector, else None."""
    place = np.asarray(point, float)[None, :2]
    for layer in (MapLayer.ROADBLOCK, MapLayer.ROADBLOCK_CONNECTOR):
        (found,) = query.containing(layer, place)
        if found:
            return found[0]
    return None


def lanes_of(world: RawMap, block: str) -> list[str]:
    """Returns the lanes of a roadblock that the map has, from left to right."""
    return [lane for lane in world.roadblocks[block].lanes if lane in world.lanes]


def baseline(world: RawMap, lane: str) -> LineString:
    """Returns a lane's baseline."""
    return LineString(world.lanes[lane].centerline[:, :2])


def joined(world: RawMap, lanes: Sequence[str]) -> LineString:
    """Returns the baselines of consecutive lanes as one line."""
    points = np.concatenate([world.lanes[lane].centerline[:, :2] for lane in lanes])
    distinct = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 0)
    return LineString(points[distinct])


def pose_on(line: LineString, arc_length: float) -> np.ndarray:
    """Returns the pose `[3]` at an arc length of a line, m; its heading looks ahead."""
    here, ahead = point_on(line, arc_length), point_on(line, arc_length + _HEADING_STEP)
    step = ahead - here
    if not step.any():
        # At the very end the heading is taken backwards.
        step = here - point_on(line, arc_length - _HEADING_STEP)
    return np.array([*here, np.arctan2(step[1], step[0])])


def point_on(line: LineString, arc_length: float) -> np.ndarray:
    """Returns the point `[2]` at an arc length of a line, held at its ends."""
    return shapely.get_coordinates(line.interpolate(min(max(arc_length, 0.0), line.length)))[0]


def chain_around(query: MapQuery, lane: str, point: np.ndarray, reach: float) -> list[str]:
    """Extends a lane both ways until it covers `reach` before and after a point.

    Signalised connectors end it (in the order of the map's links, as published); of several ways
    on, the one with the least curvature at its start is taken.

    Args:
      query: the map.
      lane: to start from.
      point: x, y; its projection on the lane is where the lengths count from.
      reach: m.

    Returns:
      Lanes in driving order.
    """
    world = query.map
    line = baseline(world, lane)
    at = line.project(shapely.Point(point))
    forward = _extend(query, lane, line.length - at, reach, forward=True)
    backward = _extend(query, lane, at, reach, forward=False)
    return [*backward[:0:-1], *forward]


def _extend(
    query: MapQuery, lane: str, covered: float, reach: float, *, forward: bool
) -> list[str]:
    world, chain = query.map, [lane]
    while covered < reach:
        last = world.lanes[chain[-1]]
        candidates: list[str] = []
        for edge in last.successors if forward else last.predecessors:
            if edge not in world.lanes:
                continue
            if world.lanes[edge].has_traffic_light:
                break
            candidates.append(edge)
        # A loop would come round for ever.
        candidates = [edge for edge in candidates if edge not in chain]
        if not candidates:
            break
        chain.append(min(candidates, key=lambda edge: abs(query.curvature(edge, 0.0))))
        covered += baseline(world, chain[-1]).length
    return chain
