"""The eight situations of the suite `interactive-8`, in which following a lane does not do.

Whatever blocks a lane for good is a generic object, a cone, a barrier or a sign and never a
vehicle: traffic that is simulated makes every vehicle on a lane drive off, and one beside the
lanes vanish, while objects of these types stay as they are in every kind of traffic.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from spdm_jax.io.raw import RawArea
from spdm_jax.synthetic.filling import fill_oncoming, roadside, start_on
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import LANE_WIDTH, MARGIN, MapBuilder, add_corridor, strip
from spdm_jax.synthetic.stage import (
    BARRIER,
    CONE,
    EGO_STATION,
    PEDESTRIAN,
    Stage,
    corridor,
    light_phases,
    queue,
    standing,
    vehicle,
    walk,
)
from spdm_jax.synthetic.suite_stage import EXPERT_PACE, LONG_AGO, expert, tail
from spdm_jax.synthetic.traffic import EGO_FRONT
from spdm_jax.types import DrivableKind, LightStatus, ObjectType

HOLD = "expert.hold"
"""A line at which the expert waits until the way is free; no planner sees it."""
SIGN = (0.3, 0.8)
_STAYS = ObjectType.GENERIC_OBJECT
FRONT = EGO_STATION + EGO_FRONT
"""Station of the ego's front bumper at iteration 0, m."""


def lane_change(rng: np.random.Generator, spacing: tuple[float, float], limit: float) -> Stage:
    """The ego's lane of a one-way road ends; the goal is on the lane beside it.

    Args:
      rng: source of variety.
      spacing: range of the mean distance between the vehicles of the goal lane, m.
      limit: speed limit, m/s.
    """
    gap = rng.uniform(*spacing)
    speed = rng.uniform(0.62, 0.72) * limit
    begin = EGO_STATION + rng.uniform(4.0, 12.0)
    done = begin + 4.5 * speed
    end = done + EGO_FRONT + rng.uniform(4.0, 10.0)
    goal = int(rng.integers(2))
    path = Path.from_curvature([(end, rng.uniform(-1.0, 1.0) / 400.0), (500.0, 0.0)])
    builder = MapBuilder("synthetic")
    add_corridor(
        builder,
        "road",
        path,
        [(0.0, end), (end + 6.0, end + 200.0), (end + 206.0, path.length)],
        forward=[(0, 1), (goal,), (goal,)],
        speed_limit=limit,
        connector_limit=limit,
    )
    stage = start_on(builder, goal, speed, EXPERT_PACE * limit)
    lane = stage.ego.path
    sideways = LANE_WIDTH if goal == 0 else -LANE_WIDTH
    own = lane.parallel(-sideways)
    change = own.shifted(begin, done, sideways)
    # The ego is about in the middle of a gap; all want the same speed, so the gap stays with it.
    first = EGO_STATION + EGO_FRONT / 2 + rng.uniform(0.45, 0.55) * gap
    for k in range(-3, 9):
        station = first + (k + rng.uniform(-0.06, 0.06)) * gap
        wish = speed * rng.uniform(1.0, 1.1)
        if 5.0 < station < EGO_STATION + 140.0:
            stage.followers.append(vehicle(rng, lane, station, speed, wish))
    stage.ego = dataclasses.replace(stage.ego, path=own)
    tail(rng, stage, rng.uniform(14.0, 25.0))
    stage.ego = expert(stage.ego, change)
    # The surface goes on a little, so that who stops at the end stands on it.
    middle = -(1.5 - goal) * LANE_WIDTH
    reach = LANE_WIDTH / 2 + MARGIN
    rest = strip(path, end - 1.0, end + 12.0, middle - reach, middle + reach)
    builder.drivable.append(RawArea("road.end", rest, DrivableKind.GENERIC))
    for left in (middle - 0.9, middle + 0.9):
        stage.scripted.append(standing(path, end + 8.0, left, BARRIER, ObjectType.BARRIER))
    return stage


def construction_zone(rng: np.random.Generator) -> Stage:
    """Cones and barriers close the ego's lane of two; the expert passes them on the other one."""
    stage, path, speed = _two_lanes(rng)
    begin, length = FRONT + rng.uniform(46.0, 58.0), rng.uniform(18.0, 28.0)
    own = stage.ego.path
    edge = LANE_WIDTH / 2
    for k, left in enumerate(np.linspace(-edge + 0.2, edge - 0.8, 6)):
        stage.scripted.append(standing(own, begin + 2.0 * k, left, CONE, ObjectType.TRAFFIC_CONE))
    for station in np.arange(begin + 14.0, begin + 10.0 + length, 3.0):
        cone = standing(own, station, edge - 0.7, CONE, ObjectType.TRAFFIC_CONE)
        stage.scripted.append(cone)
    for station in (begin + 12.0, begin + 10.0 + length):
        barrier = standing(own, station, -0.3, BARRIER, ObjectType.BARRIER)
        stage.scripted.append(barrier)
    sign = standing(own, begin - 8.0, -edge - 0.2, SIGN, ObjectType.CZONE_SIGN)
    stage.scripted.append(sign)
    _pass_left(rng, stage, speed, begin - 12.0, begin + 14.0 + length, LANE_WIDTH)
    _beside(rng, stage, path, speed)
    return stage


