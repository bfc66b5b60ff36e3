"""What the scenes of the suites share: the expert, crossings with lights, queues before them."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from spdm_jax.synthetic.junctions import ALL_RED_TIME, YELLOW_TIME
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import MapBuilder
from spdm_jax.synthetic.stage import Stage, gates_of, light_phases, queue, vehicle
from spdm_jax.synthetic.traffic import EGO, EGO_FRONT, Follower
from spdm_jax.types import LightStatus

EXPERT_JERK = 2.5
"""Bound on the change of the expert's acceleration, m/s^3."""
EXPERT_PACE = 0.93
"""What the expert would like to drive, as a part of the speed limit."""
STEERING_REACH = 1.5
"""Averaging of the expert's path, m: nobody turns the wheel in no time."""
EGO_REAR = float(EGO.length) - EGO_FRONT
"""Distance from the ego's rear axle to its rear bumper, m."""
LONG_AGO = -100.0
"""Start of a phase that began before the record, s."""

Phases = Sequence[tuple[float, LightStatus]]


def expert(ego: Follower, path: Path | None = None) -> Follower:
    """Returns an ego that drives comfortably, on its own path or on one that deviates from it."""
    smooth = (path or ego.path).smoothed(STEERING_REACH)

    def moved(station: float) -> float:
        return smooth.station_of(ego.path.pose(station)[:2])

    return dataclasses.replace(
        ego,
        path=smooth,
        station=moved(ego.station),
        gates=tuple((moved(station), lane) for station, lane in ego.gates),
        jerk_limit=EXPERT_JERK,
    )


def green_between(begin: float, end: float) -> Phases:
    """Returns the phases of a light that is green between two times, s, and yellow at the end."""
    return [
        (LONG_AGO, LightStatus.RED),
        (begin, LightStatus.GREEN),
        (end - YELLOW_TIME, LightStatus.YELLOW),
        (end, LightStatus.RED),
    ]


def around_green(begin: float, end: float) -> Phases:
    """Returns the phases of the lights across one that is `green_between` the same times."""
    return [
        (LONG_AGO, LightStatus.GREEN),
        (begin - ALL_RED_TIME - YELLOW_TIME, LightStatus.YELLOW),
        (begin - ALL_RED_TIME, LightStatus.RED),
        (end + ALL_RED_TIME, LightStatus.GREEN),
    ]


def signals(builder: MapBuilder, phases: Mapping[str, Phases]) -> dict[str, np.ndarray]:
    """Returns the statuses of all connectors with a light, by the arm that they come from."""
    by_arm = {arm: light_phases(p) for arm, p in phases.items()}
    return {
        lane.id: by_arm[lane.roadblock.split(">")[0]]
        for lane in builder.lanes.values()
        if lane.has_traffic_light
    }


def arm_path(
    stage: Stage, source: str, target: str, lane: int
) -> tuple[Path, float, tuple[tuple[float, str], ...]]:
    """Returns the way of the traffic from one arm to another.

    Returns:
      Its path, the station of the line before the crossing, m, and its gates.
    """
    connector = f"{source}>{target}/{lane}"
    lanes = stage.builder.follow(f"{source}~:0/{lane}", [connector])
    path = stage.builder.path(lanes)
    line = path.station_of(stage.builder.lanes[connector].centerline[0, :2]) - 1.0
    return path, line, gates_of(stage.builder, path, lanes, stage.lights)


def waiting(
    rng: np.random.Generator, stage: Stage, source: str, target: str, lane: int, count: int
) -> float:
    """Adds `count` vehicles that stand before the light of an arm at iteration 0.

    Returns:
      Where the front of one more vehicle would stand, m along their path.
    """
    path, line, gates = arm_path(stage, source, target, lane)
    front = line - rng.uniform(1.8, 2.1)
    for _ in range(count):
        wish = stage.ego.desired_speed * rng.uniform(0.85, 1.0)
        new = vehicle(rng, path, 0.0, 0.0, wish, gates)
        stage.followers.append(dataclasses.replace(new, station=front - new.size[0] / 2))
        front -= new.size[0] + rng.uniform(1.8, 2.1)
    return front


def lead(
    rng: np.random.Generator,
    stage: Stage,
    gap: float,
    speed: float,
    desired_speed: float,
    size: tuple[float, float] | None = None,
) -> None:
    """Adds a vehicle on the ego's path, its rear `gap` m before the ego's front bumper."""
    ego = stage.ego
    size = size or (float(rng.uniform(4.3, 5.0)), float(rng.uniform(1.8, 2.0)))
    station = ego.station + EGO_FRONT + gap + size[0] / 2
    stage.followers.append(Follower(ego.path, station, speed, desired_speed, size, gates=ego.gates))


def tail(rng: np.random.Generator, stage: Stage, gap: float) -> None:
    """Adds a vehicle on the ego's path whose front is `gap` m behind the ego's rear bumper."""
    ego = stage.ego
    new = vehicle(rng, ego.path, 0.0, ego.speed, ego.desired_speed, ego.gates)
    station = ego.station - EGO_REAR - gap - new.size[0] / 2
    stage.followers.append(dataclasses.replace(new, station=station))


def flowing(
    rng: np.random.Generator,
    stage: Stage,
    source: str,
    target: str,
    lane: int,
    *,
    spacing: float,
    speed: float,
    before: float = 30.0,
) -> None:
    """Adds vehicles that approach the crossing from an arm, the first `before` m from the line."""
    path, line, gates = arm_path(stage, source, target, lane)
    wish = 0.9 * stage.ego.desired_speed
    stage.followers += queue(
        rng,
        path,
        line - 150.0,
        line - before,
        spacing,
        speed=speed,
        desired_speed=wish,
        gates=gates,
    )


def leaving(
    rng: np.random.Generator, stage: Stage, arm: str, lane: int, *, spacing: float, speed: float
) -> None:
    """Adds vehicles that drive away from the crossing on an arm."""
    path = stage.builder.path(stage.builder.follow(f"{arm}:0/{lane}"))
    wish = 0.9 * stage.ego.desired_speed
    stage.followers += queue(rng, path, 25.0, 110.0, spacing, speed=speed, desired_speed=wish)
