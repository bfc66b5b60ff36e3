"""Named scenes on corridors; `spdm_jax.synthetic.junctions` has those at crossings.

A scene function draws its variety (geometry, actors, speeds) from the generator it is given and
takes the quantities that a user wants to fix as keyword options.
"""

import numpy as np

from spdm_jax.synthetic.filling import AHEAD, fill_lanes, fill_oncoming, roadside, start_on
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import LANE_WIDTH, MARGIN, MapBuilder, add_corridor
from spdm_jax.synthetic.stage import (
    BARRIER,
    BICYCLE,
    CONE,
    EGO_STATION,
    Stage,
    corridor,
    queue,
    standing,
    vehicle,
    walk,
)
from spdm_jax.synthetic.traffic import EGO_FRONT, Follower
from spdm_jax.types import ObjectType

ROAD_LENGTH = 630.0
"""Length of a corridor, m: the way of a whole scene, and a planner's horizon beyond it."""


def open_road(
    rng: np.random.Generator, *, speed: float = 10.0, speed_limit: float = 13.4, lanes: int = 2
) -> Stage:
    """A gently winding road without any other road user."""
    bends = rng.uniform(-1.0, 1.0, 3) / 180.0
    segments = [(90.0, 0.0), *((180.0, float(k)) for k in bends)]
    builder, _ = corridor(rng, segments, lanes=lanes, oncoming=1, speed_limit=speed_limit)
    return start_on(builder, int(rng.integers(lanes)), speed, speed_limit)


def straight(
    rng: np.random.Generator,
    *,
    speed: float = 11.0,
    speed_limit: float = 13.4,
    lanes: int = 3,
    oncoming: int = 2,
    spacing: float = 38.0,
) -> Stage:
    """A straight road with several lanes and flowing traffic."""
    segments = [(ROAD_LENGTH, 0.0)]
    builder, path = corridor(rng, segments, lanes=lanes, oncoming=oncoming, speed_limit=speed_limit)
    stage = start_on(builder, int(rng.integers(lanes)), speed, speed_limit)
    fill_lanes(rng, stage, lanes, oncoming, spacing, speed)
    roadside(rng, stage, path, lanes, oncoming)
    return stage


def curve(
    rng: np.random.Generator,
    *,
    speed: float = 9.0,
    speed_limit: float = 11.0,
    radius: float | None = None,
    spacing: float = 40.0,
) -> Stage:
    """A bend of about 90 degrees on a road with two lanes and oncoming traffic.

    Options: `radius` in m, positive to the left; drawn from 45 to 90 m either way if None.

    Raises:
      ValueError: the radius is below 30 m.
    """
    if radius is None:
        radius = float(rng.uniform(45.0, 90.0) * rng.choice([-1.0, 1.0]))
    if abs(radius) < 30.0:
        raise ValueError(f"radius is {radius} m; a corridor's bend needs at least 30 m")
    arc = abs(radius) * np.pi / 2
    segments = [(85.0, 0.0), (arc, 1.0 / radius), (ROAD_LENGTH - 85.0 - arc, 0.0)]
    builder, path = corridor(rng, segments, lanes=2, oncoming=1, speed_limit=speed_limit)
    stage = start_on(builder, int(rng.integers(2)), speed, speed_limit)
    fill_lanes(rng, stage, 2, 1, spacing, speed)
    roadside(rng, stage, path, 2, 1)
    return stage


