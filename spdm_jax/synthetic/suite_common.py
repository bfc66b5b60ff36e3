"""The fourteen everyday situations of the suite `common-14`, on roads and at crossings."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from spdm_jax.io.raw import RawArea
from spdm_jax.synthetic.filling import fill_lanes, fill_oncoming, roadside, start_on
from spdm_jax.synthetic.junctions import approach, four_arms, pavement_walks
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import LANE_WIDTH, MARGIN, strip
from spdm_jax.synthetic.stage import EGO_STATION, Stage, corridor, queue, standing, walk
from spdm_jax.synthetic.suite_stage import (
    EXPERT_PACE,
    LONG_AGO,
    around_green,
    expert,
    flowing,
    green_between,
    lead,
    leaving,
    signals,
    tail,
    waiting,
)
from spdm_jax.synthetic.traffic import EGO_FRONT
from spdm_jax.types import DrivableKind, ObjectType

CITY_LIMITS = (11.1, 13.4)
"""Speed limits at crossings, m/s."""
RADIUS = 17.0
"""Distance of the arms from the middle of a crossing, m."""


def starting_turn(rng: np.random.Generator, turn: str) -> Stage:
    """A turn at lights, from rest when they turn green or rolling up to green ones.

    The oncoming arm has red during a left turn.
    """
    lane, target = (0, "west") if turn == "left" else (1, "east")
    rests = rng.random() < 0.6
    begin = rng.uniform(0.8, 2.0) if rests else LONG_AGO
    own, red = (begin, 20.0), (60.0, 90.0)
    stage = _at_lights(rng, target, lane, own, red if turn == "left" else own)
    if rests:
        front = waiting(rng, stage, "south", target, lane, int(rng.integers(2)))
        stage.ego = dataclasses.replace(stage.ego, station=front - EGO_FRONT, speed=0.0)
    elif rng.random() < 0.5:
        lead(rng, stage, rng.uniform(10.0, 16.0), stage.ego.speed, 0.9 * stage.ego.desired_speed)
    tail(rng, stage, 3.0 if rests else rng.uniform(12.0, 20.0))
    for arm in ("east", "west"):
        for k in range(2):
            waiting(rng, stage, arm, "west" if arm == "east" else "east", k, int(rng.integers(4)))
    for k in range(2):
        waiting(rng, stage, "north", "south", k, int(rng.integers(4)) if turn == "left" else 0)
        leaving(rng, stage, target, k, spacing=45.0, speed=8.0)
    if rests:
        waiting(rng, stage, "south", "north", 1 - lane, 2)
    stage.ego = expert(stage.ego)
    return stage


def starting_straight_traffic_light_intersection_traversal(rng: np.random.Generator) -> Stage:
    """The light turns green and the ego, first or second at the line, drives straight across."""
    lane = int(rng.integers(2))
    own = (rng.uniform(0.8, 3.0), 22.0)
    stage = _at_lights(rng, "north", lane, own, own)
    front = waiting(rng, stage, "south", "north", lane, int(rng.integers(2)))
    stage.ego = dataclasses.replace(stage.ego, station=front - EGO_FRONT, speed=0.0)
    tail(rng, stage, 3.0)
    waiting(rng, stage, "south", "north", 1 - lane, int(rng.integers(1, 4)))
    for k in range(2):
        waiting(rng, stage, "north", "south", k, int(rng.integers(4)))
        leaving(rng, stage, "north", k, spacing=40.0, speed=8.0)
        for arm, to in (("east", "west"), ("west", "east")):
            waiting(rng, stage, arm, to, k, int(rng.integers(4)))
    stage.ego = expert(stage.ego)
    return stage


def stopping_with_lead(rng: np.random.Generator) -> Stage:
    """The vehicle ahead stops at a red light or behind a queue there, and the ego behind it."""
    lane = int(rng.integers(2))
    own = (rng.uniform(14.0, 18.0), 60.0)
    stage = _at_lights(rng, "north", lane, own, own)
    front = waiting(rng, stage, "south", "north", lane, int(rng.integers(1, 3)))
    speed = rng.uniform(7.5, 9.5)
    gap = rng.uniform(13.0, 18.0)
    station = front - rng.uniform(22.0, 35.0) - gap - EGO_FRONT
    stage.ego = dataclasses.replace(stage.ego, station=station, speed=speed)
    lead(rng, stage, gap, speed, stage.ego.desired_speed)
    tail(rng, stage, rng.uniform(14.0, 20.0))
    waiting(rng, stage, "south", "north", 1 - lane, int(rng.integers(1, 4)))
    _crossing_flow(rng, stage)
    stage.ego = expert(stage.ego)
    return stage


def stationary_in_traffic(rng: np.random.Generator) -> Stage:
    """The ego stands in the middle of a queue at a red light; some queues set off later on."""
    lane = int(rng.integers(2))
    own = (rng.uniform(6.0, 18.0), 60.0)
    stage = _at_lights(rng, "north", lane, own, own)
    front = waiting(rng, stage, "south", "north", lane, int(rng.integers(2, 4)))
    stage.ego = dataclasses.replace(stage.ego, station=front - EGO_FRONT, speed=0.0)
    tail(rng, stage, rng.uniform(1.8, 2.1))
    waiting(rng, stage, "south", "north", 1 - lane, int(rng.integers(3, 6)))
    _crossing_flow(rng, stage)
    stage.ego = expert(stage.ego)
    return stage


def high_lateral_acceleration(rng: np.random.Generator) -> Stage:
    """A narrow bend, driven at 1.5 m/s^2 sideways or more."""
    radius = rng.uniform(36.0, 50.0) * rng.choice([-1.0, 1.0])
    arc = abs(radius) * rng.uniform(1.2, 1.6)
    before = EGO_STATION + rng.uniform(20.0, 40.0)
    segments = [(before, 0.0), (arc, 1.0 / radius), (600.0 - before - arc, 0.0)]
    stage, path = _on_corridor(rng, segments, lanes=2, oncoming=1, speed=9.0, limit=11.1)
    fill_lanes(rng, stage, 2, 1, 50.0, 9.0, clear_ahead=30.0)
    roadside(rng, stage, path, 2, 1)
    stage.ego = expert(stage.ego)
    return stage


def high_magnitude_speed(rng: np.random.Generator) -> Stage:
    """A fast road with several lanes and little traffic."""
    limit = float(rng.choice([18.0, 20.0, 22.2]))
    bends = rng.uniform(-1.0, 1.0, 3) / 600.0
    segments = [(150.0, 0.0), *((280.0, float(k)) for k in bends)]
    speed = limit * rng.uniform(0.75, 0.88)
    stage, path = _on_corridor(rng, segments, lanes=3, oncoming=2, speed=speed, limit=limit)
    fill_lanes(rng, stage, 3, 2, 60.0, speed, clear_ahead=45.0)
    roadside(rng, stage, path, 3, 2)
    stage.ego = expert(stage.ego)
    return stage


def low_magnitude_speed(rng: np.random.Generator) -> Stage:
    """Walking pace in a jam on two lanes."""
    speed = rng.uniform(1.0, 2.0)
    stage, path = _on_corridor(rng, _winding(rng), lanes=2, oncoming=1, speed=speed, limit=13.4)
    pace = 1.1 * speed
    fill_lanes(rng, stage, 2, 0, 10.5, speed, desired_speed=pace, clear_ahead=22.0)
    lead(rng, stage, rng.uniform(4.0, 6.0), speed, pace)
    fill_oncoming(rng, stage, 1, 40.0, 9.0)
    roadside(rng, stage, path, 2, 1)
    stage.ego = expert(stage.ego)
    return stage


def traversing_pickup_dropoff(rng: np.random.Generator) -> Stage:
    """A slow street along a kerb where vehicles stand to let people in and out.

    The area where they may stop is drivable and reaches over the ego's lane.
    """
    speed = rng.uniform(4.5, 6.0)
    stage, path = _on_corridor(rng, _winding(rng), lanes=1, oncoming=1, speed=speed, limit=8.3)
    edge = -LANE_WIDTH - MARGIN
    begin, end = EGO_STATION - rng.uniform(5.0, 15.0), EGO_STATION + rng.uniform(70.0, 100.0)
    kerb = strip(path, begin, end, edge - 2.6, -LANE_WIDTH)
    stage.builder.add_car_park("kerb", kerb)
    area = strip(path, begin, end, edge - 2.6, 0.0)
    stage.builder.drivable.append(RawArea("pickup", area, DrivableKind.GENERIC))
    for station in np.arange(begin + 4.0, end - 4.0, 7.5):
        if rng.random() < 0.7:
            size = (rng.uniform(4.2, 5.0), rng.uniform(1.8, 1.9))
            left = edge - rng.uniform(1.3, 1.5)
            stage.scripted.append(standing(path, station, left, size, ObjectType.VEHICLE))
        ends = path.offset(station + np.array([-1.5, 1.5]), edge - rng.uniform(3.2, 4.5))
        stage.scripted.append(walk(ends[0], ends[1], rng.uniform(0.2, 1.0), rng.uniform(-2.0, 9.0)))
    for side, (inner, outer) in {"left": (4.5, 7.0), "right": (edge - 5.5, edge - 2.8)}.items():
        walkway = strip(path, 0.0, path.length, inner, outer)
        stage.builder.walkways.append(RawArea(f"walkway-{side}", walkway))
    lead(rng, stage, rng.uniform(18.0, 35.0), speed, rng.uniform(5.0, 7.0))
    tail(rng, stage, rng.uniform(10.0, 16.0))
    fill_oncoming(rng, stage, 1, 45.0, speed)
    stage.ego = expert(stage.ego)
    return stage


def waiting_for_pedestrian_to_cross(rng: np.random.Generator) -> Stage:
    """Pedestrians use a crosswalk ahead of the ego, which waits for them and drives on."""
    lanes = int(rng.integers(1, 3))
    speed = rng.uniform(4.0, 6.5)
    stage, path = _on_corridor(
        rng, _winding(rng), lanes=lanes, oncoming=1, speed=speed, limit=11.1, lane=lanes - 1
    )
    distance = rng.uniform(12.0, 20.0)
    station = EGO_STATION + EGO_FRONT + distance
    right, left = -lanes * LANE_WIDTH - MARGIN, LANE_WIDTH + MARGIN
    zebra = strip(path, station, station + 4.0, right, left)
    stage.builder.crosswalks.append(RawArea("zebra", zebra))
    own = -(lanes - 0.5) * LANE_WIDTH
    for i in range(int(rng.integers(1, 4))):
        kerbs = np.array([right - 1.0, left + 1.0])
        if rng.random() < 0.4:
            kerbs = kerbs[::-1]
        ends = path.offset(station + rng.uniform(1.0, 3.0, 2), kerbs)
        pace = rng.uniform(1.1, 1.5)
        # The first is on the ego's lane when an ego that does not wait arrives.
        meeting = distance / speed + (rng.uniform(0.0, 1.0) if i == 0 else rng.uniform(-2.0, 2.0))
        stage.scripted.append(walk(ends[0], ends[1], pace, meeting - abs(kerbs[0] - own) / pace))
    tail(rng, stage, rng.uniform(9.0, 14.0))
    fill_oncoming(rng, stage, 1, 60.0, 7.0)
    roadside(rng, stage, path, lanes, 1)
    stage.ego = expert(stage.ego)
    return stage


def behind_long_vehicle(rng: np.random.Generator) -> Stage:
    """A bus or lorry ahead is slower than the ego would like to be."""
    speed = rng.uniform(6.0, 8.5)
    stage, path = _on_corridor(rng, _winding(rng), lanes=2, oncoming=1, speed=speed, limit=13.4)
    fill_lanes(rng, stage, 2, 1, 40.0, speed, desired_speed=1.15 * speed, clear_ahead=50.0)
    size = (rng.uniform(10.0, 13.0), rng.uniform(2.4, 2.55))
    lead(rng, stage, rng.uniform(9.0, 13.0), speed, speed * rng.uniform(0.9, 1.1), size)
    roadside(rng, stage, path, 2, 1)
    stage.ego = expert(stage.ego)
    return stage


def near_multiple_vehicles(rng: np.random.Generator) -> Stage:
    """Dense traffic flows on three lanes around the ego."""
    speed = rng.uniform(5.0, 7.0)
    stage, path = _on_corridor(
        rng, _winding(rng), lanes=3, oncoming=2, speed=speed, limit=13.4, lane=1
    )
    fill_lanes(rng, stage, 3, 0, 15.0, speed, desired_speed=1.2 * speed)
    fill_oncoming(rng, stage, 2, 65.0, speed)
    roadside(rng, stage, path, 3, 2)
    stage.ego = expert(stage.ego)
    return stage


def changing_lane(rng: np.random.Generator) -> Stage:
    """The ego changes to the lane beside it, into a gap."""
    lanes = int(rng.integers(2, 4))
    speed = rng.uniform(8.0, 10.5)
    lane = int(rng.integers(lanes))
    stage, path = _on_corridor(
        rng, _winding(rng), lanes=lanes, oncoming=1, speed=speed, limit=13.4, lane=lane
    )
    other = lane + (1 if lane == 0 or (lane < lanes - 1 and rng.random() < 0.5) else -1)
    spacing = rng.uniform(38.0, 48.0)
    for k in range(lanes):
        # The ego is in the middle of a gap of the other lane, and alone on its own.
        beside = (
            EGO_STATION + EGO_FRONT / 2 + (0.5 * spacing if k == other else rng.uniform(25, 40))
        )
        way = stage.builder.path(stage.builder.follow(f"road:0/{k}"))
        wish = 0.95 * stage.ego.desired_speed
        for begin, end in ((beside - 1.0, beside + 130.0), (10.0, beside - spacing - 10.0)):
            stage.followers += queue(rng, way, begin, end, spacing, speed=speed, desired_speed=wish)
    fill_oncoming(rng, stage, 1, 45.0, speed)
    roadside(rng, stage, path, lanes, 1)
    start = EGO_STATION + rng.uniform(8.0, 25.0)
    sideways = LANE_WIDTH * (lane - other)
    stage.ego = expert(
        stage.ego, stage.ego.path.shifted(start, start + rng.uniform(4.5, 5.5) * speed, sideways)
    )
    stage.route = stage.builder.follow(f"road:0/{other}")
    return stage


def following_lane_with_lead(rng: np.random.Generator) -> Stage:
    """The ego follows a vehicle on a winding road."""
    lanes = int(rng.integers(1, 4))
    speed = rng.uniform(7.5, 10.5)
    stage, path = _on_corridor(rng, _winding(rng), lanes=lanes, oncoming=1, speed=speed, limit=13.4)
    fill_lanes(rng, stage, lanes, 1, 38.0, speed, desired_speed=1.05 * speed, clear_ahead=55.0)
    lead(rng, stage, rng.uniform(12.0, 20.0), speed, speed * rng.uniform(0.85, 1.1))
    roadside(rng, stage, path, lanes, 1)
    stage.ego = expert(stage.ego)
    return stage


COMMON: dict[str, Callable[[np.random.Generator], Stage]] = {
    "starting_left_turn": functools.partial(starting_turn, turn="left"),
    "starting_right_turn": functools.partial(starting_turn, turn="right"),
    **{
        scene.__name__: scene
        for scene in (
            starting_straight_traffic_light_intersection_traversal,
            stopping_with_lead,
            high_lateral_acceleration,
            high_magnitude_speed,
            low_magnitude_speed,
            traversing_pickup_dropoff,
            waiting_for_pedestrian_to_cross,
            behind_long_vehicle,
            stationary_in_traffic,
            near_multiple_vehicles,
            changing_lane,
            following_lane_with_lead,
        )
    },
}
"""Scene functions by scenario type."""


def _at_lights(
    rng: np.random.Generator,
    target: str,
    lane: int,
    own: tuple[float, float],
    oncoming: tuple[float, float],
) -> Stage:
    """Returns a crossing with lights that the ego approaches from the south.

    Args:
      rng: source of variety.
      target: arm that the ego leaves by.
      lane: lane of the ego.
      own: when the ego's light is green, s.
      oncoming: when that of the opposite arm is.
    """
    limit = float(rng.choice(CITY_LIMITS))
    builder, arms = four_arms(rng, lanes=2, radius=RADIUS, speed_limit=limit, light=True)
    lights = signals(
        builder,
        {
            "south": green_between(*own),
            "north": green_between(*oncoming),
            "east": around_green(*own),
            "west": around_green(*own),
        },
    )
    speed, distance = rng.uniform(6.0, 8.0), rng.uniform(18.0, 35.0)
    connector = f"south>{target}/{lane}"
    stage = approach(builder, [connector], distance, speed, EXPERT_PACE * limit, lights)
    pavement_walks(rng, stage, arms, 2)
    return stage


def _crossing_flow(rng: np.random.Generator, stage: Stage) -> None:
    """Adds traffic that has green across the ego's road, and a queue opposite."""
    for k in range(2):
        waiting(rng, stage, "north", "south", k, int(rng.integers(4)))
        for arm, to in (("east", "west"), ("west", "east")):
            flowing(rng, stage, arm, to, k, spacing=35.0, speed=9.0, before=10.0)


def _on_corridor(
    rng: np.random.Generator,
    segments: list[tuple[float, float]],
    *,
    lanes: int,
    oncoming: int,
    speed: float,
    limit: float,
    lane: int | None = None,
) -> tuple[Stage, Path]:
    """Returns a corridor with the ego on one of its lanes, and its reference line."""
    builder, path = corridor(rng, segments, lanes=lanes, oncoming=oncoming, speed_limit=limit)
    lane = int(rng.integers(lanes)) if lane is None else lane
    return start_on(builder, lane, speed, EXPERT_PACE * limit), path


def _winding(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Returns the pieces of a road with gentle bends."""
    bends = rng.uniform(-1.0, 1.0, 3) / 160.0
    return [(70.0, 0.0), *((180.0, float(k)) for k in bends)]
