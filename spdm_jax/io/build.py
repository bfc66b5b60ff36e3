"""Turns a `RawScenario` into a `Scenario`: local frame, crop, index tables, route and grid.

Rows follow the source's order with one exception: lanes stand grouped by roadblock, from left to
right within each, so that `raw_map` can undo the build without storing those lists.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from spdm_jax.io.crop import MapIndex
from spdm_jax.io.flatten import (
    index_table,
    polygons_of_geometries,
    polygons_of_rings,
    polylines,
    split_geometries,
    split_polylines,
    split_rings,
)
from spdm_jax.io.raw import (
    RawArea,
    RawLane,
    RawMap,
    RawRoadblock,
    RawScenario,
    ScenarioError,
)
from spdm_jax.io.route import RouteTables, route_tables
from spdm_jax.io.validate import validate_map, validate_recording
from spdm_jax.types import (
    Array,
    EgoState,
    Lanes,
    Polygons,
    Roadblocks,
    Route,
    Scenario,
    ScenarioInfo,
    ScenarioMap,
    Tracks,
)


def build_scenario(
    raw: RawScenario, *, margin: float = 120.0, index: MapIndex | None = None
) -> tuple[Scenario, ScenarioInfo]:
    """Builds one scenario.

    Args:
      raw: scenario in the source's coordinates.
      margin: map elements within this distance of the route's roadblocks or the recorded path are
        kept, m; roadblocks with all their lanes, nothing is cut.
      index: search trees and grid of `raw.map`, to share between the scenarios of a map; made
        here if None.

    Returns:
      Scenario with NumPy leaves of exact size (float64) in a frame whose origin is the ego's rear
      axle at iteration 0, rounded to whole metres; and its description.

    Raises:
      ScenarioError: the scenario cannot be used; names scenario, field, index and value.
      ValueError: `index` belongs to another map.
    """
    validate_recording(raw)
    if index is None:
        index = MapIndex(raw.map)
    elif index.map is not raw.map:
        raise ValueError(
            f"scenario {raw.token}: index was made for another map object ({index.map.name}) than "
            f"the scenario's ({raw.map.name}); pass MapIndex(raw.map)"
        )
    given = [block for block in raw.route_roadblocks if block in raw.map.roadblocks]
    if not given:
        raise ScenarioError(
            f"scenario {raw.token}: none of the {len(raw.route_roadblocks)} route_roadblocks "
            f"(first {raw.route_roadblocks[0]!r}) is in map {raw.map.name}; check the map version"
        )
    path = raw.ego[raw.ego_valid, :2]
    part = index.crop(path, given, margin)
    notes = validate_map(raw, part)
    tables = _route_tables(raw.token, raw.map, given, raw.ego[raw.num_history, :3])
    if added := [block for block in tables.roadblocks if block not in part.roadblocks]:
        part = index.crop(path, [*given, *added], margin)
        notes = validate_map(raw, part)

    origin = np.round(raw.ego[raw.num_history, :2])
    goal = raw.mission_goal
    if goal is not None:
        goal = np.asarray(goal, float) - np.append(origin, 0.0)
    time0 = int(raw.time_us[raw.num_history])
    scenario = Scenario(
        map=_map(part, index, origin),
        route=_route(tables, given, list(part.lanes), list(part.roadblocks), goal),
        ego=_ego(raw, origin),
        ego_valid=np.array(raw.ego_valid, bool),
        tracks=_tracks(raw, origin),
        lights=_lights(raw, part),
        time=(raw.time_us - time0) / 1e6,
        num_history=np.array(raw.num_history, np.int32),
        num_iterations=np.array(raw.num_iterations, np.int32),
        origin=origin,
    )
    info = ScenarioInfo(
        token=raw.token,
        log_name=raw.log_name,
        map_name=raw.map.name,
        scenario_type=raw.scenario_type,
        source=raw.source,
        iteration0_time_us=time0,
        lane_ids=tuple(part.lanes),
        roadblock_ids=tuple(part.roadblocks),
        intersection_ids=tuple(area.id for area in part.intersections),
        track_ids=tuple(raw.tracks.ids),
        notes=(*raw.notes, *notes),
    )
    return scenario, info


def raw_map(scenario: Scenario, info: ScenarioInfo) -> RawMap:
    """Returns the map that a scenario carries, in its local frame; inverse of the build.

    Areas without a stored identifier are named by their row.
    """
    world = scenario.map
    lanes, blocks = world.lanes, world.roadblocks
    lane_ids, block_ids = info.lane_ids, info.roadblock_ids
    stop_ids = [str(i) for i in range(len(world.stop_line_type))]
    centerlines = split_polylines(lanes.centerline)
    left, right = split_polylines(lanes.left_boundary), split_polylines(lanes.right_boundary)
    rings = split_rings(lanes.polygon)
    interior: dict[str, list[str]] = {key: [] for key in block_ids}
    raw_lanes: dict[str, RawLane] = {}
    for i, key in enumerate(lane_ids):
        block = _name(block_ids, lanes.roadblock[i])
        if block is not None:
            interior[block].append(key)
        limit = float(lanes.speed_limit[i])
        raw_lanes[key] = RawLane(
            id=key,
            is_connector=bool(lanes.is_connector[i]),
            roadblock=block or "",
            centerline=centerlines[i],
            left_boundary=left[i][:, :2],
            right_boundary=right[i][:, :2],
            polygon=rings[i],
            successors=_names(lane_ids, lanes.successors[i]),
            predecessors=_names(lane_ids, lanes.predecessors[i]),
            left_neighbor=_name(lane_ids, lanes.left_neighbor[i]),
            right_neighbor=_name(lane_ids, lanes.right_neighbor[i]),
            speed_limit=None if np.isnan(limit) else limit,
            intersection=_name(info.intersection_ids, lanes.intersection[i]),
            has_traffic_light=bool(lanes.has_traffic_light[i]),
            stop_line=_name(stop_ids, lanes.stop_line[i]),
        )
    raw_blocks = {
        key: RawRoadblock(
            id=key,
            is_connector=bool(blocks.is_connector[i]),
            polygon=polygon,
            lanes=interior[key],
            successors=_names(block_ids, blocks.successors[i]),
            predecessors=_names(block_ids, blocks.predecessors[i]),
        )
        for i, (key, polygon) in enumerate(
            zip(block_ids, split_geometries(blocks.polygon), strict=True)
        )
    }
    return RawMap(
        name=info.map_name,
        lanes=raw_lanes,
        roadblocks=raw_blocks,
        intersections=_areas(world.intersections, world.intersection_type, info.intersection_ids),
        car_parks=_areas(world.car_parks),
        drivable=_areas(world.drivable, world.drivable_kind),
        crosswalks=_areas(world.crosswalks),
        walkways=_areas(world.walkways),
        stop_lines=_areas(world.stop_lines, world.stop_line_type),
    )


def start_at(scenario: Scenario, info: ScenarioInfo, iteration: int) -> Scenario:
    """Returns the same scenario, started at a later iteration.

    Steps before it become history, the route is corrected anew for the ego's pose there, map and
    local frame stay.

    Args:
      scenario: one scenario, not padded.
      info: its description.
      iteration: iteration of `scenario` that becomes iteration 0.

    Raises:
      ScenarioError: the iteration is outside the scenario's window, or the ego is unknown there.
    """
    step = int(scenario.num_history) + iteration
    if not 0 <= iteration < scenario.num_iterations:
        raise ScenarioError(
            f"scenario {info.token}: iteration {iteration} is outside its window of "
            f"{scenario.num_iterations} iterations"
        )
    if not scenario.ego_valid[step]:
        raise ScenarioError(
            f"scenario {info.token}: ego_valid[{step}] is False; the scenario cannot start at "
            f"iteration {iteration}, where the ego is unknown"
        )
    ego = scenario.ego
    given = _names(info.roadblock_ids, scenario.route.given_roadblocks)
    pose = np.array([ego.x[step], ego.y[step], ego.heading[step]])
    tables = _route_tables(info.token, raw_map(scenario, info), given, pose)
    route = _route(
        tables,
        given,
        info.lane_ids,
        info.roadblock_ids,
        np.asarray(scenario.route.mission_goal) if scenario.route.has_mission_goal else None,
    )
    # Whole microseconds: the result is then the one that a build from the source gives.
    micros = np.rint(np.asarray(scenario.time) * 1e6).astype(np.int64)
    return scenario.replace(
        route=route,
        time=(micros - micros[step]) / 1e6,
        num_history=np.array(step, np.int32),
        num_iterations=np.array(scenario.num_iterations - iteration, np.int32),
    )


def _route_tables(
    token: str, world: RawMap, given: Sequence[str], ego_pose: np.ndarray
) -> RouteTables:
    try:
        return route_tables(world, given, ego_pose)
    except ScenarioError as error:
        raise ScenarioError(f"scenario {token}: {error}") from error


def _map(part: RawMap, index: MapIndex, origin: np.ndarray) -> ScenarioMap:
    car_parks = [area.polygon for area in part.car_parks]
    intersections = [area.polygon for area in part.intersections]
    return ScenarioMap(
        lanes=_lanes(part, origin),
        roadblocks=_roadblocks(part, origin),
        intersections=polygons_of_geometries(intersections, origin),
        intersection_type=_kinds(part.intersections),
        car_parks=polygons_of_geometries(car_parks, origin),
        drivable=polygons_of_geometries([area.polygon for area in part.drivable], origin),
        drivable_kind=_kinds(part.drivable),
        crosswalks=polygons_of_geometries([area.polygon for area in part.crosswalks], origin),
        walkways=polygons_of_geometries([area.polygon for area in part.walkways], origin),
        stop_lines=polygons_of_geometries([area.polygon for area in part.stop_lines], origin),
        stop_line_type=_kinds(part.stop_lines),
        grid=index.grid(part, origin),
    )


def _lanes(part: RawMap, origin: np.ndarray) -> Lanes:
    lanes = list(part.lanes.values())
    row_of = _rows(part.lanes)
    centerlines = [lane.centerline for lane in lanes]
    limits = [np.nan if lane.speed_limit is None else lane.speed_limit for lane in lanes]
    links = [lane.successors for lane in lanes] + [lane.predecessors for lane in lanes]
    successors, predecessors = np.split(index_table(links, row_of), 2)
    return Lanes(
        valid=np.ones(len(lanes), bool),
        is_connector=np.array([lane.is_connector for lane in lanes], bool),
        centerline=polylines(centerlines, origin),
        left_boundary=polylines([lane.left_boundary for lane in lanes], origin),
        right_boundary=polylines([lane.right_boundary for lane in lanes], origin),
        polygon=polygons_of_rings([lane.polygon for lane in lanes], origin),
        length=np.array([_arc_length(line) for line in centerlines]),
        successors=successors,
        predecessors=predecessors,
        left_neighbor=_column([lane.left_neighbor for lane in lanes], row_of),
        right_neighbor=_column([lane.right_neighbor for lane in lanes], row_of),
        roadblock=_column([lane.roadblock for lane in lanes], _rows(part.roadblocks)),
        intersection=_column(
            [lane.intersection for lane in lanes], _rows(area.id for area in part.intersections)
        ),
        speed_limit=np.array(limits, float),
        has_traffic_light=np.array([lane.has_traffic_light for lane in lanes], bool),
        stop_line=_column(
            [lane.stop_line for lane in lanes], _rows(area.id for area in part.stop_lines)
        ),
    )


def _roadblocks(part: RawMap, origin: np.ndarray) -> Roadblocks:
    blocks = list(part.roadblocks.values())
    links = [block.successors for block in blocks] + [block.predecessors for block in blocks]
    successors, predecessors = np.split(index_table(links, _rows(part.roadblocks)), 2)
    return Roadblocks(
        valid=np.ones(len(blocks), bool),
        is_connector=np.array([block.is_connector for block in blocks], bool),
        polygon=polygons_of_geometries([block.polygon for block in blocks], origin),
        successors=successors,
        predecessors=predecessors,
    )


def _route(
    tables: RouteTables,
    given: Sequence[str],
    lane_ids: Sequence[str],
    roadblock_ids: Sequence[str],
    mission_goal: np.ndarray | None,
) -> Route:
    lane_rows, block_rows = _rows(lane_ids), _rows(roadblock_ids)
    roadblocks, given_roadblocks = index_table([tables.roadblocks, given], block_rows)
    slots = len(tables.start_lanes)
    sequences = index_table([*tables.centerline, *tables.goal, *tables.branches], lane_rows)
    start_lane = _column(tables.start_lanes, lane_rows)
    slot_of_lane = np.full(len(lane_ids), -1, np.int32)
    slot_of_lane[start_lane] = np.arange(slots)
    return Route(
        roadblocks=roadblocks,
        given_roadblocks=given_roadblocks,
        lane_on_route=slot_of_lane >= 0,
        slot_of_lane=slot_of_lane,
        start_lane=start_lane,
        centerline_lanes=sequences[:slots],
        reaches_goal=np.array(tables.reaches_goal, bool),
        goal_lanes=sequences[slots : 2 * slots],
        branch_lanes=sequences[2 * slots :],
        branch_start=sequences[2 * slots :, 0].copy(),
        mission_goal=np.zeros(3) if mission_goal is None else np.array(mission_goal, float),
        has_mission_goal=np.array(mission_goal is not None),
    )


def _ego(raw: RawScenario, origin: np.ndarray) -> EgoState:
    shifted = raw.ego - np.append(origin, np.zeros(9))
    states = np.where(raw.ego_valid[:, None], shifted, 0.0)
    x, y, heading, vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_acceleration = (
        states.T.copy()
    )
    return EgoState(
        x=x,
        y=y,
        heading=heading,
        vx=vx,
        vy=vy,
        ax=ax,
        ay=ay,
        steering=steering,
        steering_rate=steering_rate,
        yaw_rate=yaw_rate,
        yaw_acceleration=yaw_acceleration,
    )


def _tracks(raw: RawScenario, origin: np.ndarray) -> Tracks:
    tracks = raw.tracks
    valid = np.array(tracks.valid, bool)
    # nuPlan logs hold velocities that are not a number; everything else is known to be finite.
    velocity = np.where(np.isfinite(tracks.velocity), tracks.velocity, 0.0)
    fields = np.concatenate([tracks.pose[..., :2] - origin, tracks.pose[..., 2:], velocity], -1)
    fields = np.concatenate([fields, tracks.size], -1)
    fields = np.where(valid[..., None], fields, 0.0)
    x, y, heading, vx, vy, length, width = np.moveaxis(fields, -1, 0).copy()
    return Tracks(
        x=x,
        y=y,
        heading=heading,
        vx=vx,
        vy=vy,
        length=length,
        width=width,
        valid=valid,
        type=np.array(tracks.type, np.int32),
    )


def _lights(raw: RawScenario, part: RawMap) -> np.ndarray:
    """Returns `[T, L]` int8 `LightStatus`, UNKNOWN where nothing is recorded."""
    row_of = _rows(part.lanes)
    lights = np.zeros((len(raw.lights), len(row_of)), np.int8)
    for step, status in zip(lights, raw.lights, strict=True):
        for lane, value in status.items():
            if lane in row_of:
                step[row_of[lane]] = value
    return lights


def _areas(
    polygons: Polygons, kind: Array | None = None, ids: Sequence[str] | None = None
) -> list[RawArea]:
    geometries = split_geometries(polygons)
    return [
        RawArea(
            id=str(i) if ids is None else ids[i],
            polygon=geometry,
            kind=0 if kind is None else int(kind[i]),
        )
        for i, geometry in enumerate(geometries)
    ]


def _kinds(areas: Sequence[RawArea]) -> np.ndarray:
    return np.array([area.kind for area in areas], np.int32)


def _arc_length(line: np.ndarray) -> float:
    return float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())


def _rows(ids: Iterable[str]) -> dict[str, int]:
    return {key: i for i, key in enumerate(ids)}


def _column(ids: Sequence[str | None], row_of: Mapping[str, int]) -> np.ndarray:
    return index_table(([key] for key in ids), row_of)[:, 0].copy()


def _name(ids: Sequence[str], row: Array) -> str | None:
    return ids[int(row)] if row >= 0 else None


def _names(ids: Sequence[str], rows: Array) -> list[str]:
    return [ids[int(row)] for row in rows if row >= 0]
