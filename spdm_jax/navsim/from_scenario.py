"""NAVSIM's frames from our own scenarios: iteration 0 of each, with the record around it (host)."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax import planner as planning
from spdm_jax.batching import BatchConfig, Precision, SceneRunner
from spdm_jax.config import PlannerConfig, PlannerParams, ScoringParams, VehicleParams
from spdm_jax.io.flatten import split_geometries, split_rings
from spdm_jax.navsim import layers
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.frames import FIRST, SECOND, NavsimInfo, NavsimSet
from spdm_jax.navsim.reader import expect_plan
from spdm_jax.navsim.types import NUM_FRAMES, NUM_POSES, NavsimScene
from spdm_jax.results import Failure, ScenarioSet
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import Array, LightStatus, ObjectType, Polygons, Scenario, ScenarioInfo

MAP_RADIUS = 100.0
"""Half side of the square around the ego whose map objects count, m (NAVSIM)."""
STEPS_PER_FRAME = 5
PAST_FRAMES = 3
"""Frames of recorded past besides the current one (NAVSIM v2)."""
_UNMEASURED = ("steering", "steering_rate", "yaw_rate", "yaw_acceleration")
"""What NAVSIM's logs do not hold: it scores with zeros."""


class Way(NamedTuple):
    """What PDM-Closed makes of a scenario.

    Attributes:
      centerline: `[M, 3]` x, y, heading.
      points: `[]` int32, real points of it.
      reference: `[41, 3]` the proposal it would drive, no emergency brake.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    centerline: Array
    points: Array
    reference: Array
    overflow: Array


def plan_way(scene: Scenario, _: None, params: PlannerParams, config: PlannerConfig) -> Way:
    """Plans at iteration 0 from what NAVSIM knows of the ego (pure).

    Source: NAVSIM `MetricCacheProcessor`.
    """
    unmeasured = {name: jnp.zeros_like(scene.ego.x) for name in _UNMEASURED}
    scene = scene.replace(ego=scene.ego.replace(**unmeasured))
    center = jax.tree.map(lambda v: v[0], planning.init(scene, params, config).paths)
    result = planning.plan(scene, params, config)
    pose = (result.proposals.x, result.proposals.y, result.proposals.heading)
    return Way(
        jnp.stack([center.x, center.y, center.heading], axis=-1),
        center.count,
        jnp.stack([values[result.best] for values in pose], axis=-1),
        result.overflow,
    )


def from_scenarios(
    scenes: ScenarioSet,
    config: PlannerConfig,
    *,
    precision: Precision = "f32",
    batching: BatchConfig | None = None,
) -> NavsimSet:
    """Makes a frame of iteration 0 of every scenario.

    The reference is PDM-Closed's with NAVSIM's settings (100 m of map, no brake), chosen by the
    rules of "tuplan" with NAVSIM's threshold for progress.

    Args:
      scenes: scenarios.
      config: of the planner, with room for the longest path of the set.
      precision: of the planner.
      batching: how scenes are spread over cores and devices.

    Returns:
      `NavsimSet`; scenarios that lack something are listed in its `failures`.

    Raises:
      ValueError: no scenario can be used.
    """
    scoring = ScoringParams(progress_threshold=5.0)
    params = PlannerParams(map_radius=MAP_RADIUS, scoring=scoring)
    run = SceneRunner(plan_way, config, precision=precision, config=batching)
    ways = run(scenes.batch, None, params)
    found = NavsimSet([], [], list(scenes.failures))
    for row, info in enumerate(scenes.infos):
        scene, way = (jax.tree.map(lambda v, i=row: v[i], tree) for tree in (scenes.batch, ways))
        try:
            if way.overflow:
                raise ValueError("more path points or red lights than PDM-Closed has room for")
            arrays, profiles = scenario_arrays(scene, info, way)
            frame = from_arrays(arrays, name=info.token)
        except ValueError as error:
            found.failures.append(Failure(info.token, str(error)))
            continue
        found.frames.append(frame)
        found.infos.append(NavsimInfo(info.token, info.log_name, info.source, profiles))
    if not found.infos:
        raise ValueError(f"no usable scenario: {found.failures[0].reason}")
    return found


def scenario_arrays(
    scene: Scenario, info: ScenarioInfo, way: Way
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Returns the arrays of an exported frame, in map coordinates, and the profiles they serve.

    Args:
      scene: one scenario on the host, padded or not.
      info: its description.
      way: what PDM-Closed makes of it, on the host.

    Raises:
      ValueError: the scenario records too little, or its map is of no use.
    """
    now, vehicle = int(scene.num_history), VehicleParams()
    ahead = now + STEPS_PER_FRAME * np.arange(NUM_FRAMES)
    past = now + STEPS_PER_FRAME * np.arange(-PAST_FRAMES, 1)
    recorded = _known(scene, ahead)
    if not recorded[: NUM_POSES + 1].all():
        last = (int(np.argmin(recorded)) - 1) * 0.5
        raise ValueError(f"{info.token}: records {last:g} s after iteration 0; 4 s are needed")
    shift = np.array([*scene.origin, 0.0])
    centerline = np.asarray(way.centerline, float)[: int(way.points)] + shift
    centerline[:, 2] = np.unwrap(centerline[:, 2])
    arrays = {
        "ego_state": _states(scene, [now])[0],
        "start_time_us": np.array(info.iteration0_time_us, np.int64),
        "vehicle_params": np.array(
            [vehicle.width, vehicle.length, vehicle.wheel_base, vehicle.rear_axle_to_center]
        ),
        "centerline": centerline,
        "reference": np.asarray(way.reference, float) + shift,
        "human_poses": _relative(_states(scene, ahead[: NUM_POSES + 1].tolist())[:, :3]),
        **_map(scene),
        **_objects(scene, ahead[recorded]),
        **_lights(scene, ahead[recorded]),
    }
    profiles = FIRST if recorded.all() else ()
    if _known(scene, past).all():
        since = np.round(np.asarray(scene.time)[past] * 1e6).astype(np.int64)
        arrays["ego_past"] = _states(scene, past.tolist())
        arrays["ego_past_us"] = info.iteration0_time_us + since
        expect_plan(arrays)
        profiles += SECOND
    return arrays, profiles


