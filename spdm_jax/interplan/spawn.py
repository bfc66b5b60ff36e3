"""Vehicles that interPlan adds: queues in lanes, single ones, stopped ones."""

import math
import random
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon

from spdm_jax.interplan.config import Density, ExtraAgent, ScenarioChanges
from spdm_jax.interplan.roads import block_at, chain_around, joined, lanes_of, pose_on
from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.raw import ScenarioError

REACH = 50.0
"""Length of a lane before and after the ego that a density fills, m."""
LEAST_GAP = 10
"""Least distance between two queued vehicles, and from the ego to one that takes its place, m."""
GREATEST_GAP = {Density.HIGH: 33, Density.MEDIUM: 50, Density.LOW: 100}
"""Distances between queued vehicles stay below it, m."""
CORRIDOR_SECONDS = 2.0
"""A vehicle needs the lane for as long at constant speed, s."""
BUS_SIZE = (7.4557, 2.0786)
"""Length and width of a stopped bus, m."""
_DEFAULT_LIMIT = 10.0
"""Speed of a queue's leader where the lane has no limit, m/s."""
_REACTION = (0.25, 0.05, 0.1)
"""Mean, deviation and least value of a driver's reaction time, s."""
_SPEED_NOISE = 1.0
"""Deviation of queued speeds, m/s."""


class Behavior(IntEnum):
    """How one vehicle drives."""

    DEFAULT = 0
    STOPPED = 1
    CAUTIOUS = 2


@dataclass(frozen=True)
class Vehicle:
    """A vehicle to add.

    Attributes:
      track: identifier.
      pose: `[3]` x, y, heading of the box centre.
      size: length and width, m.
      speed: along the heading, m/s.
      behavior: how it drives.
    """

    track: str
    pose: np.ndarray
    size: tuple[float, float]
    speed: float
    behavior: Behavior = Behavior.DEFAULT

    def corridor(self) -> Polygon:
        """Returns the ground it covers within `CORRIDOR_SECONDS` at constant speed."""
        length, width = self.size
        x, y, heading = self.pose
        along = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-along[1], along[0]]) * width / 2
        rear = np.array([x, y]) - along * length / 2
        front = np.array([x, y]) + along * (length / 2 + CORRIDOR_SECONDS * self.speed)
        return Polygon([rear + across, rear - across, front - across, front + across])


@dataclass(frozen=True)
class Queue:
    """Vehicles drawn along one line.

    Attributes:
      places: arc length (m) and speed (m/s) of each, from the far end on.
      ego_speed: speed that the ego's place in the queue asks for, m/s; None if it has none.
    """

    places: tuple[tuple[float, float], ...]
    ego_speed: float | None


@dataclass(frozen=True)
class Ego:
    """The ego at iteration 0.

    Attributes:
      pose: `[3]` box centre.
      size: length and width, m.
      speed: m/s, as recorded.
      lane: id of its lane.
      block: id of the lane's roadblock.
    """

    pose: np.ndarray
    size: tuple[float, float]
    speed: float
    lane: str
    block: str


def draw_queue(
    line: LineString,
    ego_at: float | None,
    greatest_gap: int,
    limit: float | None,
    free_exit: bool,
    accel_max: float,
    decel_max: float,
    rng: random.Random,
) -> Queue:
    """Draws a queue from the far end of a line back to its start.

    The leader drives at the limit, or so that it can stop at the line's end; each follower so that
    it can stop behind the one before it, and at least 2 s behind.

    Args:
      line: baseline of consecutive lanes.
      ego_at: arc length of the ego where the line is its own lane's, else None. A vehicle less
        than `LEAST_GAP` from it takes its place.
      greatest_gap: gaps are whole metres below it.
      limit: speed limit, m/s, None if unknown.
      free_exit: whether the leader may pass the line's end.
      accel_max: comfort limit, m/s^2.
      decel_max: comfort limit, m/s^2.
      rng: source of chance.

    Source: interPlan `AgentsModifier.spawn_agents`.
    """
    places: list[tuple[float, float]] = []
    ego_speed: float | None = None
    ego_place = math.inf if ego_at is None else ego_at
    place = float(line.length)
    speed: float | None = None
    while True:
        gap: float = rng.randrange(LEAST_GAP, greatest_gap)
        place -= gap
        if place < 0:
            return Queue(tuple(places), ego_speed)
        takes_ego = abs(place - ego_place) < LEAST_GAP
        if takes_ego:
            gap, place = gap + place - ego_place, ego_place
        if speed is not None:
            speed = _following_speed(speed, gap, decel_max, rng)
        elif free_exit:
            speed = limit or _DEFAULT_LIMIT
        else:
            speed = math.sqrt(2 / 3 * (line.length - place) * accel_max)
        speed += rng.gauss(0.0, _SPEED_NOISE)
        speed = max(min(speed, limit) if limit else speed, 0.0)
        if takes_ego:
            ego_speed = speed
        else:
            places.append((place, speed))
        if place == 0:
            return Queue(tuple(places), ego_speed)


