"""Named scenes at crossings of four arms."""

import dataclasses

import numpy as np
import shapely

from spdm_jax.io.raw import RawArea
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import (
    LANE_WIDTH,
    MARGIN,
    MapBuilder,
    add_corridor,
    add_crossing,
    strip,
)
from spdm_jax.synthetic.stage import Stage, gates_of, light_phases, queue, vehicle, walk
from spdm_jax.synthetic.traffic import EGO_FRONT, Follower
from spdm_jax.types import LightStatus

ARMS = ("east", "north", "west", "south")
"""Names of the arms, counter-clockwise; the ego comes from the south."""
TURNS = {"left": "west", "straight": "north", "right": "east"}
YELLOW_TIME = 3.0  # s
ALL_RED_TIME = 1.0  # s


def intersection(
    rng: np.random.Generator,
    *,
    turn: str | None = None,
    distance: float = 45.0,
    speed: float = 9.0,
    speed_limit: float = 13.4,
    spacing: float = 60.0,
) -> Stage:
    """A crossing without lights, with traffic from all sides.

    Options: `turn` "left", "straight" or "right" (drawn if None); `distance` in m from the ego's
    front bumper to the crossing at iteration 0.

    Raises:
      ValueError: an unknown turn, or a distance outside 2 ... 150 m.
    """
    turn = turn or str(rng.choice(list(TURNS)))
    builder, arms = four_arms(rng, lanes=2, radius=17.0, speed_limit=speed_limit, light=False)
    connector = f"south>{target_arm(turn)}/{0 if turn == 'left' else 1}"
    stage = approach(builder, [connector], distance, speed, speed_limit)
    line = stage.ego.station + EGO_FRONT + distance - 1.0
    # Traffic from the north goes before a left turn.
    stage.ego = dataclasses.replace(stage.ego, give_way=line, rank=2)
    _cross_traffic(rng, stage, 2, spacing, speed, speed_limit)
    pavement_walks(rng, stage, arms, 2)
    return stage


def red_light(
    rng: np.random.Generator,
    *,
    distance: float = 50.0,
    speed: float = 10.0,
    speed_limit: float = 13.4,
    green_after: float = 9.0,
    queued: int | None = None,
) -> Stage:
    """A crossing whose lights are red for the ego at first, with cross traffic meanwhile.

    Options: `distance` in m from the ego's front bumper to the crossing; `green_after` in s after
    iteration 0; `queued` vehicles waiting at the line (drawn from 0 to 2 if None).

    Raises:
      ValueError: the distance is outside 2 ... 150 m, or too short for the queue.
    """
    count = int(rng.integers(3)) if queued is None else queued
    if distance < 10.0 * count + 5.0:
        raise ValueError(
            f"distance is {distance} m and queued {count}; a queue needs 10 m per vehicle and 5 m "
            "more, raise distance or lower queued"
        )
    builder, arms = four_arms(rng, lanes=2, radius=17.0, speed_limit=speed_limit, light=True)
    change = green_after - YELLOW_TIME - ALL_RED_TIME
    own = light_phases([(-100.0, LightStatus.RED), (green_after, LightStatus.GREEN)])
    cross = light_phases(
        [
            (-100.0, LightStatus.GREEN),
            (change, LightStatus.YELLOW),
            (change + YELLOW_TIME, LightStatus.RED),
        ]
    )
    lights = {
        lane.id: own if lane.roadblock.split(">")[0] in ("north", "south") else cross
        for lane in builder.lanes.values()
        if lane.has_traffic_light
    }
    stage = approach(builder, ["south>north/1"], distance, speed, speed_limit, lights)
    front = stage.ego.station + EGO_FRONT + distance
    for i in range(count):
        station = front - 7.0 - 9.5 * i
        stage.followers.append(
            vehicle(rng, stage.ego.path, station, 0.0, speed_limit, stage.ego.gates)
        )
    _cross_traffic(rng, stage, 2, 30.0, speed, speed_limit)
    pavement_walks(rng, stage, arms, 2)
    return stage


def tight_turn(
    rng: np.random.Generator,
    *,
    turn: str = "right",
    distance: float = 25.0,
    speed: float = 7.0,
    speed_limit: float = 8.3,
) -> Stage:
    """A turn at a narrow crossing, with a pedestrian on the crosswalk behind it.

    Options: `turn` "left", "straight" or "right"; `distance` in m from the ego's front bumper to
    the crossing.

    Raises:
      ValueError: an unknown turn, or a distance outside 2 ... 150 m.
    """
    builder, arms = four_arms(rng, lanes=1, radius=10.5, speed_limit=speed_limit, light=False)
    target = target_arm(turn)
    stage = approach(builder, [f"south>{target}/0"], distance, speed, speed_limit)
    area = next(a for a in builder.crosswalks if a.id == f"{target}.crosswalk").polygon
    corners = shapely.get_coordinates(area)
    # Corner order of a strip: left begin ... left end, right end ... right begin, and closed.
    half = (len(corners) - 1) // 2
    left, right = corners[:half].mean(axis=0), corners[half:-1].mean(axis=0)
    beyond = 3.0 * (left - right) / np.linalg.norm(left - right)
    ends = left + beyond, right - beyond
    if rng.random() < 0.5:
        ends = ends[::-1]
    stage.scripted.append(walk(ends[0], ends[1], rng.uniform(1.0, 1.5), rng.uniform(0.0, 4.0)))
    pavement_walks(rng, stage, arms, 1)
    return stage