def _known(scene: Scenario, steps: np.ndarray) -> np.ndarray:
    """Whether the ego is recorded at each step, `[K]` bool."""
    inside = (steps >= 0) & (steps < len(scene.ego_valid))
    return inside & np.asarray(scene.ego_valid)[np.where(inside, steps, 0)]


def _states(scene: Scenario, steps: list[int]) -> np.ndarray:
    """Recorded ego states `[K, 11]` as NAVSIM's logs have them, map coordinates."""
    columns = [
        np.zeros(len(steps)) if name in _UNMEASURED else np.asarray(getattr(scene.ego, name))[steps]
        for name in STATE_COLUMNS
    ]
    states = np.stack(columns, axis=-1).astype(float)
    states[:, :2] += scene.origin
    return states


def _relative(poses: np.ndarray) -> np.ndarray:
    """Poses `[K, 3]` but the first in the frame of the first."""
    (x, y, heading), rest = poses[0], poses[1:]
    cos, sin = np.cos(heading), np.sin(heading)
    dx, dy, turn = rest[:, 0] - x, rest[:, 1] - y, rest[:, 2] - heading
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=-1)


def _rows(polygons: Polygons) -> Polygons:
    """The same without padded rows at the end."""
    real = int(np.max(np.flatnonzero(polygons.count), initial=-1)) + 1
    return polygons.replace(start=polygons.start[:real], count=polygons.count[:real])


def _map(scene: Scenario) -> dict[str, np.ndarray]:
    """Polygons of the square around the ego, by kind.

    Source: NAVSIM `PDMDrivableMap.from_simulation`.
    """
    world, now = scene.map, int(scene.num_history)
    reach, heading = VehicleParams().rear_axle_to_center, scene.ego.heading[now]
    x = scene.ego.x[now] + reach * np.cos(heading)
    y = scene.ego.y[now] + reach * np.sin(heading)
    square = shapely.box(x - MAP_RADIUS, y - MAP_RADIUS, x + MAP_RADIUS, y + MAP_RADIUS)
    near = lambda shapes: [shapely.intersects(shape, square) for shape in shapes]

    blocks = split_geometries(_rows(world.roadblocks.polygon))
    chosen = np.flatnonzero(near(blocks))
    connector = np.asarray(world.roadblocks.is_connector)
    parts: list[tuple[int, bool, BaseGeometry]] = [
        (layers.BLOCK, False, blocks[row]) for row in chosen if not connector[row]
    ]
    outlines = split_rings(_rows(world.lanes.polygon))
    for lane in np.flatnonzero(np.isin(world.lanes.roadblock, chosen) & world.lanes.valid):
        kind = layers.CONNECTOR if connector[world.lanes.roadblock[lane]] else layers.LANE
        parts.append((kind, bool(scene.route.lane_on_route[lane]), shapely.Polygon(outlines[lane])))
    for kind, areas in (
        (layers.INTERSECTION, world.intersections),
        (layers.CAR_PARK, world.car_parks),
    ):
        shapes = split_geometries(_rows(areas))
        parts += [(kind, False, shapes[row]) for row in np.flatnonzero(near(shapes))]

    rings, owner = [], []
    for row, (_, _, shape) in enumerate(parts):
        mine = [shapely.get_coordinates(piece.exterior) for piece in _without_holes(shape)]
        rings += [ring + scene.origin for ring in mine]
        owner += [row] * len(mine)
    return {
        "map_ring_offsets": np.cumsum([0, *map(len, rings)]),
        "map_ring_xy": np.concatenate([*rings, np.zeros((0, 2))]),
        "map_ring_object": np.array(owner, np.int64),
        "map_kind": np.array([kind for kind, _, _ in parts], np.int64),
        "map_on_route": np.array([on for _, on, _ in parts], bool),
    }