def _following_speed(ahead: float, gap: float, decel_max: float, rng: random.Random) -> float:
    """Speed at which a driver can stop behind a braking leader: v t + a v^2 = gap + a v_ahead^2."""
    mean, deviation, least = _REACTION
    reaction = max(rng.gauss(mean, deviation), least)
    factor = 3 / (2 * decel_max)
    root = math.sqrt(reaction**2 + 4 * factor * (factor * ahead**2 + gap))
    return min(gap / 2, (root - reaction) / (2 * factor))


class Fleet:
    """Vehicles of a scenario while it is put together.

    New vehicles take the boxes of removed ones, in random order, and then the ego's.

    Args:
      query: the map.
      ego: at iteration 0.
      removed: track and size of each removed vehicle.
      rng: source of chance.

    Attributes:
      vehicles: those accepted so far.
    """

    def __init__(
        self,
        query: MapQuery,
        ego: Ego,
        removed: list[tuple[str, tuple[float, float]]],
        rng: random.Random,
    ) -> None:
        self._query, self._ego, self._rng = query, ego, rng
        self._bodies = rng.sample(removed, len(removed))
        self.vehicles: list[Vehicle] = []

    def add(
        self,
        pose: np.ndarray,
        moves: bool,
        behavior: Behavior = Behavior.DEFAULT,
        size: tuple[float, float] | None = None,
    ) -> None:
        """Adds a vehicle where its corridor is free.

        In the ego's roadblock others in the corridor do not matter, and a stopped vehicle replaces
        those that are not stopped themselves.

        Args:
          pose: `[3]` box centre.
          moves: whether it drives; as published all moving ones start with the ego's recorded
            speed.
          behavior: how it drives.
          size: length and width, m; that of a removed vehicle if None.
        """
        track, body = self._body()
        vehicle = Vehicle(
            track, np.asarray(pose), size or body, self._ego.speed if moves else 0.0, behavior
        )
        ground = vehicle.corridor()
        free = [not ground.intersects(other.corridor()) for other in self.vehicles]
        if behavior is Behavior.STOPPED:
            self.vehicles = [
                other
                for other, apart in zip(self.vehicles, free, strict=True)
                if apart or other.behavior is Behavior.STOPPED
            ]
        elif not all(free) and block_at(self._query, pose) != self._ego.block:
            return
        self.vehicles.append(vehicle)

    def _body(self) -> tuple[str, tuple[float, float]]:
        if self._bodies:
            return self._bodies.pop(0)
        # Two draws per vehicle, as published: of its box and of its track.
        _, track = self._rng.randrange(16**16), self._rng.randrange(16**16)
        return f"{track:016x}", self._ego.size


def fill_lanes(
    fleet: Fleet, query: MapQuery, ego: Ego, changes: ScenarioChanges, rng: random.Random
) -> float | None:
    """Adds queues in all lanes of the ego's roadblock and of those listed.

    Args:
      fleet: receives the vehicles.
      query: the map.
      ego: at iteration 0.
      changes: with a density.
      rng: source of chance.

    Returns:
      The ego's speed if it has a place in a queue, m/s.

    Raises:
      ScenarioError: a listed point is in no roadblock.
    """
    world = query.map
    blocks = [ego.block]
    for place in changes.spawn_roadblocks:
        block = block_at(query, place)
        if block is None:
            raise ScenarioError(
                f"scenario {changes.name}: roadblock_locations_to_spawn_agents {list(place)} is in "
                f"no roadblock of map {world.name}"
            )
        blocks.append(block)
    assert changes.code.density is not None
    exits = [block for block in world.roadblocks[ego.block].successors if block in world.roadblocks]
    ego_speed: float | None = None
    found: list[np.ndarray] = []
    for lane in (lane for block in blocks for lane in lanes_of(world, block)):
        line = joined(world, chain_around(query, lane, ego.pose[:2], REACH))
        at = line.project(shapely.Point(ego.pose[:2]))
        queue = draw_queue(
            line,
            at if lane == ego.lane else None,
            GREATEST_GAP[changes.code.density],
            world.lanes[lane].speed_limit,
            len(exits) == 1,
            changes.accel_max,
            changes.decel_max,
            rng,
        )
        found += [np.append(pose_on(line, place), speed) for place, speed in queue.places]
        ego_speed = ego_speed if queue.ego_speed is None else queue.ego_speed
    for *pose, speed in found:
        fleet.add(np.array(pose), moves=speed > 0)
    return ego_speed


def add_extra_agents(
    fleet: Fleet, query: MapQuery, agents: tuple[ExtraAgent, ...], where: str
) -> None:
    """Adds the vehicles that a token lists.

    Raises:
      ScenarioError: one is to be put on a lane but is on none; names it.
    """
    for i, agent in enumerate(agents):
        pose = np.array([agent.x, agent.y, 0.0])
        if agent.snap:
            lanes = [
                query.containing(layer, pose[None, :2])[0]
                for layer in (MapLayer.LANE, MapLayer.LANE_CONNECTOR)
            ]
            lane = next((found[0] for found in lanes if found), None)
            if lane is None:
                raise ScenarioError(
                    f"{where}: extra_agents_to_spawn[{i}] at {pose[:2].tolist()} is on no lane"
                )
            pose = query.project(lane, pose[:2]).pose
        behavior = Behavior.CAUTIOUS if agent.cautious else Behavior.DEFAULT
        fleet.add(pose, moves=agent.speed != 0, behavior=behavior)
