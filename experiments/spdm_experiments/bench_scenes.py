"""Scenes of the benchmark: a crowded crossing with exact counts, and a mix of the built-in ones."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spdm_jax.io.pack import pack
from spdm_jax.io.raw import RawArea, RawScenario, ScenarioError
from spdm_jax.io.scenario_file import read_scenario, write_scenario
from spdm_jax.synthetic import SyntheticReader
from spdm_jax.synthetic.generator import play
from spdm_jax.synthetic.junctions import add_arms, approach
from spdm_jax.synthetic.paths import Path as Curve
from spdm_jax.synthetic.roads import (
    LANE_WIDTH,
    MARGIN,
    MapBuilder,
    add_corridor,
    add_crossing,
    strip,
)
from spdm_jax.synthetic.stage import (
    BICYCLE,
    CONE,
    Stage,
    gates_of,
    light_phases,
    queue,
    standing,
    walk,
)
from spdm_jax.synthetic.traffic import EGO, EGO_FRONT, Follower, Scripted
from spdm_jax.types import LightStatus, ObjectType, ScenarioBatch

SUITE = "crowded_crossing"
NUM_OBJECTS = 64
"""Objects of the crossing, all of them within reach of the ego at iteration 0."""
NUM_POLYGONS = 90
"""Drivable polygons around the route: 80 lanes and connectors, 4 intersections, 6 car parks."""
REACH = 49.0
"""Distance from the ego's centre within which all objects are, m; planners look 50 m far."""
MIXED = (
    "platoon",
    "straight",
    "parked_car",
    "curve",
    "open_road",
    "jaywalker",
    "lane_ends",
    "oncoming",
)
"""Built-in scenes of the mixed batch, each with several seeds; they share one padding."""

SPEED, SPEED_LIMIT = 6.0, 13.4  # m/s
_LANES, _RADIUS = 3, 20.0
_SERVICE_LANES = 2
_TO_CROSSING = 25.0  # m from the ego's front bumper
_SPACING = 18.0  # m between moving vehicles
_EDGE = _LANES * LANE_WIDTH + MARGIN
_PAVEMENT = (_EDGE + 1.0, _EDGE + 3.5)
_CAR_PARK = (_EDGE + 4.5, _EDGE + 10.0)
_PITCH = 2.8  # m between parked cars
_STRETCHES = ((4.0, 26.0), (28.0, 50.0), (52.0, 74.0))  # car parks along the arm, m
_SERVICE_ROAD = _CAR_PARK[1] + 12.0  # m beside the ego's arm
_PEDESTRIANS, _BICYCLES, _CONES = 14, 2, 4


def crowded_crossing(seed: int) -> RawScenario:
    """Returns a crossing of four arms with lights: green for the ego in dense, slow traffic.

    `NUM_OBJECTS` objects (moving, waiting and parked vehicles, pedestrians, bicycles, cones) are
    within `REACH` of the ego's centre at iteration 0, and there are no others. What a scenario file
    keeps of the map has `NUM_POLYGONS` drivable polygons.

    Args:
      seed: varies geometry, places, sizes and speeds.
    """
    return play(SUITE, seed, _stage)


def _stage(rng: np.random.Generator) -> Stage:
    builder = MapBuilder("synthetic")
    arms = add_arms(rng, builder, lanes=_LANES, radius=_RADIUS, speed_limit=SPEED_LIMIT)
    add_crossing(builder, "crossing", arms, lanes=_LANES, num_blocks=2, light=True)
    south = arms["south"]
    spots = _surroundings(builder, south)
    go, stop = (light_phases([(-100.0, status)]) for status in (LightStatus.GREEN, LightStatus.RED))
    lights = {
        lane.id: go if lane.roadblock.split(">")[0] in ("north", "south") else stop
        for lane in builder.lanes.values()
        if lane.has_traffic_light
    }
    own = int(rng.integers(_LANES))
    connector = f"south>north/{own}"
    stage = approach(builder, [connector], _TO_CROSSING, SPEED, SPEED_LIMIT, lights)
    ego = stage.ego.path.pose(stage.ego.station)
    center = ego[:2] + float(EGO.rear_axle_to_center) * np.array([np.cos(ego[2]), np.sin(ego[2])])

    def near(point: np.ndarray) -> bool:
        return bool(np.hypot(*(np.asarray(point)[:2] - center)) < REACH)

    vehicles = [*_along(rng, stage, own), *_waiting(rng, stage)]
    stage.followers = [v for v in vehicles if near(v.path.pose(v.station))]
    stage.scripted = _people_and_cones(rng, south)
    free = NUM_OBJECTS - len(stage.followers) - len(stage.scripted)
    spots = sorted(spots, key=lambda spot: np.hypot(*(spot[:2] - center)))
    taken = rng.permutation(np.array([spot for spot in spots if near(spot)]))[: max(free, 0)]
    if len(taken) != free:
        raise ScenarioError(f"{free} parked cars wanted, there are {len(spots)} places in reach")
    for x, y, heading in taken:
        size = (float(rng.uniform(4.2, 5.0)), float(rng.uniform(1.8, 2.0)))
        stage.scripted.append(Scripted((x, y, heading), size, ObjectType.VEHICLE))
    return stage


