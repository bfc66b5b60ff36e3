"""Checks a `RawScenario` before it is built, so that a bad source fails with a plain sentence."""

from collections.abc import Iterator

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawMap, RawScenario, ScenarioError
from spdm_jax.types import LightStatus, ObjectType

MAX_DISTANCE_TO_LANE = 60.0
"""An ego farther than this from every lane at iteration 0 is outside the map, m."""

_AREA_LAYERS = (
    "intersections",
    "car_parks",
    "drivable",
    "crosswalks",
    "walkways",
    "stop_lines",
)


def validate_raw(raw: RawScenario) -> list[str]:
    """Checks a scenario and the whole map that it carries.

    `build_scenario` applies the same checks, but to the part of the map that it keeps.

    Returns:
      Remarks on what is unusual but usable.

    Raises:
      ScenarioError: names scenario, field, index and value.
    """
    validate_recording(raw)
    return validate_map(raw, raw.map)


def validate_recording(raw: RawScenario) -> None:
    """Checks everything but the map: times, ego, tracks, lights, route.

    Raises:
      ScenarioError: names scenario, field, index and value.
    """
    where = _where(raw)
    time = np.asarray(raw.time_us)
    if time.ndim != 1 or len(time) == 0 or not np.issubdtype(time.dtype, np.integer):
        raise ScenarioError(
            f"{where}: time_us has shape {time.shape} and dtype {time.dtype}; expected [T] integers"
        )
    steps = len(time)
    late = np.flatnonzero(np.diff(time) <= 0)
    if len(late):
        i = int(late[0]) + 1
        raise ScenarioError(
            f"{where}: time_us[{i}] = {time[i]} is not later than the step before, {time[i - 1]}; "
            "sort the steps and drop repeated ones"
        )
    if raw.num_iterations < 1 or not 0 <= raw.num_history <= steps - raw.num_iterations:
        raise ScenarioError(
            f"{where}: num_history = {raw.num_history} and num_iterations = {raw.num_iterations} "
            f"do not fit the {steps} steps of time_us"
        )
    _check_ego(raw, steps, where)
    _check_tracks(raw, steps, where)
    _check_lights(raw, steps, where)
    if not raw.route_roadblocks:
        raise ScenarioError(
            f"{where}: route_roadblocks is empty; the planner needs a route, derive one from the "
            "recorded path or skip the scenario"
        )
    if raw.mission_goal is not None:
        _expect_shape(np.asarray(raw.mission_goal), (3,), f"{where}: mission_goal")
        _expect_finite(np.asarray(raw.mission_goal), f"{where}: mission_goal")


def validate_map(raw: RawScenario, part: RawMap) -> list[str]:
    """Checks a map, or the part of it that a scenario keeps.

    Self-touching and self-crossing rings are accepted; inside is decided by the even-odd rule.

    Args:
      raw: scenario, already checked by `validate_recording`.
      part: lanes, roadblocks and areas to check; roadblocks whole.

    Returns:
      Remarks on what is unusual but usable.

    Raises:
      ScenarioError: names scenario, field, index and value.
    """
    where = _where(raw)
    if not part.lanes:
        raise ScenarioError(f"{where}: map {part.name} has no lanes near the route or the ego")
    _check_lanes(part, where)
    for key, block in part.roadblocks.items():
        if key != block.id:
            raise ScenarioError(
                f"{where}: roadblocks[{key!r}].id = {block.id!r}; key and id differ"
            )
        _check_area(block.polygon, f"{where}: roadblocks[{key!r}].polygon")
        for lane in block.lanes:
            owner = part.lanes[lane].roadblock if lane in part.lanes else key
            if owner != key:
                raise ScenarioError(
                    f"{where}: roadblocks[{key!r}].lanes names lane {lane!r}, whose roadblock is "
                    f"{owner!r}"
                )
    for layer in _AREA_LAYERS:
        areas: list[RawArea] = getattr(part, layer)
        for area in areas:
            _check_area(area.polygon, f"{where}: {layer}[{area.id!r}].polygon")

    ego = shapely.Point(raw.ego[raw.num_history, :2])
    distance = _distance(ego, [lane.polygon for lane in part.lanes.values()])
    if distance > MAX_DISTANCE_TO_LANE:
        raise ScenarioError(
            f"{where}: the ego is outside map {part.name}: ego[{raw.num_history}] = "
            f"({ego.x:.3f}, {ego.y:.3f}) is {distance:.1f} m from the nearest lane; check that log "
            "and map use the same coordinates"
        )
    return list(_remarks(raw, ego, part))


def _remarks(raw: RawScenario, ego: shapely.Point, part: RawMap) -> Iterator[str]:
    named = {lane for step in raw.lights for lane in step}
    if unknown := sorted(named - raw.map.lanes.keys()):
        yield f"lights of {len(unknown)} unknown lanes ignored, first {unknown[0]!r}"
    if missing := [block for block in raw.route_roadblocks if block not in raw.map.roadblocks]:
        yield f"{len(missing)} route roadblocks not in the map ignored, first {missing[0]!r}"
    areas = [area.polygon for area in part.drivable]
    if not areas or shapely.distance(areas, ego).min() > MAX_DISTANCE_TO_LANE:
        yield f"no drivable polygon within {MAX_DISTANCE_TO_LANE:.0f} m of the ego"
    tracks = raw.tracks
    if unknown := int(np.sum(tracks.valid & ~np.isfinite(tracks.velocity).all(-1))):
        yield f"{unknown} track velocities are not finite and count as 0"


