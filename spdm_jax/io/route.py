"""The route as a planner may use it: repaired, and with the lane sequences that follow from it.

A data set names its route as a list of roadblocks. It may start where the ego is not, lack blocks
or drive a loop; `correct_route` repairs that. `route_tables` adds the lane sequences of
`spdm_jax.io.route_paths`.

Poses are `(x, y, heading)` in map coordinates, m and rad.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawMap, RawRoadblock, ScenarioError
from spdm_jax.io.route_paths import branch_paths, centerline_paths, goal_paths, route_graph

NEAR_HALF_SIDE = 1.0
"""Half side of the axis-aligned square that a block near the ego must touch, m."""
MAX_HEADING_ERROR = np.pi / 4
"""Largest heading error of a lane the ego may be driving on, rad."""
MAX_DISPLACEMENT = 3.0
"""Largest distance to the nearest baseline point of such a lane, m."""
BACKWARD_DEPTH = 15
"""Most blocks in a path from the ego's block to the route's first block."""
FORWARD_DEPTH = 30
"""Most blocks in a path from the ego's block, or across a gap, to a route block."""
FORWARD_TARGETS = 3
"""Blocks at the start of the route that the forward search may join."""
LOOP_OVERLAP = 1.0
"""Two connectors of a route that share more than this area make a loop, m^2."""


@dataclass
class RouteTables:
    """The corrected route and what follows from it for each lane one may start on.

    Attributes:
      roadblocks: corrected route.
      start_lanes: the route's lanes: blocks in route order, lanes from left to right.
      centerline: per start lane, the shortest route-lane path to the last block in the window.
      reaches_goal: per start lane, whether the centreline ends in the route's last block.
      goal: per start lane, one lane per block to the last block with the fewest lane changes.
      branches: lane sequences grouped by start lane (their first entry), one per distinct
        on-route branch.
    """

    roadblocks: list[str]
    start_lanes: list[str]
    centerline: list[list[str]]
    reaches_goal: list[bool]
    goal: list[list[str]]
    branches: list[list[str]]


def route_tables(
    raw_map: RawMap, given: Sequence[str], ego_pose: Sequence[float] | np.ndarray
) -> RouteTables:
    """Corrects a route and derives the lane sequences that planners use.

    Args:
      raw_map: map in source coordinates.
      given: roadblock ids of the route, as the source gives it.
      ego_pose: rear axle at the planner's first step.

    Returns:
      The tables; see `RouteTables`.

    Raises:
      ScenarioError: no id of the route is in the map, or no lane belongs to it.
      ValueError: the pose is not three finite numbers.
    """
    route = correct_route(raw_map, given, ego_pose)
    graph = route_graph(raw_map, route)
    centerlines, reaches_goal = centerline_paths(graph)
    goals = goal_paths(graph, centerlines, reaches_goal)
    return RouteTables(
        roadblocks=route,
        start_lanes=graph.lanes,
        centerline=[graph.ids(path) for path in centerlines],
        reaches_goal=reaches_goal,
        goal=[graph.ids(path) for path in goals],
        branches=[graph.ids(path) for path in branch_paths(graph)],
    )


