"""Applies interPlan's changes to a recorded scenario."""

import dataclasses
import random
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import LineString

from spdm_jax.config import VehicleParams
from spdm_jax.interplan.config import SPECIAL_TYPES, ObstacleKind, ScenarioChanges
from spdm_jax.interplan.extras import InterplanExtras, Point, Pose, ScriptedPedestrian
from spdm_jax.interplan.goals import (
    LanePlan,
    course_of,
    expert_poses,
    plan_by_command,
    plan_to_position,
)
from spdm_jax.interplan.roads import lane_at
from spdm_jax.interplan.spawn import (
    BUS_SIZE,
    Behavior,
    Ego,
    Fleet,
    Vehicle,
    add_extra_agents,
    fill_lanes,
)
from spdm_jax.io.map_query import MapQuery
from spdm_jax.io.raw import RawScenario, RawTracks, ScenarioError
from spdm_jax.simulation.script import WALK_ITERATIONS
from spdm_jax.types import ObjectType

PEDESTRIAN_SIZE = (0.9, 0.7914)
"""Length and width, m."""
CONE_SIZE = (0.5, 0.5)
"""Length and width, m."""
END_MARGIN = 0.1
"""A run ends so far before the goal, m."""
_SPEED, _POSE = 3, slice(0, 3)  # columns of `RawScenario.ego`


def modify(
    raw: RawScenario,
    changes: ScenarioChanges,
    *,
    seed: str | None = None,
    query: MapQuery | None = None,
    vehicle: VehicleParams | None = None,
) -> tuple[RawScenario, InterplanExtras]:
    """Applies changes to a recorded scenario.

    - Recorded pedestrians and static objects disappear if the code changes objects at all;
      recorded vehicles with a density, a special scenario, or `a0`.
    - Spawned vehicles exist at iteration 0 and, at constant speed along their heading, before it;
      afterwards only a simulation knows. Stopped ones, cones and pedestrians with a given start
      exist throughout.
    - With a goal, the ego's record from iteration 1 on becomes the way along the lanes to the goal
      (the expert that progress is measured against), and route and mission goal change.

    The same arguments give the same result.

    Args:
      raw: the recorded scenario, from its iteration 0 on (interPlan: 30 s from the tagged sweep).
      changes: what to change.
      seed: of all draws; interPlan takes the token of the scenario's first sweep, which is the
        default.
      query: index of `raw.map`, to share between scenarios.
      vehicle: ego dimensions.

    Returns:
      The changed scenario, named `changes.name`, and what a simulation needs besides.

    Raises:
      ScenarioError: the changes do not fit the map (a goal out of reach, an ego off all lanes).

    Source: interPlan `ModifiedNuPlanScenario`, `AgentsModifier`; differs: spawned vehicles have a
    straight past, where interPlan draws one, and the way of a run without a goal of its own is
    measured along the recorded drive.
    """
    query = MapQuery(raw.map) if query is None else query
    if query.map is not raw.map:
        raise ValueError(f"scenario {raw.token}: query was made for another map object")
    rng = random.Random(changes.base_token if seed is None else seed)
    vehicle = VehicleParams() if vehicle is None else vehicle
    now, code = raw.num_history, changes.code
    shift = float(vehicle.rear_axle_to_center)
    center = _moved(raw.ego[now, _POSE], shift)
    ego = Ego(
        pose=center,
        size=(float(vehicle.length), float(vehicle.width)),
        speed=float(np.hypot(raw.ego[now, _SPEED], raw.ego[now, _SPEED + 1])),
        lane="",
        block="",
    )
    if code.density is not None or code.goal is not None:
        lane = lane_at(query, center)
        if lane is None:
            raise ScenarioError(
                f"scenario {changes.name}: the ego is on no lane at iteration 0, at "
                f"{center[:2].round(2).tolist()}; a density or a goal needs one"
            )
        ego = dataclasses.replace(ego, lane=lane, block=raw.map.lanes[lane].roadblock)

    record = raw.ego.copy()
    tracks, fleet, pedestrians = raw.tracks, [], ()
    if code.changes_objects:
        tracks, fleet, pedestrians, ego_speed = _objects(raw, changes, query, ego, rng)
        # As published, a place in the queue that asks for 0 m/s leaves the recorded speed.
        record[now, _SPEED] = ego_speed or record[now, _SPEED]
    plan = None
    if code.goal is not None:
        plan = _plan(raw, changes, query, ego)
        course = course_of(query, plan.lanes, center[:2])
        goal = plan.goal
        poses = expert_poses(course, raw.num_iterations, len(record) - now)
        record[now + 1 :] = record[now]
        record[now + 1 :, _POSE] = _moved(poses[1:], -shift)
    else:
        own = record[now : now + raw.num_iterations, _POSE]
        course, goal = _moved(own, shift), own[-1]
    end = _arc_length(course, goal) - END_MARGIN

    kind, obstacles = _obstacles(changes, fleet)
    modified = dataclasses.replace(
        raw,
        token=changes.name,
        scenario_type=changes.scenario_type,
        ego=record,
        ego_valid=raw.ego_valid | (np.arange(len(record)) > now) if plan else raw.ego_valid,
        tracks=tracks,
        route_roadblocks=plan.roadblocks if plan else raw.route_roadblocks,
        mission_goal=goal,
    )
    extras = InterplanExtras(
        name=changes.name,
        base_token=changes.base_token,
        scenario_type=changes.scenario_type,
        policy=code.policy,
        stopped=tuple(v.track for v in fleet if v.behavior is Behavior.STOPPED),
        cautious=tuple(v.track for v in fleet if v.behavior is Behavior.CAUTIOUS),
        pedestrians=pedestrians,
        obstacle_kind=kind,
        obstacles=obstacles,
        goal=_pose(goal),
        course=tuple(map(_point, course)),
        end=end,
    )
    return modified, extras


