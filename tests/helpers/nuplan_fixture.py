"""Small maps for tests: straight roads joined by curves, in memory or as nuPlan files.

Names: lane 1 of road A is `A.1` (lanes count from the left), the connector block from A to B is
`A-B`, the connector from lane 1 to lane 0 is `A.1-B.0`.
"""

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawLane, RawMap, RawRoadblock

LOCATION = "us-pa-pittsburgh-hazelwood"
VERSION = "9.17.1937"
LOG_NAME = "2021.03.01.00.00.00_veh-97_00000_00030"
EPSG = 32617
MAP_ORIGIN = np.array([590_000.0, 4_480_000.0])
"""Added to all positions when a map is written: UTM-like coordinates."""
TAG = "following_lane_with_lead"
TAG_TIME = 12.0
"""Time of the tagged sweep, s; the scenario starts 3 s earlier."""
LOG_DURATION = 30.0

Point = tuple[float, float]
Link = tuple[str, str, Sequence[tuple[int, int]]]


@dataclass(frozen=True)
class Road:
    """A straight road block; `start` and `end` are on its axis, between the outer lane edges."""

    start: Point
    end: Point
    lanes: int = 1


def road_map(roads: Mapping[str, Road], links: Iterable[Link], width: float = 3.5) -> RawMap:
    """Builds a map in memory.

    Args:
      roads: name -> road.
      links: (from, to, pairs of lane numbers) for each connector block.
      width: lane width, m.
    """
    raw_map = RawMap(name="test", lanes={}, roadblocks={})
    for name, road in roads.items():
        start, end = np.array(road.start, float), np.array(road.end, float)
        along = (end - start) / np.linalg.norm(end - start)
        left = np.array([-along[1], along[0]])
        lanes = []
        for i in range(road.lanes):
            shift = left * width * ((road.lanes - 1) / 2 - i)
            steps = int(np.ceil(np.linalg.norm(end - start)))
            axis = np.linspace(start + shift, end + shift, steps + 1)
            lanes.append(_add_lane(raw_map, f"{name}.{i}", name, axis, width, connector=False))
        _add_block(raw_map, name, lanes, connector=False)
    for before, after, pairs in links:
        name = f"{before}-{after}"
        lanes = []
        for i, j in pairs:
            first, second = raw_map.lanes[f"{before}.{i}"], raw_map.lanes[f"{after}.{j}"]
            id_ = f"{first.id}-{second.id}"
            axis = _curve(first.centerline[-1], second.centerline[0])
            lanes.append(_add_lane(raw_map, id_, name, axis, width, connector=True))
            _link(raw_map.lanes, first.id, id_)
            _link(raw_map.lanes, id_, second.id)
        _add_block(raw_map, name, lanes, connector=True)
        _link(raw_map.roadblocks, before, name)
        _link(raw_map.roadblocks, name, after)
    return raw_map


def write_nuplan(
    root: Path, raw_map: RawMap, route: Sequence[str], ego: tuple[float, float, float]
) -> dict[str, str]:
    """Writes a map and a log of 30 s in nuPlan's format.

    Args:
      root: receives `maps/` and `nuplan-v1.1/splits/mini/`.
      raw_map: what `road_map` built.
      route: roadblock names every scene names as its route.
      ego: rear axle x, y, heading where the scenario starts; it drives straight on at 1 m/s.

    Returns:
      Name -> id in the files, for lanes and blocks.
    """
    fid = {name: str(10_000 + i) for i, name in enumerate([*raw_map.lanes, *raw_map.roadblocks])}
    folder = root / "maps" / LOCATION / VERSION
    folder.mkdir(parents=True)
    index = {LOCATION: {"version": VERSION, "layers": {}}}
    (root / "maps" / "nuplan-maps-v1.0.json").write_text(json.dumps(index), encoding="utf-8")
    with closing(sqlite3.connect(folder / "map.gpkg")) as db, db:
        _write_map(db, raw_map, {name: int(number) for name, number in fid.items()})
    logs = root / "nuplan-v1.1" / "splits" / "mini"
    logs.mkdir(parents=True)
    with closing(sqlite3.connect(logs / f"{LOG_NAME}.db")) as db, db:
        _write_log(db, " ".join(fid[block] for block in route), ego)
    return fid


