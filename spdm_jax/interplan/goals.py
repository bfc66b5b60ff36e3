"""Goals and routes: from a command or a goal position to a plan of lanes and an expert's poses."""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
import shapely

from spdm_jax.interplan.config import Goal
from spdm_jax.interplan.roads import baseline, lanes_of, pose_on
from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.raw import RawMap, ScenarioError

SEARCH_RADIUS = 300.0
"""Roadblocks that touch a square of this half side around the ego may be part of a way, m."""
_TURN = {Goal.LEFT: np.pi / 2, Goal.STRAIGHT: 0.0, Goal.RIGHT: -np.pi / 2}
"""Change of heading over a roadblock that a command asks for, rad."""
_FALLBACK_SPEED = 15.0
"""Speed on lanes without a limit, m/s."""


@dataclass(frozen=True)
class LanePlan:
    """A way to the goal.

    Attributes:
      roadblocks: route for the planner.
      lanes: one per roadblock of the way; a lane change happens within a roadblock.
      goal: `[3]` x, y, heading.
    """

    roadblocks: list[str]
    lanes: list[str]
    goal: np.ndarray


def plan_to_position(
    query: MapQuery, start_block: str, center: np.ndarray, goal: tuple[float, float]
) -> LanePlan:
    """Finds the way to the lane at a position.

    Args:
      query: the map.
      start_block: the ego's roadblock; any of its lanes may be the first one.
      center: x, y of the ego's box.
      goal: x, y.

    Raises:
      ScenarioError: the position is in overlapping connectors, too far away or out of reach.

    Source: interPlan `_infer_route_plan_from_goal_location`.
    """
    world, place = query.map, np.array([goal])
    found = query.containing(MapLayer.LANE, place)[0]
    found = found or query.containing(MapLayer.LANE_CONNECTOR, place)[0]
    if len(found) > 1:
        raise ScenarioError(f"goal {list(goal)} is in {len(found)} lanes or connectors: {found}")
    lane = found[0] if found else query.nearest(MapLayer.LANE, place[0])[0]
    blocks = [
        block
        for layer in (MapLayer.ROADBLOCK, MapLayer.ROADBLOCK_CONNECTOR)
        for block in query.near(layer, center, SEARCH_RADIUS)
    ]
    allowed = {lane for block in blocks for lane in lanes_of(world, block)}
    if lane not in allowed:
        raise ScenarioError(
            f"goal {list(goal)} on lane {lane} is more than {SEARCH_RADIUS:.0f} m from the ego"
        )
    lanes = _find_lanes(world, start_block, lane, allowed, len(blocks))
    if lanes is None:
        raise ScenarioError(f"no way from roadblock {start_block} to goal {list(goal)}")
    route = list(dict.fromkeys(world.lanes[lane].roadblock for lane in lanes))
    return LanePlan(route, lanes, query.project(lanes[-1], place[0]).pose)


def plan_by_command(
    query: MapQuery, start_block: str, command: Goal, num_blocks: int, duration: float
) -> LanePlan:
    """Follows one command at every intersection.

    Args:
      query: the map.
      start_block: the ego's roadblock.
      command: at each fork the roadblock whose change of heading fits best is taken.
      num_blocks: most roadblocks of the route (the recorded route's number).
      duration: the plan of lanes ends where a drive at the speed limits would be after it, s.

    Raises:
      ScenarioError: no lane leads along the route.

    Source: interPlan `_infer_route_plan_from_command`.
    """
    world, route = query.map, [start_block]
    while len(route) < num_blocks:
        exits = [b for b in world.roadblocks[route[-1]].successors if b in world.roadblocks]
        if not exits:
            break
        heading = _end_heading(world, route[-1])
        turn = [(_end_heading(world, b) - heading + np.pi) % (2 * np.pi) - np.pi for b in exits]
        route.append(exits[int(np.argmin(np.abs(np.array(turn) - _TURN[command])))])
    allowed = {lane for block in route for lane in lanes_of(world, block)}
    target = lanes_of(world, route[-1])[-1]
    lanes = _find_lanes(world, start_block, target, allowed, len(route))
    if lanes is None:
        raise ScenarioError(f"no lane leads from roadblock {start_block} {command} along {route}")
    seconds = np.cumsum(
        [
            baseline(world, lane).length / (world.lanes[lane].speed_limit or _FALLBACK_SPEED)
            for lane in lanes
        ]
    )
    lanes = lanes[: int(np.sum(seconds <= duration)) + 1]
    return LanePlan(route, lanes, np.array(world.lanes[lanes[-1]].centerline[-1]))