def _objects(
    raw: RawScenario,
    changes: ScenarioChanges,
    query: MapQuery,
    ego: Ego,
    rng: random.Random,
) -> tuple[RawTracks, list[Vehicle], tuple[ScriptedPedestrian, ...], float | None]:
    """Replaces recorded objects; returns tracks, added vehicles, pedestrians and ego speed."""
    code, special = changes.code, changes.special
    tracks, now = raw.tracks, raw.num_history
    recorded = np.flatnonzero((tracks.type == ObjectType.VEHICLE) & tracks.valid[:, now])
    keeps = code.keep_vehicles is True and special is None
    removed = [(tracks.ids[row], _size(tracks.size[row, now])) for row in recorded]
    if code.keep_vehicles is False:
        # As published: the bodies that `a0` removes are not used again.
        rng.sample(removed, len(removed))
        removed = []
    fleet, ego_speed = Fleet(query, ego, removed, rng), None
    if code.density is not None:
        ego_speed = fill_lanes(fleet, query, ego, changes, rng)
        where = f"scenario {changes.name}"
        add_extra_agents(fleet, query, changes.token_changes.extra_agents, where)
    table = _TrackTable(raw)
    if keeps:
        table.keep(tracks.type == ObjectType.VEHICLE)
    pedestrians: list[ScriptedPedestrian] = []
    if special is not None:
        for place in special.stopped_vehicles:
            fleet.add(np.array(place), moves=False, behavior=Behavior.STOPPED)
        for place in special.stopped_buses:
            fleet.add(np.array(place), moves=False, behavior=Behavior.STOPPED, size=BUS_SIZE)
    for vehicle in fleet.vehicles:
        table.add_vehicle(vehicle)
    if special is not None:
        for i, way in enumerate(special.pedestrians):
            scripted = ScriptedPedestrian(f"pedestrian-{i}", way.start, way.end, way.begins_at)
            table.add_pedestrian(scripted)
            pedestrians.append(scripted)
        for i, (x, y) in enumerate(special.cones):
            heading = rng.uniform(-np.pi, np.pi)
            table.add_standing(f"cone-{i}", ObjectType.TRAFFIC_CONE, (x, y, heading), CONE_SIZE)
    return table.tracks(), fleet.vehicles, tuple(pedestrians), ego_speed


def walk_share(iteration: np.ndarray, begin: int, num_iterations: int) -> np.ndarray:
    """Returns the share `[...]` of its way that a pedestrian has walked at iterations `[...]`.

    Source: interPlan `get_pedestrians_at_iteration`.
    """
    walking = min(begin + WALK_ITERATIONS, num_iterations)
    return np.clip((iteration - begin) / walking, 0.0, 1.0)


