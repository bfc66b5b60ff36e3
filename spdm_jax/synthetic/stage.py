"""What scenes are made of: the stage (map, actors, lights) and small helpers that fill it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spdm_jax.config import DT
from spdm_jax.io.raw import RawArea
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import LANE_WIDTH, MARGIN, MapBuilder, add_corridor, strip
from spdm_jax.synthetic.traffic import MAX_STEPS, NUM_HISTORY, Follower, Scripted
from spdm_jax.types import LightStatus, ObjectType

EGO_STATION = 60.0
"""Where the ego's rear axle is on a corridor at iteration 0, m from its beginning."""
PEDESTRIAN = (0.7, 0.7)
BICYCLE = (1.8, 0.7)
CONE = (0.4, 0.4)
BARRIER = (0.6, 1.6)


@dataclass
class Stage:
    """A scene before it is played.

    Attributes:
      builder: the map.
      route: lanes of the route, from the ego's block to the goal's.
      ego: what the recorded ego does (`station` is its rear axle's).
      followers: vehicles and bicycles.
      scripted: pedestrians and static objects.
      lights: connector -> `[T]` `LightStatus`.
    """

    builder: MapBuilder
    route: list[str]
    ego: Follower
    followers: list[Follower] = field(default_factory=list)
    scripted: list[Scripted] = field(default_factory=list)
    lights: dict[str, np.ndarray] = field(default_factory=dict)


def corridor(
    rng: np.random.Generator,
    segments: Sequence[tuple[float, float]],
    *,
    lanes: int,
    oncoming: int,
    speed_limit: float,
) -> tuple[MapBuilder, Path]:
    """Returns a road called "road" in three blocks, and its reference line."""
    path = Path.from_curvature(segments)
    inner = path.length * (np.array([1.0, 2.0]) / 3.0) + rng.uniform(-20.0, 20.0, 2)
    first, second = np.round(inner)
    cuts = [(0.0, first), (first + 6.0, second), (second + 6.0, path.length)]
    builder = MapBuilder("synthetic")
    add_corridor(
        builder,
        "road",
        path,
        cuts,
        forward=[range(lanes)] * 3,
        backward=oncoming,
        speed_limit=speed_limit,
        connector_limit=speed_limit if rng.random() < 0.5 else None,
    )
    half = (-lanes * LANE_WIDTH, oncoming * LANE_WIDTH)
    crossing = strip(path, first + 1.0, first + 5.0, half[0] - MARGIN, half[1] + MARGIN)
    builder.crosswalks.append(RawArea("road.crosswalk", crossing))
    return builder, path


def add_roadside(
    rng: np.random.Generator,
    builder: MapBuilder,
    path: Path,
    *,
    right: float,
    left: float,
    people: int = 4,
) -> list[Scripted]:
    """Adds pavements and a car park beside a corridor, and returns who and what is there.

    Args:
      rng: source of variety.
      builder: receives the areas.
      path: reference line of the corridor.
      right: offset of the right edge of the road's surface, m (negative).
      left: offset of the left edge, m.
      people: number of pedestrians.
    """
    begin = EGO_STATION + rng.uniform(20.0, 60.0)
    end = begin + 42.0
    builder.add_car_park("car-park", strip(path, begin, end, right - 6.0, right))
    pavements = {"left": (left + 1.0, left + 3.5), "right": (right - 9.5, right - 7.0)}
    for side, (inner, outer) in pavements.items():
        area = strip(path, 0.0, path.length, inner, outer)
        builder.walkways.append(RawArea(f"walkway-{side}", area))

    scripted = []
    for station in np.arange(begin + 4.0, end - 3.0, 7.0):
        if rng.random() < 0.7:
            size = (rng.uniform(4.2, 5.0), rng.uniform(1.8, 2.0))
            scripted.append(standing(path, station, right - 3.0, size, ObjectType.VEHICLE))
    for _ in range(people):
        inner, outer = pavements["left" if rng.random() < 0.5 else "right"]
        # A straight walk along a chord of the pavement, in either direction.
        ends = EGO_STATION + rng.uniform(0.0, 80.0) + np.array([0.0, 25.0])
        points = path.offset(ends, (inner + outer) / 2)
        if rng.random() < 0.5:
            points = points[::-1]
        speed = rng.uniform(0.8, 1.6)
        scripted.append(walk(points[0], points[1], speed, begin=-rng.uniform(0.0, 10.0)))
    objects = ((ObjectType.GENERIC_OBJECT, (0.4, 0.4)), (ObjectType.CZONE_SIGN, CONE))
    for i, (kind, size) in enumerate(objects):
        station = EGO_STATION + 10.0 + 40.0 * (i + rng.random())
        scripted.append(standing(path, station, left + 0.4, size, kind))
    return scripted