def course_of(query: MapQuery, lanes: Sequence[str], center: np.ndarray) -> np.ndarray:
    """Returns the baseline points of a plan of lanes, from beside the ego on, `[P, 3]`.

    Args:
      query: the map.
      lanes: of the plan.
      center: x, y of the ego's box.
    """
    first = query.map.lanes[lanes[0]].centerline
    line = baseline(query.map, lanes[0])
    at = line.project(shapely.Point(center))
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(first[:, :2], axis=0).T)))
    begin = pose_on(line, at)[None]
    rest = [query.map.lanes[lane].centerline for lane in lanes[1:]]
    return np.concatenate([begin, first[along > at], *rest])


def expert_poses(course: np.ndarray, num_iterations: int, num_steps: int) -> np.ndarray:
    """Lays the points of a course out over a scenario's iterations.

    Args:
      course: `[P, 3]` poses.
      num_iterations: N; iteration i gets point `int(P / N * i)`.
      num_steps: steps wanted; those beyond the course hold its last point.

    Returns:
      `[num_steps, 3]` box centres.
    """
    index = (len(course) / num_iterations * np.arange(num_steps)).astype(int)
    return course[np.minimum(index, len(course) - 1)]


def _end_heading(world: RawMap, block: str) -> float:
    return float(world.lanes[lanes_of(world, block)[0]].centerline[-1, 2])


def _find_lanes(
    world: RawMap, start_block: str, target: str, allowed: AbstractSet[str], depth: int
) -> list[str] | None:
    """Finds lanes from any lane of a roadblock to a target.

    The leftmost start that reaches the target itself wins. Otherwise the ways end beside it, in
    its roadblock, and the rightmost start's counts.
    """
    beside: list[str] | None = None
    for start in lanes_of(world, start_block):
        path, exact = _search(world, start, target, allowed, depth)
        if exact:
            return path
        beside = path or beside
    return beside


def _search(
    world: RawMap, start: str, target: str, allowed: AbstractSet[str], depth: int
) -> tuple[list[str] | None, bool]:
    """Breadth-first search for a lane.

    Args:
      world: the map.
      start: first lane.
      target: lane to reach.
      allowed: lanes that may be part of the way, besides the first.
      depth: most lanes of a way.

    Returns:
      Lanes, and whether the last one leads there. If not: of the lanes reached in the target's
      roadblock the nearest to the target, replaced by it; None if there is none. Of several
      shortest ways the one whose links come last counts, as published.
    """
    place = {lane: i for i, lane in enumerate(lanes_of(world, world.lanes[target].roadblock))}
    parent: dict[str, str | None] = {start: None}
    level: list[str] = [start]
    beside: tuple[int, list[str]] | None = None
    for _ in range(depth):
        if target in level:
            return _path(parent, target), True
        for lane in level:
            if lane in place and not world.lanes[target].is_connector:
                apart = abs(place[lane] - place[target])
                if beside is None or apart < beside[0]:
                    beside = apart, [*_path(parent, lane)[:-1], target]
        reached: dict[str, str] = {}
        for lane in level:
            for other in world.lanes[lane].successors:
                if other in allowed and other not in parent:
                    reached.pop(other, None)
                    reached[other] = lane
        parent.update(reached)
        level = list(reached)
    return (beside[1] if beside else None), False


def _path(parent: dict[str, str | None], lane: str) -> list[str]:
    path = [lane]
    while (before := parent[path[-1]]) is not None:
        path.append(before)
    return path[::-1]