def _surroundings(builder: MapBuilder, south: Curve) -> list[np.ndarray]:
    """Adds pavements, car parks and a service road beside an arm; returns poses of parked cars."""
    spots = []
    for side, name in ((1.0, "left"), (-1.0, "right")):
        right, left = sorted(side * edge for edge in _PAVEMENT)
        pavement = strip(south, 8.0, south.length, right, left)
        builder.walkways.append(RawArea(f"walkway-{name}", pavement))
        right, left = sorted(side * edge for edge in _CAR_PARK)
        for k, (begin, end) in enumerate(_STRETCHES):
            builder.add_car_park(f"car-park-{name}-{k}", strip(south, begin, end, right, left))
            for station in np.arange(begin + 1.6, end - 1.5, _PITCH):
                heading = south.pose(station)[2] + np.pi / 2
                spots.append(np.append(south.offset(station, (right + left) / 2), heading))
    service = south.parallel(_SERVICE_ROAD)
    add_corridor(
        builder,
        "service",
        service,
        [(20.0, 130.0), (136.0, service.length)],
        forward=[range(_SERVICE_LANES)] * 2,
        backward=_SERVICE_LANES,
        speed_limit=8.3,
        connector_limit=8.3,
    )
    return spots


def _along(rng: np.random.Generator, stage: Stage, own: int) -> list[Follower]:
    """Returns the traffic of the ego's road, in both directions."""
    builder, vehicles = stage.builder, []
    at = stage.ego.station + float(EGO.rear_axle_to_center)
    for k in range(_LANES):
        for source, target in (("south", "north"), ("north", "south")):
            lanes = builder.follow(f"{source}~:0/{k}", [f"{source}>{target}/{k}"])
            path = builder.path(lanes)
            beside = at
            if source == "north":
                begin = path.station_of(builder.lanes[f"south:0/{k}"].centerline[0, :2])
                beside = begin + _TO_CROSSING + EGO_FRONT
            vehicles += queue(
                rng,
                path,
                beside - REACH - _SPACING,
                beside + REACH + _SPACING,
                _SPACING,
                speed=SPEED,
                desired_speed=0.8 * SPEED_LIMIT,
                keep_clear=(at - 10.0, at + 12.0) if (source, k) == ("south", own) else None,
                gates=gates_of(builder, path, lanes, stage.lights),
            )
    return vehicles


def _waiting(rng: np.random.Generator, stage: Stage) -> list[Follower]:
    """Returns the vehicles that wait at the red lights of the crossing road."""
    builder, vehicles = stage.builder, []
    for source, target in (("east", "west"), ("west", "east")):
        for k in range(_LANES):
            lanes = builder.follow(f"{source}~:0/{k}", [f"{source}>{target}/{k}"])
            path = builder.path(lanes)
            gates = gates_of(builder, path, lanes, stage.lights)
            line = path.station_of(builder.lanes[f"{source}>{target}/{k}"].centerline[0, :2])
            vehicles += queue(
                rng,
                path,
                line - 40.0,
                line - 7.0,
                8.5,
                speed=0.0,
                desired_speed=SPEED_LIMIT,
                gates=gates,
            )
    return vehicles