class _TrackTable:
    """Tracks of a changed scenario, row by row."""

    def __init__(self, raw: RawScenario) -> None:
        self._raw = raw
        self._iteration = np.arange(len(raw.time_us)) - raw.num_history
        self._rows: list[tuple[str, int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def keep(self, chosen: np.ndarray) -> None:
        """Keeps recorded tracks."""
        old = self._raw.tracks
        for row in np.flatnonzero(chosen):
            columns = old.pose[row], old.velocity[row], old.size[row], old.valid[row]
            self._rows.append((old.ids[row], int(old.type[row]), *columns))

    def add_vehicle(self, vehicle: Vehicle) -> None:
        """Adds a vehicle: what stands stays, what moves has a straight past and no future."""
        seconds = (self._raw.time_us - self._raw.time_us[self._raw.num_history]) / 1e6
        heading = vehicle.pose[2]
        velocity = vehicle.speed * np.array([np.cos(heading), np.sin(heading)])
        pose = np.tile(vehicle.pose, (len(seconds), 1))
        pose[:, :2] += np.minimum(seconds, 0.0)[:, None] * velocity
        known = (self._iteration <= 0) | (vehicle.behavior is Behavior.STOPPED)
        self._add(vehicle.track, ObjectType.VEHICLE, pose, velocity, vehicle.size, known)

    def add_pedestrian(self, who: ScriptedPedestrian) -> None:
        """Adds a pedestrian on its way; one that waits for the ego is nowhere yet."""
        start, end = np.array(who.start), np.array(who.end)
        heading = np.arctan2(*(end - start)[::-1])
        share = np.zeros(len(self._iteration))
        if who.begins_at is not None:
            share = walk_share(self._iteration, who.begins_at, self._raw.num_iterations)
        pose = np.empty((len(share), 3))
        pose[:, :2], pose[:, 2] = start + share[:, None] * (end - start), heading
        known = np.full(len(share), who.begins_at is not None)
        size = PEDESTRIAN_SIZE
        self._add(who.track, ObjectType.PEDESTRIAN, pose, np.zeros(2), size, known)

    def add_standing(
        self, track: str, kind: ObjectType, place: Sequence[float], size: tuple[float, float]
    ) -> None:
        """Adds an object that never moves."""
        pose = np.tile(np.array(place), (len(self._iteration), 1))
        self._add(track, kind, pose, np.zeros(2), size, np.ones(len(pose), bool))

    def _add(self, track, kind, pose, velocity, size, known) -> None:
        fill = lambda pair: np.tile(np.array(pair), (len(pose), 1))
        self._rows.append((track, int(kind), pose, fill(velocity), fill(size), known))

    def tracks(self) -> RawTracks:
        """Returns all rows as arrays."""
        steps = len(self._iteration)
        stack = lambda column, *shape: np.array([row[column] for row in self._rows]).reshape(
            len(self._rows), *shape
        )
        return RawTracks(
            ids=[row[0] for row in self._rows],
            type=stack(1).astype(np.int64),
            pose=stack(2, steps, 3),
            velocity=stack(3, steps, 2),
            size=stack(4, steps, 2),
            valid=stack(5, steps).astype(bool),
        )


def _plan(raw: RawScenario, changes: ScenarioChanges, query: MapQuery, ego: Ego) -> LanePlan:
    goal = changes.code.goal
    assert goal is not None
    place = changes.token_changes.goals.get(goal)
    span = raw.time_us[raw.num_history : raw.num_history + raw.num_iterations]
    duration = float(span[-1] - span[0]) / 1e6
    try:
        if place is not None:
            return plan_to_position(query, ego.block, ego.pose[:2], place)
        return plan_by_command(query, ego.block, goal, len(raw.route_roadblocks), duration)
    except ScenarioError as error:
        raise ScenarioError(f"scenario {changes.name}: goal {goal}: {error}") from error


def _obstacles(
    changes: ScenarioChanges, fleet: Sequence[Vehicle]
) -> tuple[ObstacleKind | None, tuple[Point, ...]]:
    special = changes.special
    if special is None:
        return None, ()
    kind = SPECIAL_TYPES[special.type]
    if kind is ObstacleKind.CONES:
        return kind, tuple((x, y) for x, y in special.cones)
    if kind is ObstacleKind.PEDESTRIANS:
        return kind, tuple(way.end for way in special.pedestrians)
    stopped = [vehicle.pose for vehicle in fleet if vehicle.behavior is Behavior.STOPPED]
    return kind, tuple(map(_point, stopped))


def _moved(pose: np.ndarray, distance: float) -> np.ndarray:
    """Moves poses `[..., 3]` along their heading."""
    heading = pose[..., 2]
    step = distance * np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], -1)
    return pose + step


def _arc_length(course: np.ndarray, place: np.ndarray) -> float:
    point = shapely.Point(place[:2])
    return LineString(course[:, :2]).project(point) if len(course) > 1 else 0.0


def _size(pair: np.ndarray) -> tuple[float, float]:
    return float(pair[0]), float(pair[1])


def _point(pose: np.ndarray) -> Point:
    return float(pose[0]), float(pose[1])


def _pose(pose: np.ndarray) -> Pose:
    return float(pose[0]), float(pose[1]), float(pose[2])