def parked_car(
    rng: np.random.Generator,
    *,
    gap: float = 25.0,
    speed: float = 10.0,
    left_lane_free: bool = True,
    speed_limit: float = 13.4,
) -> Stage:
    """A parked car blocks the ego's lane; the lane to its left is free or full.

    Options: `gap` in m from the ego's front bumper to the car's rear bumper at iteration 0.

    Raises:
      ValueError: the gap is not positive.
    """
    if gap <= 0.0:
        raise ValueError(f"gap is {gap} m; the parked car must be ahead, give a positive gap")
    segments = [(ROAD_LENGTH, 0.0)]
    builder, path = corridor(rng, segments, lanes=2, oncoming=1, speed_limit=speed_limit)
    stage = start_on(builder, 1, speed, speed_limit)
    own, lane = stage.ego.path, builder.path(builder.follow("road:0/0"))
    size = (rng.uniform(4.2, 5.2), rng.uniform(1.8, 2.0))
    rear = EGO_STATION + EGO_FRONT + gap
    stage.followers.append(Follower(own, rear + size[0] / 2, 0.0, 0.0, size))
    if left_lane_free:
        # Out before the car, back behind it; where the gap is too short for that, stop.
        out, back = rear - 1.0, rear + size[0] + 6.0
        if out - EGO_STATION >= 14.0:
            around = own.shifted(EGO_STATION + 2.0, out, LANE_WIDTH)
            around = around.shifted(back, back + 30.0, -LANE_WIDTH)
            stage.ego = Follower(around, EGO_STATION, speed, speed_limit)
        end = EGO_STATION - 45.0
    else:
        end = EGO_STATION + AHEAD
    stage.followers += queue(
        rng, lane, 0.0, end, 15.0, speed=speed, desired_speed=0.9 * speed_limit
    )
    fill_oncoming(rng, stage, 1, 45.0, speed)
    roadside(rng, stage, path, 2, 1)
    return stage


def lane_ends(
    rng: np.random.Generator,
    *,
    length: float = 80.0,
    speed: float = 10.0,
    speed_limit: float = 13.4,
    spacing: float = 45.0,
    goal_side: str = "left",
) -> Stage:
    """The ego's lane ends; the goal lies on the lane beside it, in which traffic leaves gaps.

    Options: `length` in m from the ego's front bumper to the end of its lane; `spacing` in m
    between the vehicles of the goal lane; `goal_side` "left" or "right".

    Raises:
      ValueError: the lane ends within 20 m, or the side is unknown.
    """
    if length < 20.0:
        raise ValueError(f"length is {length} m; a lane change needs at least 20 m")
    if goal_side not in ("left", "right"):
        raise ValueError(f"goal_side is {goal_side!r}; it must be 'left' or 'right'")
    goal = 0 if goal_side == "left" else 1
    path = Path.from_curvature([(EGO_STATION + EGO_FRONT + length, 0.0), (500.0, 0.0)])
    end = EGO_STATION + EGO_FRONT + length
    builder = MapBuilder("synthetic")
    cuts = [(0.0, end), (end + 6.0, end + 200.0), (end + 206.0, path.length)]
    add_corridor(
        builder,
        "road",
        path,
        cuts,
        forward=[(0, 1), (goal,), (goal,)],
        speed_limit=speed_limit,
        connector_limit=speed_limit if rng.random() < 0.5 else None,
    )
    route = builder.follow(f"road:0/{goal}")
    lane = builder.path(route)
    sideways = LANE_WIDTH if goal == 0 else -LANE_WIDTH
    own = lane.parallel(-sideways)
    change = own.shifted(EGO_STATION + 2.0, EGO_STATION + min(length - 5.0, 60.0), sideways)
    # The route names blocks, and the ego's own lane shares its block with the goal lane.
    stage = Stage(builder, route, Follower(change, EGO_STATION, speed, speed_limit))
    first = EGO_STATION + EGO_FRONT / 2 + rng.uniform(0.45, 0.6) * spacing
    for i in range(-3, 5):
        station = first + i * spacing + rng.uniform(-0.05, 0.05) * spacing
        stage.followers.append(vehicle(rng, lane, station, speed, speed_limit))
    # Beyond the end, clear of the goal lane; the cones line the far edge and block nothing.
    for left in (-0.9, 0.9):
        stage.scripted.append(standing(own, end + 1.5, left, BARRIER, ObjectType.BARRIER))
    for k in range(4):
        edge = -np.sign(sideways) * (LANE_WIDTH / 2 - 0.2)
        cone = standing(own, end - 3.0 * k, edge, CONE, ObjectType.TRAFFIC_CONE)
        stage.scripted.append(cone)
    return stage