def crashed_cars(rng: np.random.Generator) -> Stage:
    """Two cars have crashed on the ego's lane of two; the other one is free."""
    stage, path, speed = _two_lanes(rng)
    begin = FRONT + rng.uniform(46.0, 58.0)
    own = stage.ego.path
    for station, turn in ((begin + 2.5, rng.uniform(0.3, 0.7)), (begin + 7.5, -0.4)):
        size = (rng.uniform(4.2, 4.8), 1.85)
        car = standing(own, station, -0.8, size, ObjectType.GENERIC_OBJECT)
        x, y, heading = car.start
        heading += float(turn * rng.choice([-1.0, 1.0]))
        stage.scripted.append(dataclasses.replace(car, start=(x, y, heading)))
    for ahead in (-6.0, -4.0):
        cone = standing(own, begin + ahead, rng.uniform(-0.6, 0.6), CONE, ObjectType.TRAFFIC_CONE)
        stage.scripted.append(cone)
    witness = standing(path, begin, -2.0 * LANE_WIDTH - 2.0, PEDESTRIAN, ObjectType.PEDESTRIAN)
    stage.scripted.append(witness)
    _pass_left(rng, stage, speed, begin - 14.0, begin + 12.0, LANE_WIDTH)
    _beside(rng, stage, path, speed)
    return stage


def jaywalking_pedestrian(rng: np.random.Generator) -> Stage:
    """Someone steps onto the road where no crosswalk is, in the way of an ego that drives on."""
    speed, limit = rng.uniform(8.0, 10.5), 13.4
    lanes = int(rng.integers(1, 3))
    builder, path = corridor(rng, _winding(rng), lanes=lanes, oncoming=1, speed_limit=limit)
    lane = lanes - 1
    stage = start_on(builder, lane, speed, EXPERT_PACE * limit)
    distance = rng.uniform(32.0, 48.0)
    right, left = -lanes * LANE_WIDTH - MARGIN - 1.0, LANE_WIDTH + MARGIN + 1.0
    kerbs = [right, left] if rng.random() < 0.6 else [left, right]
    ends = path.offset(np.full(2, FRONT + distance), np.array(kerbs))
    pace = rng.uniform(1.2, 1.8)
    to_ego = abs(kerbs[0] + (lane + 0.5) * LANE_WIDTH)
    begin = distance / speed - to_ego / pace + rng.uniform(-0.5, 0.5)
    stage.scripted.append(walk(ends[0], ends[1], pace, begin))
    if rng.random() < 0.5:
        # A box at the kerb, which the pedestrian comes from behind.
        box = standing(path, FRONT + distance - 4.0, right - 0.5, (3.0, 1.6), _STAYS)
        stage.scripted.append(box)
    tail(rng, stage, rng.uniform(12.0, 20.0))
    fill_oncoming(rng, stage, 1, 60.0, speed)
    roadside(rng, stage, path, lanes, 1)
    stage.ego = expert(stage.ego)
    return stage


def nudge_around_parked_vehicle(rng: np.random.Generator) -> Stage:
    """A car is parked half on the kerb; there is room beside it within the lane, off its middle."""
    stage, path, speed = _one_lane(rng)
    begin = FRONT + rng.uniform(30.0, 50.0)
    reach = rng.uniform(0.75, 1.0)
    size = (rng.uniform(4.3, 5.0), rng.uniform(1.85, 2.0))
    left = -LANE_WIDTH / 2 + reach - size[1] / 2
    stage.scripted.append(standing(stage.ego.path, begin + size[0] / 2, left, size, _STAYS))
    _pass_left(rng, stage, speed, begin - 2.0, begin + size[0] + 3.0, reach - 0.15)
    fill_oncoming(rng, stage, 1, 45.0, speed)
    tail(rng, stage, rng.uniform(14.0, 22.0))
    roadside(rng, stage, path, 1, 1)
    return stage


