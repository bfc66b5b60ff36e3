"""Compares a map as the reader gives it with recorded answers of nuPlan's map classes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.nuplan_map import find_map, line_headings, read_layers
from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock
from tests.parity.loader_table import TOLERANCE, Table

AREA_TOLERANCE = 1e-3  # m^2, areas of outlines 4e6 m from the origin
PROXIMITY = 10.0  # m, as recorded

_LAYERS = {
    "LANE": MapLayer.LANE,
    "LANE_CONNECTOR": MapLayer.LANE_CONNECTOR,
    "ROADBLOCK": MapLayer.ROADBLOCK,
    "ROADBLOCK_CONNECTOR": MapLayer.ROADBLOCK_CONNECTOR,
    "INTERSECTION": MapLayer.INTERSECTION,
    "CROSSWALK": MapLayer.CROSSWALK,
    "WALKWAYS": MapLayer.WALKWAY,
    "CARPARK_AREA": MapLayer.CAR_PARK,
    "STOP_LINE": MapLayer.STOP_LINE,
}
_DRIVABLE_LAYERS = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas")


def check_layer_sizes(table: Table, maps: Path, location: str, golden: Mapping[str, int]) -> None:
    """Compares the number of features per layer, the union of drivable layers included."""
    sizes = {name: len(layer.ids) for name, layer in read_layers(find_map(maps, location)).items()}
    sizes["drivable_area"] = sum(sizes[name] for name in _DRIVABLE_LAYERS)
    for name, count in golden.items():
        table.equal("layer_sizes", sizes.get(name), count)


def check_map(table: Table, raw_map: RawMap, golden: Mapping[str, Any]) -> None:
    """Compares every recorded map element; a part or field without a check is a mismatch."""
    lanes, blocks = raw_map.lanes, raw_map.roadblocks
    tables: dict[str, Mapping[str, Any]] = {
        "lanes": {i: lane for i, lane in lanes.items() if not lane.is_connector},
        "lane_connectors": {i: lane for i, lane in lanes.items() if lane.is_connector},
        "roadblocks": {i: block for i, block in blocks.items() if not block.is_connector},
        "roadblock_connectors": {i: block for i, block in blocks.items() if block.is_connector},
    }
    areas = {
        "stop_polygons": raw_map.stop_lines,
        "intersections": raw_map.intersections,
        "carpark_areas": raw_map.car_parks,
        "crosswalks": raw_map.crosswalks,
        "walkways": raw_map.walkways,
        "drivable_area": raw_map.drivable,
    }
    query = MapQuery(raw_map)
    for part, theirs in golden.items():
        if part in tables:
            table.equal(f"{part} ids", list(tables[part]), list(theirs))
            for id_ in tables[part].keys() & theirs.keys():
                _check_element(table, part, query, tables[part][id_], theirs[id_])
        elif part in areas:
            entries = theirs if isinstance(theirs, list) else _with_ids(theirs)
            table.equal(f"{part} ids", [a.id for a in areas[part]], [e["id"] for e in entries])
            for area, entry in zip(areas[part], entries, strict=False):
                _check_element(table, part, query, area, entry)
        elif part not in ("map_name", "layer_sizes", "points"):
            table.equal(f"{part} (no check)", None, part)


def check_points(table: Table, raw_map: RawMap, golden: Sequence[Mapping[str, Any]]) -> None:
    """Compares what contains, is near and is nearest to recorded points."""
    query = MapQuery(raw_map)
    points = np.array([entry["xy"] for entry in golden])
    drivable = query.is_drivable(points)
    containing = {name: query.containing(layer, points) for name, layer in _LAYERS.items()}
    for i, entry in enumerate(golden):
        table.equal("points drivable", bool(drivable[i]), entry["drivable"])
        for name, ids in entry["objects"].items():
            table.equal(f"points in {name}", containing[name][i], ids)
        for name, ids in entry["proximal_10m"].items():
            table.equal(f"points near {name}", query.near(_LAYERS[name], points[i], PROXIMITY), ids)
        lane, distance = query.nearest(MapLayer.LANE, points[i])
        # Of lanes at equal distance the recording names one at random (an unstable sort).
        theirs = entry["nearest_lane"][0]
        tied = shapely.Polygon(raw_map.lanes[theirs].polygon).distance(shapely.Point(points[i]))
        table.equal("points nearest_lane", lane if distance < tied else theirs, theirs)
        table.close("points nearest_lane distance", distance, entry["nearest_lane"][1])
        projected, ours = entry["nearest_lane_projection"], query.project(theirs, points[i])
        table.close("points projection s", ours.arc_length, projected["s"])
        table.poses("points projection pose", ours.pose, projected["pose"])


def _with_ids(entries: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{"id": id_, **entry} for id_, entry in entries.items()]


def _check_element(
    table: Table,
    part: str,
    query: MapQuery,
    ours: RawLane | RawRoadblock | RawArea,
    golden: Mapping[str, Any],
) -> None:
    for name, theirs in golden.items():
        row = f"{part} {name}"
        if name == "polygon":
            _check_polygon(table, row, _polygon(ours), theirs)
        elif name in ("baseline", "left_boundary", "right_boundary"):
            _check_line(table, row, _line(ours, name), theirs)
        elif name in ("incoming", "outgoing", "interior"):
            # Graph edges have no order of their own; neither have the lanes of a block.
            table.equal(row, sorted(_edges(ours, name)), sorted(theirs))
        elif name == "curvature_at_start":
            table.close(row, query.curvature(ours.id, 0.0), theirs)
        elif name == "speed_limit_mps":
            table.close(row, ours.speed_limit, theirs)  # type: ignore[union-attr]
        else:
            table.equal(row, _discrete(query.map, ours, name, theirs), theirs)


def _discrete(raw_map: RawMap, ours: Any, name: str, theirs: Any) -> Any:
    """Returns our value of a discrete field, in the recording's form."""
    if name in ("stop_lines", "stop_polygon_ids"):
        # The library keeps one stop line of a connector: the first.
        return [ours.stop_line, *theirs[1:]] if ours.stop_line else []
    if name in ("index", "lane_index"):
        return list(raw_map.roadblocks[ours.roadblock].lanes).index(ours.id)
    if name == "intersection":
        members = {raw_map.lanes[lane].intersection for lane in ours.lanes}
        return members.pop() if len(members) == 1 else sorted(map(str, members))
    fields = {
        "id": "id",
        "roadblock": "roadblock",
        "roadblock_id": "roadblock",
        "left": "left_neighbor",
        "right": "right_neighbor",
        "has_traffic_lights": "has_traffic_light",
        "type": "kind",
    }
    return getattr(ours, fields[name]) if name in fields else f"{name}: no check"