def jaywalker(
    rng: np.random.Generator,
    *,
    distance: float = 40.0,
    speed: float = 10.0,
    walk_speed: float = 1.4,
    speed_limit: float = 13.4,
) -> Stage:
    """A pedestrian crosses away from any crosswalk, timed to meet an ego that does not slow down.

    Options: `distance` in m from the ego's front bumper to the pedestrian's way at iteration 0.

    Raises:
      ValueError: a distance or speed is not positive.
    """
    if min(distance, speed, walk_speed) <= 0.0:
        raise ValueError(
            f"distance is {distance}, speed {speed}, walk_speed {walk_speed}; all must be positive"
        )
    segments = [(ROAD_LENGTH, 0.0)]
    builder, path = corridor(rng, segments, lanes=1, oncoming=1, speed_limit=speed_limit)
    stage = start_on(builder, 0, speed, speed_limit)
    station = EGO_STATION + EGO_FRONT + distance
    side = rng.choice([-1.0, 1.0])
    kerb = LANE_WIDTH + MARGIN + 1.0
    ends = path.offset(np.array([station, station]), side * np.array([kerb, -kerb]))
    to_ego = abs(side * kerb + LANE_WIDTH / 2)
    begin = distance / speed - to_ego / walk_speed
    stage.scripted.append(walk(ends[0], ends[1], walk_speed, begin))
    # Oncoming drivers must not be where only luck would spare the pedestrian.
    duration = 2.0 * kerb / walk_speed
    there = path.length - station - 1.3 * speed * (begin + duration + 3.0)
    fill_oncoming(rng, stage, 1, 70.0, speed, (there, path.length - station + 10.0))
    roadside(rng, stage, path, 1, 1)
    return stage


def oncoming(
    rng: np.random.Generator,
    *,
    speed: float = 10.0,
    speed_limit: float = 13.4,
    spacing: float = 30.0,
    bicycle_gap: float = 20.0,
) -> Stage:
    """A bicycle slows the ego down on a road with one lane per direction and oncoming traffic.

    Options: `bicycle_gap` in m from the ego's front bumper to the bicycle at iteration 0.

    Raises:
      ValueError: the gap is not positive.
    """
    if bicycle_gap <= 0.0:
        raise ValueError(f"bicycle_gap is {bicycle_gap} m; give a positive gap")
    bends = rng.uniform(-1.0, 1.0, 2) / 250.0
    segments = [(100.0, 0.0), (200.0, float(bends[0])), (330.0, float(bends[1]))]
    builder, path = corridor(rng, segments, lanes=1, oncoming=1, speed_limit=speed_limit)
    stage = start_on(builder, 0, speed, speed_limit)
    edge = stage.ego.path.parallel(-rng.uniform(0.3, 1.0))
    pace = min(rng.uniform(3.5, 5.5), speed)
    station = EGO_STATION + EGO_FRONT + bicycle_gap + BICYCLE[0] / 2
    bicycle = Follower(edge, station, pace, pace, BICYCLE, ObjectType.BICYCLE)
    stage.followers.append(bicycle)
    fill_oncoming(rng, stage, 1, spacing, speed)
    roadside(rng, stage, path, 1, 1)
    return stage


def platoon(
    rng: np.random.Generator,
    *,
    speed: float = 6.0,
    speed_limit: float = 13.4,
    spacing: float = 14.0,
) -> Stage:
    """Dense traffic on two lanes that a slow leader on each lane holds up."""
    segments = [(ROAD_LENGTH, 0.0)]
    builder, path = corridor(rng, segments, lanes=2, oncoming=1, speed_limit=speed_limit)
    stage = start_on(builder, int(rng.integers(2)), speed, speed_limit)
    fill_lanes(rng, stage, 2, 0, spacing, speed)
    for k in range(2):
        lane = builder.path(builder.follow(f"road:0/{k}"))
        station = EGO_STATION + AHEAD + 15.0
        pace = rng.uniform(0.3, 0.9) * speed
        stage.followers.append(vehicle(rng, lane, station, speed, pace))
    fill_oncoming(rng, stage, 1, 45.0, speed)
    roadside(rng, stage, path, 2, 1)
    return stage