def overtake_parked_vehicle(rng: np.random.Generator) -> Stage:
    """A van blocks the only lane; the way around it is the oncoming lane, when that is free.

    Oncoming vehicles come in two groups with a long gap between them.
    """
    stage, path, _ = _one_lane(rng)
    begin = FRONT + rng.uniform(38.0, 50.0)
    size = (rng.uniform(5.5, 6.5), rng.uniform(2.0, 2.2))
    van = standing(stage.ego.path, begin + size[0] / 2, -rng.uniform(0.3, 0.5), size, _STAYS)
    stage.scripted.append(van)

    there = stage.builder.path(stage.builder.follow("road~:0/0"))
    pace = rng.uniform(8.0, 9.5)
    out = begin - 27.0
    # The last of the first group passes the place where the expert pulls out at this time.
    free = rng.uniform(2.0, 4.5)
    first = there.station_of(path.offset(out, LANE_WIDTH / 2)) - pace * free
    stations = [first + 14.0 * i for i in range(int(rng.integers(1, 4)))]
    stations += [first - rng.uniform(170.0, 190.0) - 16.0 * i for i in range(3)]
    for station in stations:
        if 0.0 < station < there.length:
            stage.followers.append(vehicle(rng, there, station, pace, pace))
    tail(rng, stage, rng.uniform(16.0, 25.0))

    line = out + EGO_FRONT + 1.0
    ego = dataclasses.replace(stage.ego, gates=((line, HOLD),))
    stage.lights = {
        HOLD: light_phases([(LONG_AGO, LightStatus.RED), (free + 0.5, LightStatus.GREEN)])
    }
    around = ego.path.shifted(out, begin - 5.0, 2.75)
    back = begin + size[0] + 4.0
    stage.ego = expert(ego, around.shifted(back, back + 22.0, -2.75))
    return stage


INTERACTIVE: dict[str, Callable[[np.random.Generator], Stage]] = {
    "low_traffic_density": functools.partial(lane_change, spacing=(60.0, 80.0), limit=13.4),
    "medium_traffic_density": functools.partial(lane_change, spacing=(32.0, 40.0), limit=13.4),
    "high_traffic_density": functools.partial(lane_change, spacing=(18.0, 22.0), limit=8.3),
    **{
        scene.__name__: scene
        for scene in (
            construction_zone,
            crashed_cars,
            jaywalking_pedestrian,
            nudge_around_parked_vehicle,
            overtake_parked_vehicle,
        )
    },
}
"""Scene functions by scenario type."""


def _two_lanes(rng: np.random.Generator) -> tuple[Stage, Path, float]:
    """Returns a road with two lanes, the ego on the right one; its reference line and speed."""
    speed, limit = rng.uniform(7.5, 9.5), 11.1
    builder, path = corridor(rng, _winding(rng), lanes=2, oncoming=1, speed_limit=limit)
    return start_on(builder, 1, speed, EXPERT_PACE * limit), path, speed


def _one_lane(rng: np.random.Generator) -> tuple[Stage, Path, float]:
    """Returns a road with one lane per direction, its reference line and the ego's speed."""
    speed, limit = rng.uniform(7.0, 9.0), 11.1
    builder, path = corridor(rng, _winding(rng), lanes=1, oncoming=1, speed_limit=limit)
    return start_on(builder, 0, speed, EXPERT_PACE * limit), path, speed


def _pass_left(
    rng: np.random.Generator, stage: Stage, speed: float, out: float, back: float, left: float
) -> None:
    """Makes the expert pass an obstacle on its left and return to its lane.

    Args:
      rng: source of variety.
      stage: whose ego passes.
      speed: at iteration 0, m/s.
      out: station which the front bumper reaches with the sideways motion completed, m.
      back: station at which the rear axle begins to return, m.
      left: sideways motion, m.
    """
    done = out - EGO_FRONT
    begin = max(done - rng.uniform(5.0, 6.0) * speed, EGO_STATION + 2.0)
    around = stage.ego.path.shifted(begin, done, left)
    around = around.shifted(back, back + rng.uniform(3.5, 4.5) * speed, -left)
    stage.ego = expert(stage.ego, around)


def _beside(rng: np.random.Generator, stage: Stage, path: Path, speed: float) -> None:
    """Fills the lane to the left of the ego's before and behind a gap, and the oncoming one."""
    lane = stage.builder.path(stage.builder.follow("road:0/0"))
    wish = stage.ego.desired_speed
    for begin, end in ((25.0, 120.0), (-55.0, -20.0)):
        stage.followers += queue(
            rng,
            lane,
            EGO_STATION + begin,
            EGO_STATION + end,
            32.0,
            speed=speed,
            desired_speed=0.95 * wish,
        )
    fill_oncoming(rng, stage, 1, 45.0, speed)
    roadside(rng, stage, path, 2, 1)


def _winding(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Returns the pieces of a road that is straight at first and bends gently later."""
    bends = rng.uniform(-1.0, 1.0, 2) / 250.0
    return [(230.0, 0.0), *((200.0, float(k)) for k in bends)]