def _check_ego(raw: RawScenario, steps: int, where: str) -> None:
    _expect_shape(raw.ego, (steps, 11), f"{where}: ego")
    _expect_shape(raw.ego_valid, (steps,), f"{where}: ego_valid")
    if not raw.ego_valid[raw.num_history]:
        raise ScenarioError(
            f"{where}: ego_valid[{raw.num_history}] is False; the ego must be known at iteration 0"
        )
    _expect_finite(raw.ego, f"{where}: ego", raw.ego_valid)


def _check_tracks(raw: RawScenario, steps: int, where: str) -> None:
    tracks = raw.tracks
    number = len(tracks.ids)
    _expect_shape(tracks.type, (number,), f"{where}: tracks.type")
    _expect_shape(tracks.pose, (number, steps, 3), f"{where}: tracks.pose")
    _expect_shape(tracks.velocity, (number, steps, 2), f"{where}: tracks.velocity")
    _expect_shape(tracks.size, (number, steps, 2), f"{where}: tracks.size")
    _expect_shape(tracks.valid, (number, steps), f"{where}: tracks.valid")
    first: dict[str, int] = {}
    for i, track in enumerate(tracks.ids):
        if first.setdefault(track, i) != i:
            raise ScenarioError(
                f"{where}: tracks.ids[{i}] = {track!r} repeats tracks.ids[{first[track]}]"
            )
    for i in np.flatnonzero(~np.isin(tracks.type, [int(kind) for kind in ObjectType])):
        raise ScenarioError(
            f"{where}: tracks.type[{i}] = {tracks.type[i]} (track {tracks.ids[i]!r}) is not an "
            "ObjectType"
        )
    _expect_finite(tracks.pose, f"{where}: tracks.pose", tracks.valid)
    bad = tracks.valid & ~((tracks.size > 0) & np.isfinite(tracks.size)).all(-1)
    for i, step in np.argwhere(bad):
        raise ScenarioError(
            f"{where}: tracks.size[{i}, {step}] = {tracks.size[i, step].tolist()} (track "
            f"{tracks.ids[i]!r}); length and width must be positive, else mark the step invalid"
        )


def _check_lights(raw: RawScenario, steps: int, where: str) -> None:
    if len(raw.lights) != steps:
        raise ScenarioError(f"{where}: lights has {len(raw.lights)} steps, time_us has {steps}")
    known = {int(status) for status in LightStatus}
    for i, step in enumerate(raw.lights):
        if not known.issuperset(step.values()):
            lane, status = next(item for item in step.items() if item[1] not in known)
            raise ScenarioError(f"{where}: lights[{i}][{lane!r}] = {status!r} is not a LightStatus")


def _check_lanes(part: RawMap, where: str) -> None:
    for key, lane in part.lanes.items():
        name = f"{where}: lanes[{key!r}]"
        if key != lane.id:
            raise ScenarioError(f"{name}.id = {lane.id!r}; key and id differ")
        _expect_rows(lane.centerline, 3, 2, f"{name}.centerline")
        _expect_rows(lane.left_boundary, 2, 0, f"{name}.left_boundary")
        _expect_rows(lane.right_boundary, 2, 0, f"{name}.right_boundary")
        _expect_rows(lane.polygon, 2, 3, f"{name}.polygon")
        _check_ring(lane.polygon, f"{name}.polygon")
        limit = lane.speed_limit
        if limit is not None and (limit < 0 or np.isinf(limit)):
            raise ScenarioError(f"{name}.speed_limit = {limit}; give m/s, or None if unknown")


def _check_area(polygon: BaseGeometry, name: str) -> None:
    if polygon.geom_type not in ("Polygon", "MultiPolygon") or polygon.is_empty:
        raise ScenarioError(
            f"{name} is {polygon.wkt[:60]}; expected a non-empty Polygon or MultiPolygon"
        )
    # Of a MultiPolygon as it is, shapely gives no rings.
    for ring in shapely.get_rings(shapely.get_parts(polygon)):
        points = shapely.get_coordinates(ring)
        _expect_finite(points, name)
        _check_ring(points, name)


def _check_ring(points: np.ndarray, name: str) -> None:
    # The quick look at three points settles all but odd rings.
    head = points[:3].tolist()
    if head[0] != head[1] and head[1] != head[2] and head[0] != head[2]:
        return
    distinct = len(np.unique(points, axis=0))
    if distinct < 3:
        raise ScenarioError(
            f"{name}: a ring has {distinct} distinct points, first {head[0]}; it needs 3, drop it"
        )


def _expect_rows(array: np.ndarray, columns: int, least: int, name: str) -> None:
    if array.ndim != 2 or array.shape[1] != columns or len(array) < least:
        raise ScenarioError(
            f"{name} has shape {array.shape}; expected [N, {columns}] with N >= {least}"
        )
    _expect_finite(array, name)


def _expect_shape(array: np.ndarray, shape: tuple[int, ...], name: str) -> None:
    if array.shape != shape:
        raise ScenarioError(f"{name} has shape {array.shape}, expected {shape}")


def _expect_finite(array: np.ndarray, name: str, rows: np.ndarray | None = None) -> None:
    bad = ~np.isfinite(array)
    if rows is not None:
        bad &= rows[..., None]
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ScenarioError(f"{name}[{', '.join(map(str, index))}] = {array[index]} is not finite")


def _distance(point: shapely.Point, rings: list[np.ndarray]) -> float:
    # Polygons may be crossed or touch themselves, which shapely's distance tolerates.
    return float(shapely.distance([shapely.Polygon(ring) for ring in rings], point).min())


def _where(raw: RawScenario) -> str:
    return f"scenario {raw.token}"