def correct_route(
    raw_map: RawMap, given: Sequence[str], ego_pose: Sequence[float] | np.ndarray
) -> list[str]:
    """Repairs a route so that it starts at the ego, has no gap and no loop.

    1. If the ego's block is off route, blocks that lead from it to the route are put in front.
       Where there is no such way, the first route blocks are replaced by a way that joins the
       route at its second or third block.
    2. Blocks missing between two unlinked neighbours are filled in.
    3. The route ends before the first connector that overlaps an earlier one.

    A repair that finds nothing leaves the route as it is.

    Args:
      raw_map: map in source coordinates.
      given: roadblock ids of the route; ids that the map lacks and repetitions are skipped.
      ego_pose: rear axle at the planner's first step.

    Returns:
      Roadblock ids in order of travel, without repetition.

    Raises:
      ScenarioError: no id of the route is in the map.
      ValueError: the pose is not three finite numbers.

    Source: tuplan_garage `route_roadblock_correction`, including which of several equally short
    ways it takes.
    """
    pose = np.asarray(ego_pose, np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError(f"ego_pose must be finite (x, y, heading), got {pose.tolist()}")
    route = list(dict.fromkeys(block for block in given if block in raw_map.roadblocks))
    if not route:
        raise ScenarioError(
            f"map {raw_map.name}: route_roadblocks {list(given)[:5]} names no roadblock of the "
            "map; check that route and map belong together"
        )
    candidates = _start_blocks(raw_map, route, pose)
    if candidates[0] not in route:
        route = _join_route(raw_map, route, candidates)
    # A block that a repair drives twice is a loop: cut first, then drop what is left of it.
    return list(dict.fromkeys(_cut_loop(raw_map, _fill_gaps(raw_map, route))))


def starting_lane(
    raw_map: RawMap,
    route_lanes: Sequence[str],
    ego_pose: Sequence[float] | np.ndarray,
    ego_center: Sequence[float] | np.ndarray,
    footprint: BaseGeometry,
) -> str:
    """Finds the route lane that the ego is on.

    Args:
      raw_map: map in source coordinates.
      route_lanes: lane ids of the route, in slot order.
      ego_pose: rear axle.
      ego_center: x, y of the box centre.
      footprint: the ego's box.

    Returns:
      Of the lanes under the rear axle, the one with the least heading error; else the first that
      contains the centre; else the one nearest to the footprint.

    Raises:
      ScenarioError: `route_lanes` is empty.
    """
    if not route_lanes:
        raise ScenarioError(
            f"map {raw_map.name}: route_lanes is empty, so there is no lane to start on; "
            "check the route's roadblocks"
        )
    lanes = [raw_map.lanes[lane] for lane in route_lanes]
    polygons = np.array([shapely.Polygon(lane.polygon) for lane in lanes], dtype=object)
    pose = np.asarray(ego_pose, np.float64)
    under = np.flatnonzero(shapely.intersects(polygons, shapely.Point(pose[:2])))
    if len(under):
        errors = [_baseline_errors(lanes[i].centerline, pose)[1] for i in under]
        return route_lanes[int(under[np.argmin(errors)])]
    around = np.flatnonzero(shapely.contains(polygons, shapely.Point(np.asarray(ego_center))))
    if len(around):
        return route_lanes[int(around[0])]
    return route_lanes[int(np.argmin(shapely.distance(polygons, footprint)))]


def _start_blocks(raw_map: RawMap, route: Sequence[str], pose: np.ndarray) -> list[str]:
    """Returns the blocks the ego may be in, the most likely one first.

    Blocks with a matching lane on the route exclude those off the route, which exclude the rest.
    """
    on_route: list[tuple[float, str]] = []
    off_route: list[tuple[float, str]] = []
    any_lane: list[tuple[float, str]] = []
    for block in _blocks_near(raw_map, pose):
        nearest = np.inf
        for lane in block.lanes:
            if lane not in raw_map.lanes:
                continue
            distance, turn = _baseline_errors(raw_map.lanes[lane].centerline, pose)
            nearest = min(nearest, distance)
            if turn < MAX_HEADING_ERROR and distance < MAX_DISPLACEMENT:
                (on_route if block.id in route else off_route).append((distance, block.id))
        any_lane.append((nearest, block.id))
    chosen = on_route or off_route or any_lane
    # Python's sort is stable: of equal distances the block listed first by the map wins.
    return [block for _, block in sorted(chosen, key=lambda item: item[0])]


def _blocks_near(raw_map: RawMap, pose: np.ndarray) -> list[RawRoadblock]:
    """Returns the blocks at a pose, else the nearest roadblock and the nearest connector."""
    # Roadblocks before connectors, as the published code asks the map for them.
    blocks = sorted(raw_map.roadblocks.values(), key=lambda block: block.is_connector)
    polygons = np.array([block.polygon for block in blocks], dtype=object)
    x, y = pose[:2]
    half = NEAR_HALF_SIDE
    square = shapely.box(x - half, y - half, x + half, y + half)
    near = np.flatnonzero(shapely.intersects(polygons, square))
    if not len(near):
        distance = shapely.distance(polygons, shapely.Point(x, y))
        connector = np.array([block.is_connector for block in blocks])
        layers = [np.flatnonzero(connector == layer) for layer in (False, True)]
        near = [layer[np.argmin(distance[layer])] for layer in layers if len(layer)]
    return [blocks[i] for i in near]


def _join_route(raw_map: RawMap, route: list[str], candidates: Sequence[str]) -> list[str]:
    """Leads the route back to the ego's block, or the ego's block to the route."""
    lead_in = _search(raw_map, route[0], candidates, BACKWARD_DEPTH, forward=False)
    if lead_in:
        return lead_in[::-1][:-1] + route
    lead_in = _search(raw_map, candidates[0], route[:FORWARD_TARGETS], FORWARD_DEPTH)
    if lead_in:
        return lead_in + route[route.index(lead_in[-1]) + 1 :]
    return route


def _fill_gaps(raw_map: RawMap, route: Sequence[str]) -> list[str]:
    """Inserts the blocks that are missing between unlinked neighbours."""
    filled = [route[0]]
    for before, after in itertools.pairwise(route):
        filled += [*_search(raw_map, before, [after], FORWARD_DEPTH)[1:-1], after]
    return filled


def _cut_loop(raw_map: RawMap, route: list[str]) -> list[str]:
    """Ends the route before the first connector that overlaps an earlier one."""
    places = [i for i, block in enumerate(route) if raw_map.roadblocks[block].is_connector]
    polygons = np.array([raw_map.roadblocks[route[i]].polygon for i in places], dtype=object)
    polygons = np.where(shapely.is_valid(polygons), polygons, shapely.make_valid(polygons))
    later, earlier = shapely.STRtree(polygons).query(polygons)
    pairs = later > earlier
    later, earlier = later[pairs], earlier[pairs]
    shared = shapely.area(shapely.intersection(polygons[later], polygons[earlier]))
    loops = later[shared > LOOP_OVERLAP]
    return route[: places[loops.min()]] if len(loops) else route


def _search(
    raw_map: RawMap, root: str, targets: Sequence[str], depth: int, *, forward: bool = True
) -> list[str]:
    """Breadth-first search over roadblocks.

    Args:
      raw_map: the map.
      root: block to start from.
      targets: blocks to reach.
      depth: most blocks in the path, both ends included.
      forward: follow successors, else predecessors.

    Returns:
      Blocks from the root to the first target reached, or an empty list. Of several shortest ways
      to that target the published search keeps the parent noted last, so the blocks of a level
      are kept in two orders: of their first mention (which target) and of their last (which way).
    """
    parent: dict[str, str | None] = {root: None}

    def steps(level: Sequence[str]) -> Iterator[tuple[str, str]]:
        for block in level:
            record = raw_map.roadblocks[block]
            for other in record.successors if forward else record.predecessors:
                if other in raw_map.roadblocks and other not in parent:
                    yield other, block

    first, last = [root], [root]
    for _ in range(depth):
        goal = next((block for block in first if block in targets), None)
        if goal is not None:
            path = [goal]
            while (before := parent[path[-1]]) is not None:
                path.append(before)
            return path[::-1]
        first = list(dict.fromkeys(other for other, _ in steps(first)))
        reached: dict[str, str] = {}
        for other, block in steps(last):
            reached.pop(other, None)
            reached[other] = block
        last = list(reached)
        parent.update(reached)
    return []


def _baseline_errors(centerline: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Returns distance, m, and absolute heading error, rad, at the nearest baseline point."""
    offset = centerline[:, :2] - pose[:2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    nearest = int(np.argmin(distance))
    turn = (centerline[nearest, 2] - pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    return float(distance[nearest]), float(abs(turn))
