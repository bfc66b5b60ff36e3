"""interPlan's own metrics and its score, from nuPlan's metrics of a run (host)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax.config import VehicleParams
from spdm_jax.interplan.config import SPECIAL_TYPES, ObstacleKind
from spdm_jax.interplan.extras import InterplanExtras
from spdm_jax.metrics import SCORED, ClosedLoopMetrics, Expert, MetricParams
from spdm_jax.metrics.motion import motion
from spdm_jax.metrics.routes import driven_route
from spdm_jax.metrics.score import NUM_MULTIPLIERS
from spdm_jax.scoring.areas import areas_at
from spdm_jax.types import Lanes, Polylines, ScenarioMap

LANE_CHANGES = "lane_changes_to_goal"
UNKNOWN_START = 0.2607
"""Score where the lane changes at the start cannot be counted, as published."""
NEIGHBOR_GAP = 0.1
"""Boundaries of neighbouring lanes end no farther apart, m."""
WEIGHTS: Mapping[str, float] = MappingProxyType(
    {
        "ego_progress_along_expert_route": 5.0,
        "time_to_collision_within_bound": 5.0,
        LANE_CHANGES: 4.0,
        "speed_limit_compliance": 4.0,
        "ego_is_comfortable": 2.0,
    }
)
"""Weights of averaged metrics; any other one has 1."""
_DIRECTION = "driving_direction_compliance"


@dataclass(frozen=True)
class LaneChangesToGoal:
    """Lane changes between ego and expert.

    Attributes:
      at_start: needed at the start, None if it cannot be told.
      at_end: left at the end, None if it cannot be told.
      score: 0 ... 1, NaN if the run was on no lane of the expert's way.
    """

    at_start: int | None
    at_end: int | None
    score: float


@dataclass(frozen=True)
class InterplanMetrics:
    """interPlan's verdict on one run.

    Attributes:
      scores: by metric name; NaN where one could not be computed.
      final: weighted score, NaN if one of nuPlan's metrics is.
      lane_changes: to the goal.
      required_progress: share of the expert's way that gets past all obstacles, None without them.
    """

    scores: Mapping[str, float]
    final: float
    lane_changes: LaneChangesToGoal
    required_progress: float | None


def expert_route(
    scene_map: ScenarioMap, expert: Expert, ran: jax.Array, params: MetricParams | None = None
) -> jax.Array:
    """Lanes that the expert drove on during a run's samples, `[T, L]` bool (device).

    Args:
      scene_map: the world.
      expert: what the run is compared with.
      ran: `[T]` bool, the run's samples.
      params: of the metrics; the official ones if None.
    """
    params = MetricParams() if params is None else params
    at = jnp.minimum(jnp.arange(ran.shape[0]), expert.valid.shape[0] - 1)
    ego = jax.tree.map(lambda values: jnp.asarray(values)[at], expert.ego)
    box = motion(ego, params.vehicle).box
    areas = areas_at(scene_map, box.x, box.y)
    valid = ran & jnp.asarray(expert.valid)[at]
    return driven_route(scene_map.lanes, areas, box.x, box.y, valid, params.near_connector)


def lane_changes_to_goal(lanes: Lanes, route: np.ndarray, expert: np.ndarray) -> LaneChangesToGoal:
    """Compares the lanes that ego and expert ended on.

    Args:
      lanes: of the map, on the host.
      route: `[T, L]` bool, lanes of the ego's centre over the run's samples.
      expert: `[T, L]` bool, lanes of the expert's over the same samples.

    Source: interPlan `LaneChangesToGoalStatistics`.
    """
    block = np.asarray(lanes.roadblock)
    goals = [int(np.argmax(members)) for members in _simplified(expert)]
    if not goals or not route[0].any() or not expert[0].any():
        return LaneChangesToGoal(None, None, float("nan"))
    # Of overlapping connectors only those that the expert took as well can be told apart.
    driven = [
        int(lane)
        for members in _simplified(route)
        for lane in np.flatnonzero(members)
        if members.sum() == 1 or lane in goals
    ]
    if not driven or driven[0] != goals[0]:
        driven.insert(0, goals[0])
    last_goal, last = next(
        (goal, lane) for goal in goals[::-1] for lane in driven[::-1] if block[goal] == block[lane]
    )
    at_start: int | None = 0
    if len(goals) > 1:
        first = [int(np.argmax(members)) for members in expert[:2]]
        known = len(first) > 1 and expert[1].any() and block[first[0]] == block[first[1]]
        at_start = lane_changes_between(lanes, int(np.argmax(route[0])), first[1 if known else 0])
    at_end = lane_changes_between(lanes, last_goal, last)
    if at_start is None:
        score = UNKNOWN_START
    elif at_start == 0:
        score = 1.0 if at_end == 0 else 0.5
    else:
        score = float("nan") if at_end is None else max(0.0, 1.0 - at_end / at_start)
    return LaneChangesToGoal(at_start, at_end, score)


def lane_changes_between(lanes: Lanes, start: int, goal: int) -> int | None:
    """Returns the fewest lane changes between two lanes of one roadblock, None if there is no way.

    Args:
      lanes: of the map, on the host.
      start: row of a lane.
      goal: row of a lane.
    """
    if start == goal:
        return 0
    if lanes.roadblock[start] != lanes.roadblock[goal] or lanes.roadblock[goal] < 0:
        return None
    seen, level, changes = {goal}, [goal], 0
    while level:
        changes += 1
        found = {lane for near in level for lane in beside(lanes, near)} - seen
        if start in found:
            return changes
        seen |= found
        level = sorted(found)
    return None


def beside(lanes: Lanes, lane: int) -> list[int]:
    """Returns the lanes to the left and right of one (rows), where there are any.

    Candidates are the map's neighbours, what follows the lane's predecessors and what follows their
    neighbours; a candidate counts if the two boundaries end at one place.
    """
    found: list[int] = []
    sides = (
        (lanes.left_neighbor, lanes.left_boundary, lanes.right_boundary),
        (lanes.right_neighbor, lanes.right_boundary, lanes.left_boundary),
    )
    before = _rows(lanes.predecessors[lane])
    for neighbor, own, facing in sides:
        parents = [*before, *_rows(neighbor[before])]
        candidates = {*_rows(neighbor[lane : lane + 1]), *_rows(lanes.successors[parents].ravel())}
        gaps = {
            other: float(np.hypot(*(_line_end(own, lane) - _line_end(facing, other))))
            for other in sorted(candidates - {lane})
        }
        if gaps and min(gaps.values()) <= NEIGHBOR_GAP:
            found.append(min(gaps, key=lambda other: gaps[other]))
    return found


def required_progress(way: np.ndarray, obstacles: Sequence[tuple[float, float]]) -> float:
    """Returns the share of a way that passes all obstacles, 0 ... 1.

    Args:
      way: `[N, 2]` expert's box centres.
      obstacles: x, y in the same frame.

    Raises:
      ValueError: there are no obstacles.
    """
    if not obstacles:
        raise ValueError("there are no obstacles to pass")
    moved = np.append(True, np.hypot(*np.diff(way, axis=0).T) > 0)
    if moved.sum() < 2:
        # Who stands still has passed nothing, and lost nothing.
        return 0.0
    line = shapely.LineString(way[moved])
    return float(max(line.project(shapely.points(obstacles))) / line.length)


def weighted_score(scores: Mapping[str, float], scenario_type: str) -> float:
    """Weighs the metrics of one run.

    Collisions, drivable area and progress at all multiply. So does the driving direction, except
    where a parked, crashed or fenced-off obstacle has to be passed on the other side: passing it
    multiplies instead, and the direction is averaged.

    Args:
      scores: by metric name: nuPlan's eight, `lane_changes_to_goal`, and that of the type's
        obstacles. As published, lane changes that could not be counted (NaN) do not enter.
      scenario_type: interPlan's name.

    Source: interPlan `InterplanWeightedAverageMetricAggregator` and its configuration.
    """
    multipliers = set(SCORED[:NUM_MULTIPLIERS])
    kind = SPECIAL_TYPES.get(scenario_type)
    if kind is not None:
        multipliers.add(kind.value)
        if kind is not ObstacleKind.PEDESTRIANS:
            multipliers.remove(_DIRECTION)
    uncounted = {LANE_CHANGES} if np.isnan(scores[LANE_CHANGES]) else set()
    averaged = [name for name in scores if name not in multipliers | uncounted]
    weights = [WEIGHTS.get(name, 1.0) for name in averaged]
    mean = np.average([scores[name] for name in averaged], weights=weights)
    return float(np.prod([scores[name] for name in multipliers]) * mean)


def judge(
    metrics: ClosedLoopMetrics,
    expert_lanes: np.ndarray,
    expert: Expert,
    lanes: Lanes,
    origin: np.ndarray,
    extras: InterplanExtras,
    vehicle: VehicleParams | None = None,
) -> InterplanMetrics:
    """Adds interPlan's metrics to nuPlan's of one run.

    Args:
      metrics: of the run, on the host.
      expert_lanes: `[T, L]` bool, from `expert_route`.
      expert: what the run is compared with, on the host.
      lanes: of the map, on the host.
      origin: `[2]` map coordinates of the local frame's origin.
      extras: of the scenario.
      vehicle: ego dimensions.
    """
    vehicle = VehicleParams() if vehicle is None else vehicle
    ran = np.asarray(metrics.valid)
    host = jax.tree.map(np.asarray, lanes)
    if ran.any():
        route, way = np.asarray(metrics.route)[ran], np.asarray(expert_lanes)[ran]
        changes = lane_changes_to_goal(host, route, way)
    else:
        changes = LaneChangesToGoal(None, None, float("nan"))
    scores = dict(zip(SCORED, map(float, np.asarray(metrics.scores)), strict=True))
    scores[LANE_CHANGES] = changes.score
    required = None
    if extras.obstacle_kind is not None:
        known, heading = np.asarray(expert.valid), np.asarray(expert.ego.heading)
        ahead = float(vehicle.rear_axle_to_center) * np.stack([np.cos(heading), np.sin(heading)], 1)
        centers = np.stack([np.asarray(expert.ego.x), np.asarray(expert.ego.y)], 1) + ahead
        local = np.array(extras.obstacles).reshape(-1, 2) - np.asarray(origin)
        required = required_progress(centers[known].astype(float), list(map(tuple, local)))
        ratio = float(metrics.progress.ratio)
        scores[extras.obstacle_kind.value] = np.nan if np.isnan(ratio) else float(ratio >= required)
    final = weighted_score(scores, extras.scenario_type)
    return InterplanMetrics(scores, final, changes, required)


def _simplified(route: np.ndarray) -> list[np.ndarray]:
    """Drops samples on no lane, and those that share one with the last sample kept."""
    kept: list[np.ndarray] = []
    for members in route:
        if members.any() and not (kept and (members & kept[-1]).any()):
            kept.append(members)
    return kept


def _rows(values: np.ndarray) -> list[int]:
    return [int(value) for value in np.asarray(values).ravel() if value >= 0]


def _line_end(lines: Polylines, row: int) -> np.ndarray:
    return np.asarray(lines.points[lines.start[row] + lines.count[row] - 1, :2], float)
