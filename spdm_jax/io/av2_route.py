"""A route for logs that have none: the recorded path snapped to the lane graph, then prolonged.

The most likely lane sequence is found by dynamic programming (Viterbi) over the lanes that contain
the ego; beyond the end of the recording the route follows the straightest successors.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon

from spdm_jax.io.av2_map import angle_between, overall_heading
from spdm_jax.io.raw import RawLane, RawMap, ScenarioError

MARGIN = 0.3
"""A lane is a candidate if the ego is in it or this close, m."""
MAX_HEADING_ERROR = 1.0
"""Lanes that point elsewhere (crossing, oncoming) are no candidates, rad."""
HEADING_WEIGHT = 3.0
"""Metres of lateral offset that weigh as much as one radian of heading error."""
EXTENSION = 100.0
"""The route goes on at least this far beyond the last lane of the recording, m."""

# Costs of a transition between two steps, in metres of lateral offset.
_SUCCESSOR, _SKIPPED_SUCCESSOR, _NEIGHBOR, _JUMP = 0.2, 1.0, 2.0, 50.0


@dataclass(frozen=True)
class SnappedRoute:
    """Lanes the ego drives on, and those that follow.

    Attributes:
      lanes: lane ids in driving order; the recorded ones, then the extension.
      position: `[T]` index into `lanes` at each step (steps off the lanes: that of the step
        before, or the first).
      off_lanes: `[T]` bool, no lane contains the ego.
      notes: remarks for the user.
    """

    lanes: tuple[str, ...]
    position: np.ndarray
    off_lanes: np.ndarray
    notes: tuple[str, ...]

    def roadblocks(self, road_map: RawMap, step: int) -> list[str]:
        """Returns the roadblocks from the one of this step on (repetitions in a row removed)."""
        blocks = [road_map.lanes[key].roadblock for key in self.lanes[self.position[step] :]]
        return [b for i, b in enumerate(blocks) if i == 0 or b != blocks[i - 1]]

    def goal(self, road_map: RawMap) -> np.ndarray:
        """Returns `[3]`, the last centre-line point of the last lane."""
        return road_map.lanes[self.lanes[-1]].centerline[-1].copy()


def snap_route(road_map: RawMap, poses: np.ndarray) -> SnappedRoute:
    """Derives a route from recorded poses.

    Args:
      road_map: map in the frame of the poses.
      poses: `[T, 3]` rear-axle x, y, heading of the whole recording.

    Raises:
      ScenarioError: no lane contains any pose.

    Source: emission cost is the distance to the centre line plus 3 m per rad of heading error;
    staying or following a link is cheap, changing to a neighbour dearer, all else very dear.
    """
    emissions = _emissions(road_map, poses)
    steps = [t for t, costs in enumerate(emissions) if costs]
    if not steps:
        x, y = poses[0, :2]
        raise ScenarioError(
            f"map {road_map.name}: no lane contains the ego anywhere (it starts at {x:.1f}, "
            f"{y:.1f}); map and ego poses must be of one log"
        )
    sequence = _viterbi(road_map.lanes, [emissions[t] for t in steps])

    route, notes = [sequence[0]], []
    position, at = np.zeros(len(poses), int), dict(zip(steps, sequence, strict=True))
    for t in range(len(poses)):
        lane = at.get(t, route[-1])
        if lane != route[-1]:
            between = _way(road_map.lanes, route[-1], lane)
            if between is None:
                notes.append(f"route: no lane link leads from {route[-1]} to {lane} (step {t})")
            route += [*(between or ()), lane]
        position[t] = len(route) - 1
    extension, length = _extend(road_map.lanes, route[-1])
    if length < EXTENSION:
        notes.append(
            f"route: ends {length:.0f} m beyond the last recorded lane, where the map does"
        )
    off_lanes = np.isin(np.arange(len(poses)), steps, invert=True)
    return SnappedRoute((*route, *extension), position, off_lanes, tuple(notes))


def _emissions(road_map: RawMap, poses: np.ndarray) -> list[dict[str, float]]:
    """Candidate lanes of each step with their cost."""
    keys = list(road_map.lanes)
    polygons = [Polygon(road_map.lanes[k].polygon) for k in keys]
    points = [Point(x, y) for x, y in poses[:, :2]]
    step, lane = shapely.STRtree(shapely.buffer(polygons, MARGIN)).query(points, "within")
    costs: list[dict[str, float]] = [{} for _ in poses]
    for t, i in zip(step, lane, strict=True):
        line = road_map.lanes[keys[i]].centerline
        path = LineString(line[:, :2])
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)))
        segment = np.searchsorted(along, path.line_locate_point(points[t]), side="right") - 1
        error = float(angle_between(line[min(segment, len(line) - 1), 2], poses[t, 2]))
        if error < MAX_HEADING_ERROR:
            costs[t][keys[i]] = path.distance(points[t]) + HEADING_WEIGHT * error
    return costs


def _viterbi(lanes: dict[str, RawLane], emissions: list[dict[str, float]]) -> list[str]:
    """Returns the lane of each step on the cheapest sequence."""
    total = dict(emissions[0])
    origins: list[dict[str, str]] = []
    for costs in emissions[1:]:
        reached, origin = {}, {}
        for lane, cost in costs.items():
            options = {k: v + _transition(lanes, k, lane) for k, v in total.items()}
            best = min(options, key=options.__getitem__)
            reached[lane], origin[lane] = options[best] + cost, best
        total = reached
        origins.append(origin)
    sequence = [min(total, key=total.__getitem__)]
    for origin in reversed(origins):
        sequence.append(origin[sequence[-1]])
    return sequence[::-1]


def _transition(lanes: dict[str, RawLane], a: str, b: str) -> float:
    if a == b:
        return 0.0
    if b in lanes[a].successors:
        return _SUCCESSOR
    if any(b in lanes[s].successors for s in lanes[a].successors):
        return _SKIPPED_SUCCESSOR
    beside = (lanes[b].left_neighbor, lanes[b].right_neighbor)
    if a in beside or any(s in beside for s in lanes[a].successors):
        return _NEIGHBOR
    return _JUMP


def _way(lanes: dict[str, RawLane], a: str, b: str) -> list[str] | None:
    """Lanes between two lanes of the sequence: none if linked or neighbours, or one."""
    beside = (lanes[b].left_neighbor, lanes[b].right_neighbor)
    if b in lanes[a].successors or a in beside:
        return []
    for s in lanes[a].successors:
        if b in lanes[s].successors or s in beside:
            return [s]
    return None


def _extend(lanes: dict[str, RawLane], last: str) -> tuple[list[str], float]:
    """Follows the straightest successors; returns them and their length, m."""
    added, length = [], 0.0
    while length < EXTENSION and lanes[last].successors:
        heading = lanes[last].centerline[-1, 2]
        last = min(
            lanes[last].successors,
            key=lambda k: float(angle_between(overall_heading(lanes[k]), heading)),
        )
        added.append(last)
        steps = np.diff(lanes[last].centerline[:, :2], axis=0)
        length += float(np.linalg.norm(steps, axis=1).sum())
    return added, length
