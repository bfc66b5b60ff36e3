"""nuPlan maps: `map.gpkg` (a GeoPackage, hence SQLite) to `RawMap`, without GDAL.

Facts of the format that decide results:

- Layers are stored in longitude/latitude; the metric system is named in the file's own `meta`
  table and nowhere else.
- A connector's predecessor is the lane one exits (`exit_lane_fid`), its successor the lane one
  enters (`entry_lane_fid`). Lanes meet only through connectors.
- The layer `lane_connectors` holds lines; the connectors' areas have a layer of their own.
- The drivable area is the union of four layers whose ids may collide.
"""

import json
import sqlite3
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock, ScenarioError
from spdm_jax.types import DrivableKind

try:
    import pyproj
    import pyproj.exceptions
except ImportError as _error:
    raise ImportError("nuPlan maps need pyproj: pip install 'spdm-jax[data]'") from _error

MAP_INDEX = "nuplan-maps-v1.0.json"
"""File in the map folder that names the version of each location."""

LAYERS: Mapping[str, tuple[str, ...]] = {
    "lanes_polygons": (
        *("lane_group_fid", "lane_index", "left_boundary_fid", "right_boundary_fid"),
        "speed_limit_mps",
    ),
    "lane_connectors": (
        *("exit_lane_fid", "entry_lane_fid", "lane_group_connector_fid", "speed_limit_mps"),
        "traffic_light_stop_line_fids",
    ),
    "gen_lane_connectors_scaled_width_polygons": (
        *("lane_connector_fid", "left_boundary_fid", "right_boundary_fid"),
    ),
    "lane_groups_polygons": (),
    "lane_group_connectors": ("from_lane_group_fid", "to_lane_group_fid", "intersection_fid"),
    "baseline_paths": ("lane_fid", "lane_connector_fid"),
    "boundaries": (),
    "intersections": ("intersection_type_fid",),
    "stop_polygons": ("stop_polygon_type_fid",),
    "crosswalks": (),
    "walkways": (),
    "carpark_areas": (),
    "generic_drivable_areas": (),
    "road_segments": (),
}
"""Layers that the reader needs and the columns it reads of each."""

_DRIVABLE = {
    "road_segments": DrivableKind.ROAD_SEGMENT,
    "intersections": DrivableKind.INTERSECTION,
    "generic_drivable_areas": DrivableKind.GENERIC,
    "carpark_areas": DrivableKind.CAR_PARK,
}
# Bytes of the bounding box in a geometry's header, by its indicator (GeoPackage 1.3, 2.1.3).
_ENVELOPE_BYTES = (0, 32, 48, 48, 64)


@dataclass(frozen=True)
class Layer:
    """One vector layer.

    Attributes:
      ids: feature ids as text, file order.
      geometry: geometries in the map's metric system.
      columns: column name -> values (None where the file has none).
    """

    ids: list[str]
    geometry: list[BaseGeometry]
    columns: dict[str, list[Any]]

    def references(self, column: str) -> list[str | None]:
        """Returns a `*_fid` column as ids; real files hold integers, floats and gaps."""
        return [None if value is None else str(int(value)) for value in self.columns[column]]

    def shapes(self) -> dict[str, BaseGeometry]:
        """Returns id -> geometry."""
        return dict(zip(self.ids, self.geometry, strict=True))