def four_arms(
    rng: np.random.Generator, *, lanes: int, radius: float, speed_limit: float, light: bool
) -> tuple[MapBuilder, dict[str, Path]]:
    """Returns four arms of two blocks each around a crossing at the origin, and their paths."""
    builder = MapBuilder("synthetic")
    arms = add_arms(rng, builder, lanes=lanes, radius=radius, speed_limit=speed_limit)
    add_crossing(builder, "crossing", arms, lanes=lanes, num_blocks=2, light=light)
    return builder, arms


def add_arms(
    rng: np.random.Generator,
    builder: MapBuilder,
    *,
    lanes: int,
    radius: float,
    speed_limit: float,
) -> dict[str, Path]:
    """Adds four arms of two blocks each that begin `radius` m from the origin.

    Returns:
      Their outward paths by name, counter-clockwise.
    """
    arms: dict[str, Path] = {}
    for i, arm in enumerate(ARMS):
        angle = i * np.pi / 2 + rng.uniform(-0.08, 0.08)
        start = (radius * np.cos(angle), radius * np.sin(angle), angle)
        bend = rng.uniform(-1.0, 1.0) / 200.0
        arms[arm] = Path.from_curvature([(60.0, 0.0), (260.0, bend)], start)
        add_corridor(
            builder,
            arm,
            arms[arm],
            [(0.0, 130.0), (136.0, 320.0)],
            forward=[range(lanes)] * 2,
            backward=lanes,
            speed_limit=speed_limit,
            connector_limit=speed_limit,
        )
    return arms


def target_arm(turn: str) -> str:
    """Returns the arm that a turn of the ego leads to.

    Raises:
      ValueError: an unknown turn.
    """
    if turn not in TURNS:
        raise ValueError(f"turn is {turn!r}; it must be one of {sorted(TURNS)}")
    return TURNS[turn]


def approach(
    builder: MapBuilder,
    connectors: list[str],
    distance: float,
    speed: float,
    speed_limit: float,
    lights: dict[str, np.ndarray] | None = None,
) -> Stage:
    """Returns a stage with the ego on the southern arm.

    Args:
      builder: the map.
      connectors: the ego's connectors where lanes fork, the first leads out of the arm.
      distance: from the ego's front bumper to that connector, m.
      speed: at iteration 0, m/s.
      speed_limit: which the ego would like to drive, m/s.
      lights: see `Stage`.

    Raises:
      ValueError: the distance is outside 2 ... 150 m.
    """
    if not 2.0 <= distance <= 150.0:
        raise ValueError(f"distance is {distance} m; it must be within 2 ... 150 m")
    number = builder.lanes[connectors[0]].predecessors[0].rpartition("/")[2]
    whole = builder.follow(f"south~:0/{number}", connectors)
    path = builder.path(whole)
    starts = [path.station_of(builder.lanes[i].centerline[0, :2]) for i in whole]
    station = starts[whole.index(connectors[0])] - distance - EGO_FRONT
    # The route starts in the ego's own block.
    first = int(np.searchsorted(starts, station, side="right")) - 1
    lights = lights or {}
    gates = gates_of(builder, path, whole, lights)
    ego = Follower(path, station, speed, speed_limit, gates=gates)
    return Stage(builder, whole[first:], ego, lights=lights)


def _cross_traffic(
    rng: np.random.Generator,
    stage: Stage,
    lanes: int,
    spacing: float,
    speed: float,
    speed_limit: float,
) -> None:
    """Puts vehicles on the other arms that drive straight across or away, and behind the ego."""
    builder = stage.builder
    for source, target in (("east", "west"), ("west", "east"), ("north", "south")):
        for k in range(lanes):
            whole = builder.follow(f"{source}~:0/{k}", [f"{source}>{target}/{k}"])
            path = builder.path(whole)
            end = path.station_of(builder.lanes[f"{source}>{target}/{k}"].centerline[0, :2])
            gates = gates_of(builder, path, whole, stage.lights)
            # East to west has priority where there are no lights.
            minor = source == "north" and not stage.lights
            stage.followers += queue(
                rng,
                path,
                end - (160.0 if stage.lights else 110.0),
                end - (35.0 if minor else 8.0),
                spacing,
                speed=0.0 if stage.lights and source == "north" else speed,
                desired_speed=(0.9 if stage.lights or minor else 0.75) * speed_limit,
                gates=gates,
                give_way=end - 1.0 if minor else None,
            )
    ego = stage.ego
    behind = ego.station - rng.uniform(18.0, 30.0)
    stage.followers.append(
        vehicle(rng, ego.path, behind, ego.speed, speed_limit, ego.gates, ego.give_way)
    )


def pavement_walks(
    rng: np.random.Generator, stage: Stage, arms: dict[str, Path], lanes: int
) -> None:
    """Adds pavements beside the arms and a pedestrian on each arm's."""
    edge = lanes * LANE_WIDTH + MARGIN
    for arm, path in arms.items():
        for side, (right, left) in {
            "left": (edge + 1.0, edge + 3.5),
            "right": (-edge - 3.5, -edge - 1.0),
        }.items():
            area = strip(path, 8.0, path.length, right, left)
            stage.builder.walkways.append(RawArea(f"{arm}.walkway-{side}", area))
        begin = rng.uniform(10.0, 30.0)
        stations = begin + np.array([0.0, rng.uniform(15.0, 25.0)])
        ends = path.offset(stations, rng.choice([-1.0, 1.0]) * (edge + 2.25))
        if rng.random() < 0.5:
            ends = ends[::-1]
        stage.scripted.append(walk(ends[0], ends[1], rng.uniform(0.8, 1.5), -rng.uniform(0.0, 5.0)))