def _add_lane(
    raw_map: RawMap, id_: str, block: str, axis: np.ndarray, width: float, *, connector: bool
) -> str:
    step = np.diff(axis, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    heading = np.append(heading, heading[-1])
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    left, right = axis + normal * width / 2, axis - normal * width / 2
    raw_map.lanes[id_] = RawLane(
        id=id_,
        is_connector=connector,
        roadblock=block,
        centerline=np.column_stack([axis, heading]),
        left_boundary=left,
        right_boundary=right,
        polygon=np.concatenate([left, right[::-1]]),
        speed_limit=10.0,
    )
    return id_


def _add_block(raw_map: RawMap, id_: str, lanes: Sequence[str], *, connector: bool) -> None:
    area = shapely.union_all([shapely.Polygon(raw_map.lanes[lane].polygon) for lane in lanes])
    raw_map.roadblocks[id_] = RawRoadblock(id_, connector, area, list(lanes))


def _link(table: Mapping[str, RawLane] | Mapping[str, RawRoadblock], a: str, b: str) -> None:
    table[a].successors = [*table[a].successors, b]
    table[b].predecessors = [*table[b].predecessors, a]


def _curve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cubic Bezier curve between two poses, `[H, 2]`."""
    reach = np.linalg.norm(b[:2] - a[:2]) / 3
    control = np.stack(
        [
            a[:2],
            a[:2] + reach * np.array([np.cos(a[2]), np.sin(a[2])]),
            b[:2] - reach * np.array([np.cos(b[2]), np.sin(b[2])]),
            b[:2],
        ]
    )
    t = np.linspace(0.0, 1.0, int(np.ceil(3 * reach)) + 1)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    return weights @ control


def _write_map(db: sqlite3.Connection, raw_map: RawMap, fid: Mapping[str, int]) -> None:
    import pyproj  # optional dependency; maps in memory do without

    db.executescript(
        "CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, "
        "organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, "
        "definition TEXT NOT NULL, description TEXT);"
        "CREATE TABLE gpkg_geometry_columns (table_name TEXT PRIMARY KEY, column_name TEXT, "
        "geometry_type_name TEXT, srs_id INTEGER, z TINYINT, m TINYINT);"
        "CREATE TABLE meta (fid INTEGER PRIMARY KEY, key TEXT, value TEXT);"
        "INSERT INTO gpkg_spatial_ref_sys VALUES ('WGS 84', 4326, 'EPSG', 4326, '', '');"
    )
    db.execute("INSERT INTO meta VALUES (1, 'projectedCoordSystem', ?)", (f"EPSG:{EPSG}",))
    to_degrees = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True).transform

    def blob(shape: BaseGeometry) -> bytes:
        shape = shapely.transform(
            shape, lambda xy: np.stack(to_degrees(*(xy + MAP_ORIGIN).T), axis=1)
        )
        return b"GP\x00\x01" + (4326).to_bytes(4, "little") + shapely.to_wkb(shape)

    def layer(name: str, columns: str, rows: Sequence[tuple]) -> None:
        fields = "".join(f', "{column}"' for column in columns.split())
        db.execute(f'CREATE TABLE "{name}" (fid INTEGER PRIMARY KEY, geom BLOB{fields})')
        db.execute(
            "INSERT INTO gpkg_geometry_columns VALUES (?,'geom','GEOMETRY',4326,0,0)", (name,)
        )
        marks = ",".join("?" * (2 + len(columns.split())))
        db.executemany(f'INSERT INTO "{name}" VALUES ({marks})', rows)

    lanes, blocks = raw_map.lanes.values(), raw_map.roadblocks.values()
    place = {lane: i for block in blocks for i, lane in enumerate(block.lanes)}
    edge = {lane.id: (50_000 + 2 * i, 50_001 + 2 * i) for i, lane in enumerate(lanes)}
    area = {lane.id: blob(shapely.Polygon(lane.polygon)) for lane in lanes}
    line = {lane.id: blob(shapely.LineString(lane.centerline[:, :2])) for lane in lanes}
    layer(
        "lanes_polygons",
        "lane_fid lane_group_fid lane_index lane_type_fid speed_limit_mps "
        "left_boundary_fid right_boundary_fid",
        [
            (
                fid[l.id],
                area[l.id],
                fid[l.id],
                fid[l.roadblock],
                place[l.id],
                0,
                l.speed_limit,
                *edge[l.id],
            )
            for l in lanes
            if not l.is_connector
        ],
    )
    layer(
        "lane_groups_polygons",
        "lane_group_fid",
        [(fid[b.id], blob(b.polygon), fid[b.id]) for b in blocks if not b.is_connector],
    )
    layer(
        "lane_connectors",
        "exit_lane_fid entry_lane_fid exit_lane_group_fid "
        "entry_lane_group_fid lane_group_connector_fid intersection_fid turn_type_fid "
        "speed_limit_mps traffic_light_stop_line_fids",
        [
            (
                fid[l.id],
                line[l.id],
                fid[l.predecessors[0]],
                fid[l.successors[0]],
                *(fid[raw_map.lanes[end[0]].roadblock] for end in (l.predecessors, l.successors)),
                fid[l.roadblock],
                90_000,
                0,
                l.speed_limit,
                "",
            )
            for l in lanes
            if l.is_connector
        ],
    )
    layer(
        "gen_lane_connectors_scaled_width_polygons",
        "lane_connector_fid "
        "lane_group_connector_fid intersection_fid left_boundary_fid right_boundary_fid",
        [
            (70_000 + i, area[l.id], fid[l.id], fid[l.roadblock], 90_000, *edge[l.id])
            for i, l in enumerate(lanes)
            if l.is_connector
        ],
    )
    layer(
        "lane_group_connectors",
        "from_lane_group_fid to_lane_group_fid intersection_fid",
        [
            (fid[b.id], blob(b.polygon), fid[b.predecessors[0]], fid[b.successors[0]], 90_000)
            for b in blocks
            if b.is_connector
        ],
    )
    layer(
        "baseline_paths",
        "lane_fid lane_connector_fid",
        [
            (60_000 + i, line[l.id], *((None, fid[l.id]) if l.is_connector else (fid[l.id], None)))
            for i, l in enumerate(lanes)
        ],
    )
    layer(
        "boundaries",
        "boundary_type_fid",
        [
            (number, blob(shapely.LineString(side)), 0)
            for l in lanes
            for number, side in zip(edge[l.id], (l.left_boundary, l.right_boundary), strict=True)
        ],
    )
    roads = [b.polygon for b in blocks if not b.is_connector]
    crossings = shapely.union_all([b.polygon for b in blocks if b.is_connector])
    layer(
        "road_segments",
        "road_segment_fid",
        [(80_000 + i, blob(shape), i) for i, shape in enumerate(roads)],
    )
    layer(
        "intersections",
        "intersection_type_fid is_mini",
        [(90_000, blob(shapely.convex_hull(crossings)), 0, 0)],
    )
    for name in (
        "stop_polygons",
        "crosswalks",
        "walkways",
        "carpark_areas",
        "generic_drivable_areas",
    ):
        layer(name, "", [])


def _write_log(db: sqlite3.Connection, route: str, ego: tuple[float, float, float]) -> None:
    db.executescript(
        "CREATE TABLE log (token BLOB, vehicle_name, date, timestamp, logfile, location, "
        "map_version);"
        "CREATE TABLE lidar (token BLOB, log_token BLOB, channel, model, translation BLOB, "
        "rotation BLOB);"
        "CREATE TABLE ego_pose (token BLOB, timestamp INTEGER, x, y, z, qw, qx, qy, qz, vx, vy, "
        "vz, acceleration_x, acceleration_y, acceleration_z, angular_rate_x, angular_rate_y, "
        "angular_rate_z, epsg INTEGER, log_token BLOB);"
        "CREATE TABLE scene (token BLOB, log_token BLOB, name, goal_ego_pose_token BLOB, "
        "roadblock_ids TEXT);"
        "CREATE TABLE lidar_pc (token BLOB, next_token BLOB, prev_token BLOB, "
        "ego_pose_token BLOB, lidar_token BLOB, scene_token BLOB, filename, timestamp INTEGER);"
        "CREATE TABLE category (token BLOB, name, description);"
        "CREATE TABLE track (token BLOB, category_token BLOB, width, length, height);"
        "CREATE TABLE lidar_box (token BLOB, lidar_pc_token BLOB, track_token BLOB, "
        "next_token BLOB, prev_token BLOB, x, y, z, width, length, height, vx, vy, vz, yaw, "
        "confidence);"
        "CREATE TABLE scenario_tag (token BLOB, lidar_pc_token BLOB, type, agent_track_token "
        "BLOB);"
        "CREATE TABLE traffic_light_status (token BLOB, lidar_pc_token BLOB, "
        "lane_connector_id INTEGER, status);"
    )

    def token(kind: int, number: int) -> bytes:
        return kind.to_bytes(4, "big") + number.to_bytes(4, "big")

    def put(table: str, rows: Sequence[tuple]) -> None:
        db.executemany(f"INSERT INTO {table} VALUES ({','.join('?' * len(rows[0]))})", rows)

    log, lidar, category, track = (token(0, i) for i in range(4))
    seconds = np.arange(0.0, LOG_DURATION, 0.05)
    stamps = [1_614_556_800_000_000 + round(1e6 * t) for t in seconds]
    direction = np.array([np.cos(ego[2]), np.sin(ego[2])])
    xy = MAP_ORIGIN + ego[:2] + (seconds - (TAG_TIME - 3.0))[:, None] * direction
    parked = MAP_ORIGIN + ego[:2] + np.array([0.0, 12.0])
    frames = range(len(seconds))
    scenes = int(LOG_DURATION / 3.0)
    put("log", [(log, "veh-97", "2021-03-01", stamps[0], LOG_NAME, LOCATION, LOCATION)])
    put("lidar", [(lidar, log, "MergedPointCloud", "none", b"", b"")])
    put(
        "ego_pose",
        [
            (
                token(1, k),
                stamps[k],
                *xy[k],
                0.0,
                np.cos(ego[2] / 2),
                0.0,
                0.0,
                np.sin(ego[2] / 2),
                1.0,
                *[0.0] * 8,
                EPSG,
                log,
            )
            for k in frames
        ],
    )
    put(
        "scene",
        [(token(2, i), log, f"scene-{i:03d}", token(1, frames[-1]), route) for i in range(scenes)],
    )
    put(
        "lidar_pc",
        [
            (
                token(3, k),
                token(3, k + 1),
                token(3, k - 1) if k else None,
                token(1, k),
                lidar,
                token(2, int(seconds[k] // 3.0)),
                "",
                stamps[k],
            )
            for k in frames
        ],
    )
    put("category", [(category, "vehicle", "")])
    put("track", [(track, category, 1.9, 4.5, 1.6)])
    put(
        "lidar_box",
        [
            (
                token(4, k),
                token(3, k),
                track,
                None,
                None,
                *parked,
                0.0,
                1.9,
                4.5,
                1.6,
                0.0,
                0.0,
                0.0,
                0.0,
                0.9,
            )
            for k in frames
        ],
    )
    put("scenario_tag", [(token(5, 0), token(3, round(TAG_TIME / 0.05)), TAG, track)])