def _edges(ours: Any, name: str) -> list[str]:
    by_name = {"incoming": "predecessors", "outgoing": "successors", "interior": "lanes"}
    return list(getattr(ours, by_name[name]))


def _line(ours: Any, name: str) -> np.ndarray:
    return ours.centerline[:, :2] if name == "baseline" else getattr(ours, name)


def _polygon(ours: RawLane | RawRoadblock | RawArea) -> BaseGeometry:
    return shapely.Polygon(ours.polygon) if isinstance(ours, RawLane) else ours.polygon


def _check_line(table: Table, row: str, xy: np.ndarray, theirs: Any) -> None:
    """Points of a line, or its length, number of points and end poses."""
    if isinstance(theirs, list):
        table.close(row, xy, theirs)
        return
    poses = np.column_stack([xy, line_headings(xy)])
    table.equal(f"{row} n", len(xy), theirs["n"])
    table.close(f"{row} length", shapely.LineString(xy).length, theirs["length"])
    table.poses(f"{row} first", poses[0], theirs["first"])
    table.poses(f"{row} last", poses[-1], theirs["last"])


def _check_polygon(table: Table, row: str, ours: BaseGeometry, theirs: Any) -> None:
    """Rings of a polygon, or its area, bounds and number of points."""
    rings = [ours.exterior, *ours.interiors] if isinstance(ours, shapely.Polygon) else []
    if isinstance(theirs, list):
        table.equal(f"{row} rings", len(rings), len(theirs))
        for ring, other in zip(rings, theirs, strict=False):
            table.close(row, shapely.get_coordinates(ring), other)
        return
    count = len(shapely.get_coordinates(rings[0])) if rings else 0
    table.equal(f"{row} n", count, theirs["n"])
    table.close(f"{row} area", ours.area, theirs["area"], AREA_TOLERANCE)
    table.close(f"{row} bounds", ours.bounds, theirs["bounds"], TOLERANCE)