def standing(
    path: Path, station: float, left: float, size: tuple[float, float], kind: ObjectType
) -> Scripted:
    """Returns an object at rest beside a path, parallel to it."""
    x, y = path.offset(station, left)
    return Scripted((float(x), float(y), float(path.pose(station)[2])), size, kind)


def walk(start: np.ndarray, end: np.ndarray, speed: float, begin: float) -> Scripted:
    """Returns a pedestrian who walks from one point `[2]` to another from time `begin` on, s."""
    delta = end - start
    heading = float(np.arctan2(delta[1], delta[0]))
    return Scripted(
        start=(float(start[0]), float(start[1]), heading),
        size=PEDESTRIAN,
        type=ObjectType.PEDESTRIAN,
        speed=speed,
        begin=begin,
        distance=float(np.linalg.norm(delta)),
    )


def vehicle(
    rng: np.random.Generator,
    path: Path,
    station: float,
    speed: float,
    desired_speed: float,
    gates: tuple[tuple[float, str], ...] = (),
    give_way: float | None = None,
) -> Follower:
    """Returns a car (sometimes a lorry) on a path."""
    lorry = rng.random() < 0.1
    length = rng.uniform(7.0, 9.0) if lorry else rng.uniform(4.2, 5.2)
    width = rng.uniform(2.3, 2.5) if lorry else rng.uniform(1.8, 2.0)
    return Follower(
        path, station, speed, desired_speed, (length, width), gates=gates, give_way=give_way
    )


def queue(
    rng: np.random.Generator,
    path: Path,
    begin: float,
    end: float,
    spacing: float,
    *,
    speed: float,
    desired_speed: float,
    keep_clear: tuple[float, float] | None = None,
    gates: tuple[tuple[float, str], ...] = (),
    give_way: float | None = None,
) -> list[Follower]:
    """Returns vehicles at random distances along a path.

    Args:
      rng: source of variety.
      path: their track.
      begin: first station at iteration 0, m.
      end: last station, m.
      spacing: mean distance between centres, m; it varies by a quarter either way.
      speed: at iteration 0, m/s, the same for all, so that the past is free of collisions.
      desired_speed: mean of their desired speeds, m/s; it varies by a tenth.
      keep_clear: stretch (from, to) that no vehicle's centre may be on at iteration 0.
      gates: stop lines ahead.
      give_way: station of the line at which they give way.
    """
    vehicles = []
    station = begin + rng.uniform(0.0, 0.5) * spacing
    while station < end:
        if keep_clear is None or not keep_clear[0] < station < keep_clear[1]:
            wish = desired_speed * rng.uniform(0.9, 1.1)
            vehicles.append(vehicle(rng, path, station, speed, wish, gates, give_way))
        station += spacing * rng.uniform(0.75, 1.25)
    return vehicles


def gates_of(
    builder: MapBuilder, path: Path, lanes: Sequence[str], lights: dict[str, np.ndarray]
) -> tuple[tuple[float, str], ...]:
    """Returns the stop lines on a path: 1 m before each connector that has a light."""
    return tuple(
        (path.station_of(builder.lanes[lane].centerline[0, :2]) - 1.0, lane)
        for lane in lanes
        if lane in lights
    )


def light_phases(phases: Sequence[tuple[float, LightStatus]]) -> np.ndarray:
    """Returns `[MAX_STEPS]` statuses from pairs in order: start, s after iteration 0, and status.

    The first status also holds before its start.
    """
    time = (np.arange(MAX_STEPS) - NUM_HISTORY) * DT
    row = np.searchsorted([start for start, _ in phases[1:]], time + 1e-9, side="right")
    return np.array([status for _, status in phases], dtype=np.int8)[row]