def _people_and_cones(rng: np.random.Generator, south: Curve) -> list[Scripted]:
    """Returns pedestrians and bicycles on the pavements, and cones at the edge of the road."""
    found = []
    places = np.linspace(12.0, 64.0, _PEDESTRIANS + _BICYCLES) + rng.uniform(-1.0, 1.0)
    for i, station in enumerate(places):
        left = rng.choice([-1.0, 1.0]) * rng.uniform(_PAVEMENT[0] + 0.5, _PAVEMENT[1] - 0.5)
        # Under way since before the recording, and until its end: all of them move.
        ways = np.array([-1.0, 1.0]) * rng.choice([-1.0, 1.0])
        start, end = south.offset(station + 2.0 * ways, left)
        someone = walk(start, end, float(rng.uniform(0.8, 1.6)), begin=-0.5)
        if i < _BICYCLES:
            someone = dataclasses.replace(someone, size=BICYCLE, type=ObjectType.BICYCLE)
        found.append(someone)
    for station in np.linspace(40.0, 52.0, _CONES):
        found.append(standing(south, station, -_EDGE + 0.3, CONE, ObjectType.TRAFFIC_CONE))
    return found


def check_counts(batch: ScenarioBatch) -> dict[str, int]:
    """Counts what the crossings of a batch hold at iteration 0.

    Args:
      batch: NumPy leaves `[B, ...]`.

    Returns:
      Objects, drivable polygons and polygon edges of the first scene.

    Raises:
      RuntimeError: a scene has other counts than `NUM_OBJECTS` and `NUM_POLYGONS`.
    """
    now, rows = np.asarray(batch.num_history), np.arange(len(batch.num_history))
    tracks, ego, layers = batch.tracks, batch.ego, batch.map
    offset = float(EGO.rear_axle_to_center)
    heading = ego.heading[rows, now]
    x = ego.x[rows, now] + offset * np.cos(heading)
    y = ego.y[rows, now] + offset * np.sin(heading)
    distance = np.hypot(
        tracks.x[rows, :, now] - x[:, None],
        tracks.y[rows, :, now] - y[:, None],
    )
    present = tracks.valid[rows, :, now]
    objects = (present & (distance < REACH + 1.0)).sum(1)
    areas = (layers.lanes.polygon, layers.intersections, layers.car_parks)
    edges = [np.asarray(area.count) for area in areas]
    polygons = np.sum([(count > 0).sum(1) for count in edges], axis=0)
    for name, found, wanted in (
        ("objects", objects, NUM_OBJECTS),
        ("objects anywhere", present.sum(1), NUM_OBJECTS),
        ("drivable polygons", polygons, NUM_POLYGONS),
    ):
        if (found != wanted).any():
            raise RuntimeError(f"{name} of the crossings: {found.tolist()}, {wanted} wanted")
    first = sum(int(count[0].sum()) for count in edges)
    return {"objects": NUM_OBJECTS, "polygons": NUM_POLYGONS, "edges": first}


class Crossings:
    """Offers crossings as a data set."""

    def __init__(self, count: int):
        """Selects the seeds 0 ... count - 1."""
        self._seeds = {f"{SUITE}-{seed}": seed for seed in range(count)}

    def tokens(self) -> Sequence[str]:
        """Returns the tokens, "crowded_crossing-SEED"."""
        return tuple(self._seeds)

    def read(self, token: str) -> RawScenario:
        """Returns one crossing."""
        return crowded_crossing(self._seeds[token])


def pack_scenes(folder: Path, crossings: int, mixed: int, copies: int) -> None:
    """Packs the scenes of a run; files that are there already are kept.

    Args:
      folder: gets `crossings`, `mixed` and `many`.
      crossings: how many crossings.
      mixed: how many built-in scenes.
      copies: `many` holds every crossing so many times, under tokens of their own.
    """
    for name in ("crossings", "mixed", "many"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    seeds = range(-(-mixed // len(MIXED)))
    sources = {
        "crossings": Crossings(crossings),
        "mixed": SyntheticReader(MIXED[: min(mixed, len(MIXED))], seeds),
    }
    for name, reader in sources.items():
        report = pack(reader, folder / name)
        if report.failed:
            raise ScenarioError(f"{name}: {report.failed}")
    for path in scene_files(folder, "crossings"):
        read = functools.cache(lambda path=path: read_scenario(path))
        for copy in range(copies):
            token = f"{path.stem}-{copy}"
            target = folder / "many" / f"{token}.npz"
            if not target.exists():
                scenario, info = read()
                write_scenario(target, scenario, dataclasses.replace(info, token=token))


def scene_files(folder: Path, name: str) -> list[Path]:
    """Returns the packed files of a kind, by seed: the first is that of seed 0."""
    files = (folder / name).glob("*.npz")
    return sorted(files, key=lambda path: (int(path.stem.rpartition("-")[2]), path.stem))