def _without_holes(shape: BaseGeometry) -> Iterable[shapely.Polygon]:
    """Cuts a polygon, or several, through its holes."""
    for part in shapely.get_parts(shape):
        if not isinstance(part, shapely.Polygon):
            continue
        if not part.interiors:
            yield part
            continue
        west, south, east, north = part.bounds
        middle = part.interiors[0].centroid.x
        for half in (
            shapely.box(west, south, middle, north),
            shapely.box(middle, south, east, north),
        ):
            yield from _without_holes(shapely.intersection(part, half))


def _objects(scene: Scenario, steps: np.ndarray) -> dict[str, np.ndarray]:
    tracks, spare = scene.tracks, NUM_FRAMES - len(steps)
    valid = np.pad(np.asarray(tracks.valid)[:, steps].T, ((0, spare), (0, 0)))
    seen = np.flatnonzero(valid.any(axis=0))

    def frames(*columns: np.ndarray) -> np.ndarray:
        values = np.stack([np.asarray(c, float)[seen][:, steps].T for c in columns], axis=-1)
        return np.pad(values, ((0, spare), (0, 0), (0, 0)))

    valid = valid[:, seen]
    first = steps[np.argmax(valid[: len(steps)], axis=0)]
    pose = frames(tracks.x, tracks.y, tracks.heading)
    pose[..., :2] += scene.origin
    return {
        "obj_type": np.asarray(tracks.type)[seen].astype(np.int64),
        "obj_is_agent": np.asarray(tracks.type)[seen] <= ObjectType.BICYCLE,
        "obj_size": np.stack([tracks.length[seen, first], tracks.width[seen, first]], axis=-1),
        "log_pose": np.where(valid[..., None], pose, 0.0),
        "log_velocity": np.where(valid[..., None], frames(tracks.vx, tracks.vy), 0.0),
        "log_valid": valid,
    }


def _lights(scene: Scenario, steps: np.ndarray) -> dict[str, np.ndarray]:
    """Connectors of the route as it was given that are red in some frame."""
    lanes = scene.map.lanes
    given = scene.route.given_roadblocks
    red = np.asarray(scene.lights)[steps].T == LightStatus.RED
    red &= (np.isin(lanes.roadblock, given[given >= 0]) & lanes.valid)[:, None]
    rows = np.flatnonzero(red.any(axis=1))
    outlines = split_rings(_rows(lanes.polygon))
    rings = [np.concatenate([outlines[row], outlines[row][:1]]) + scene.origin for row in rows]
    return {
        "log_red": np.pad(red[rows], ((0, 0), (0, NUM_FRAMES - len(steps)))),
        "red_offsets": np.cumsum([0, *map(len, rings)]),
        "red_xy": np.concatenate([*rings, np.zeros((0, 2))]),
    }


def reference_difference(ours: NavsimScene, stored: NavsimScene) -> np.ndarray:
    """Distance of our PDM-Closed reference to a stored one, m.

    Args:
      ours: a frame made of a scenario.
      stored: the same frame as exported from NAVSIM; its origin may be another.

    Returns:
      `[41]` distance of the rear axles at 0, 0.1, ... 4.0 s.

    Raises:
      ValueError: the frames are more than 1 s or 1 m apart, so they are not one.
    """
    shift = np.asarray(ours.origin) - np.asarray(stored.origin)
    apart = np.hypot(*(np.array([ours.ego.x - stored.ego.x, ours.ego.y - stored.ego.y]) + shift))
    seconds = abs(int(ours.start_time_us) - int(stored.start_time_us)) * 1e-6
    if apart > 1.0 or seconds > 1.0:
        raise ValueError(
            f"the frames are {apart:.1f} m and {seconds:.1f} s apart; compare frames of one token"
        )
    return np.linalg.norm((ours.reference - stored.reference)[:, :2] + shift, axis=-1)