def find_map(map_root: Path, location: str) -> Path:
    """Returns the map file of a location, by the version that the folder's index names.

    Raises:
      ScenarioError: no index, a location it does not list, or the file it names is missing.
    """
    index = map_root / MAP_INDEX
    try:
        entries = json.loads(index.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ScenarioError(
            f"{index}: not a readable index of maps ({error}); point map_root at the folder that "
            f"holds {MAP_INDEX}"
        ) from error
    try:
        version = entries[location]["version"]
    except (KeyError, TypeError) as error:
        raise ScenarioError(
            f"{index}: names no version of location {location!r}, only of {list(entries)}; "
            "get the map of this location or leave its logs out"
        ) from error
    path = map_root / location / str(version) / "map.gpkg"
    if not path.is_file():
        raise ScenarioError(
            f"{path}: missing, though {index.name} names version {version!r} of {location!r}; "
            "get this version of the map"
        )
    return path


def read_layers(path: Path) -> dict[str, Layer]:
    """Reads all of `LAYERS` from a map file, projected to the map's metric system.

    Raises:
      ScenarioError: no GeoPackage, or a layer, column or projection is missing.
    """
    try:
        with closing(sqlite3.connect(path.resolve().as_uri() + "?mode=ro", uri=True)) as db:
            geometry = {
                table: (column, f"{organization}:{number}")
                for table, column, organization, number in db.execute(
                    "SELECT g.table_name, g.column_name, s.organization, s.organization_coordsys_id"
                    " FROM gpkg_geometry_columns g JOIN gpkg_spatial_ref_sys s USING (srs_id)"
                )
            }
            target = _metric_system(path, db)
            return {
                name: _read_layer(path, db, name, columns, geometry, target)
                for name, columns in LAYERS.items()
            }
    except sqlite3.Error as error:
        raise ScenarioError(
            f"{path}: not a readable GeoPackage ({error}); it may be truncated, fetch it again"
        ) from error


def read_map(path: Path, name: str) -> tuple[RawMap, list[str]]:
    """Reads a whole map.

    Args:
      path: the `map.gpkg`.
      name: location, becomes the map's name.

    Returns:
      The map in its metric system, and remarks about elements that had to be left out.
    """
    layers = read_layers(path)
    notes: list[str] = []
    lanes = _lanes(layers, notes)
    return (
        RawMap(
            name=name,
            lanes=lanes,
            roadblocks=_roadblocks(layers, lanes),
            intersections=_areas(layers["intersections"], "intersection_type_fid"),
            car_parks=_areas(layers["carpark_areas"]),
            drivable=[
                RawArea(id_, shape, int(kind))
                for layer, kind in _DRIVABLE.items()
                for id_, shape in layers[layer].shapes().items()
            ],
            crosswalks=_areas(layers["crosswalks"]),
            walkways=_areas(layers["walkways"]),
            stop_lines=_areas(layers["stop_polygons"], "stop_polygon_type_fid"),
        ),
        notes,
    )


def stop_lines_of(
    fids: str | None, baseline: BaseGeometry, stop_lines: Mapping[str, BaseGeometry]
) -> list[str]:
    """Returns the stop polygons of a connector, from the ids its row lists.

    Those that its baseline crosses; if it crosses none, the one nearest to its first point.
    """
    listed = [i for i in (fids or "").replace(" ", "").split(",") if i in stop_lines]
    if not listed:
        return []
    shapes = [stop_lines[i] for i in listed]
    if crossed := [
        i for i, shape in zip(listed, shapes, strict=True) if shape.intersects(baseline)
    ]:
        return crossed
    start = shapely.get_point(baseline, 0)
    return [listed[int(np.argmin(shapely.distance(shapes, start)))]]


def line_headings(xy: np.ndarray) -> np.ndarray:
    """Returns nuPlan's headings of a polyline `[H, 2]`: that of the segment that follows a point.

    The last point repeats the heading before it. rad, `[H]`.
    """
    steps = np.diff(xy, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    return np.append(heading, heading[-1])


def _metric_system(path: Path, db: sqlite3.Connection) -> pyproj.CRS:
    try:
        row = db.execute("SELECT value FROM meta WHERE key = 'projectedCoordSystem'").fetchone()
        return pyproj.CRS.from_user_input(row[0])
    except (sqlite3.OperationalError, TypeError, pyproj.exceptions.CRSError) as error:
        raise ScenarioError(
            f"{path}: table 'meta' has no usable 'projectedCoordSystem' ({error}); without it the "
            "map cannot be projected to metres, fetch the map again"
        ) from error


def _read_layer(
    path: Path,
    db: sqlite3.Connection,
    name: str,
    columns: Sequence[str],
    geometry: Mapping[str, tuple[str, str]],
    target: pyproj.CRS,
) -> Layer:
    info = list(db.execute(f'PRAGMA table_info("{name}")'))
    if name not in geometry or not info:
        raise ScenarioError(
            f"{path}: layer {name!r} is missing; a nuPlan v1.0 map has {sorted(LAYERS)}"
        )
    column, system = geometry[name]
    present = {row[1] for row in info}
    # Stub maps have empty layers without columns; a column is needed as soon as there is a row.
    key = next((row[1] for row in info if row[5]), "fid")
    count = db.execute(f'SELECT COUNT(*) FROM "{name}"').fetchone()[0]
    if not count:
        return Layer([], [], {c: [] for c in columns})
    if missing := [c for c in (key, column, *columns) if c not in present]:
        raise ScenarioError(f"{path}: layer {name!r} lacks the column(s) {missing}")
    names = ", ".join(f'"{c}"' for c in (key, column, *columns))
    rows = db.execute(f'SELECT {names} FROM "{name}" ORDER BY rowid').fetchall()
    ids = [str(row[0]) for row in rows]
    try:
        shapes = shapely.from_wkb([_wkb(row[1]) for row in rows])
    except (ValueError, TypeError, IndexError, shapely.errors.GEOSException) as error:
        raise ScenarioError(f"{path}: layer {name!r} holds a broken geometry ({error})") from error
    project = pyproj.Transformer.from_crs(system, target, always_xy=True).transform
    shapes = shapely.transform(
        shapely.force_2d(shapes), lambda xy: np.stack(project(xy[:, 0], xy[:, 1]), axis=1)
    )
    values = {c: [row[2 + i] for row in rows] for i, c in enumerate(columns)}
    return Layer(ids, list(shapes), values)


def _wkb(blob: bytes) -> bytes:
    """Strips a GeoPackage geometry's header."""
    if blob[:2] != b"GP":
        raise ValueError(f"a geometry starts with {blob[:2]!r}, not with b'GP'")
    return blob[8 + _ENVELOPE_BYTES[blob[3] >> 1 & 0b111] :]


def _areas(layer: Layer, kind: str | None = None) -> list[RawArea]:
    kinds = layer.columns[kind] if kind else [0] * len(layer.ids)
    return [
        RawArea(id_, shape, 0 if number is None else int(number))
        for id_, shape, number in zip(layer.ids, layer.geometry, kinds, strict=True)
    ]


def _ring(shape: BaseGeometry) -> np.ndarray:
    """Returns the outer ring `[V, 2]` of a polygon, of the largest part if there are several."""
    parts = shapely.get_parts(shape)
    part = parts[int(np.argmax(shapely.area(parts)))]
    return shapely.get_coordinates(shapely.get_exterior_ring(part))


def _optional(value: Any) -> float | None:
    return None if value is None or np.isnan(value) else float(value)


def _grouped(keys: Sequence[str | None], values: Sequence[str]) -> dict[str | None, list[str]]:
    """Returns key -> its values, in order."""
    groups: dict[str | None, list[str]] = defaultdict(list)
    for key, value in zip(keys, values, strict=True):
        groups[key].append(value)
    return groups


class _LaneShapes:
    """Makes the geometric part of a lane from the layers that hold its pieces."""

    def __init__(self, layers: Mapping[str, Layer], notes: list[str]) -> None:
        paths = layers["baseline_paths"]
        self.boundaries = layers["boundaries"].shapes()
        self.baselines = {
            is_connector: dict(zip(paths.references(column), paths.geometry, strict=True))
            for is_connector, column in ((False, "lane_fid"), (True, "lane_connector_fid"))
        }
        self.notes = notes

    def lane(
        self,
        id_: str,
        is_connector: bool,
        roadblock: str | None,
        area: BaseGeometry | None,
        edges: tuple[str | None, str | None],
    ) -> RawLane | None:
        """Returns the lane without its relations, or None (and a note) if a piece is missing."""
        baseline = self.baselines[is_connector].get(id_)
        left, right = (self.boundaries.get(edge or "") for edge in edges)
        if roadblock is None or baseline is None or area is None or left is None or right is None:
            kind = "lane connector" if is_connector else "lane"
            self.notes.append(
                f"{kind} {id_} lacks a roadblock, baseline, boundary or area: left out"
            )
            return None
        xy = shapely.get_coordinates(baseline)
        return RawLane(
            id=id_,
            is_connector=is_connector,
            roadblock=roadblock,
            centerline=np.column_stack([xy, line_headings(xy)]),
            left_boundary=shapely.get_coordinates(left),
            right_boundary=shapely.get_coordinates(right),
            polygon=_ring(area),
        )


def _lanes(layers: Mapping[str, Layer], notes: list[str]) -> dict[str, RawLane]:
    """Builds lanes, then connectors, in file order."""
    shapes = _LaneShapes(layers, notes)
    table, connectors = layers["lanes_polygons"], layers["lane_connectors"]
    outgoing = _grouped(connectors.references("exit_lane_fid"), connectors.ids)
    incoming = _grouped(connectors.references("entry_lane_fid"), connectors.ids)
    groups, indices = table.references("lane_group_fid"), table.columns["lane_index"]
    at_place = dict(zip(zip(groups, indices, strict=True), table.ids, strict=True))
    lefts = table.references("left_boundary_fid")
    rights = table.references("right_boundary_fid")
    lanes: dict[str, RawLane] = {}
    for i, id_ in enumerate(table.ids):
        lane = shapes.lane(id_, False, groups[i], table.geometry[i], (lefts[i], rights[i]))
        if lane is None:
            continue
        lane.successors, lane.predecessors = outgoing[id_], incoming[id_]
        if (index := indices[i]) is not None:
            lane.left_neighbor = at_place.get((groups[i], index - 1))
            lane.right_neighbor = at_place.get((groups[i], index + 1))
        lane.speed_limit = _optional(table.columns["speed_limit_mps"][i])
        lanes[id_] = lane
    return lanes | _connectors(layers, shapes)


def _connectors(layers: Mapping[str, Layer], shapes: _LaneShapes) -> dict[str, RawLane]:
    table = layers["lane_connectors"]
    areas = layers["gen_lane_connectors_scaled_width_polygons"]
    owners = areas.references("lane_connector_fid")
    area_of = dict(zip(owners, areas.geometry, strict=True))
    edges = zip(
        areas.references("left_boundary_fid"), areas.references("right_boundary_fid"), strict=True
    )
    edges_of = dict(zip(owners, edges, strict=True))
    blocks = layers["lane_group_connectors"]
    crossing = dict(zip(blocks.ids, blocks.references("intersection_fid"), strict=True))
    groups = table.references("lane_group_connector_fid")
    exits, entries = table.references("exit_lane_fid"), table.references("entry_lane_fid")
    stop_lines = layers["stop_polygons"].shapes()
    lanes: dict[str, RawLane] = {}
    for i, id_ in enumerate(table.ids):
        edge = edges_of.get(id_, (None, None))
        lane = shapes.lane(id_, True, groups[i], area_of.get(id_), edge)
        if lane is None:
            continue
        fids = table.columns["traffic_light_stop_line_fids"][i]
        stops = stop_lines_of(fids, shapes.baselines[True][id_], stop_lines)
        lane.predecessors = [start] if (start := exits[i]) else []
        lane.successors = [end] if (end := entries[i]) else []
        lane.speed_limit = _optional(table.columns["speed_limit_mps"][i])
        lane.intersection = crossing.get(lane.roadblock)
        lane.has_traffic_light = bool(fids)
        lane.stop_line = stops[0] if stops else None
        lanes[id_] = lane
    return lanes


def _roadblocks(
    layers: Mapping[str, Layer], lanes: Mapping[str, RawLane]
) -> dict[str, RawRoadblock]:
    """Builds roadblocks, then connectors.

    Lanes are listed from left to right. nuPlan gives the lanes of a roadblock connector no lateral
    order: they stay in file order.
    """
    table = layers["lanes_polygons"]
    order = dict(zip(table.ids, table.columns["lane_index"], strict=True))
    interior = _grouped([lane.roadblock for lane in lanes.values()], list(lanes))
    groups, connectors = layers["lane_groups_polygons"], layers["lane_group_connectors"]
    froms, tos = (connectors.references(f"{end}_lane_group_fid") for end in ("from", "to"))
    outgoing, incoming = _grouped(froms, connectors.ids), _grouped(tos, connectors.ids)
    blocks = {
        id_: RawRoadblock(
            id=id_,
            is_connector=False,
            polygon=area,
            lanes=sorted(interior[id_], key=lambda lane: order[lane]),
            successors=outgoing[id_],
            predecessors=incoming[id_],
        )
        for id_, area in groups.shapes().items()
    }
    for i, (id_, area) in enumerate(connectors.shapes().items()):
        blocks[id_] = RawRoadblock(
            id=id_,
            is_connector=True,
            polygon=area,
            lanes=interior[id_],
            successors=[end] if (end := tos[i]) else [],
            predecessors=[start] if (start := froms[i]) else [],
        )
    return blocks
