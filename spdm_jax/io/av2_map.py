"""Argoverse 2 vector maps: `log_map_archive_*.json` -> `RawMap`.

The archive knows lane segments with two boundaries and links, drivable areas and crossings. What it
lacks is derived here: centre lines, roadblocks (rows of same-direction neighbours), roadblock
connectors and intersections. Speed limits and traffic lights do not exist in the source and stay
unknown. The lane graph is kept as it is: a lane may follow a lane, a connector a connector.

Bike lanes are left out. A car may not plan along them, and the source lists them like any other
lane; the ground they cover stays part of the drivable areas.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock, ScenarioError
from spdm_jax.types import DrivableKind

CENTERLINE_STEP = 1.0
"""Largest spacing of centre-line points, m (about nuPlan's)."""
SAME_DIRECTION = np.pi / 4
"""Neighbours whose overall headings differ by more are not of one direction, rad."""
INTERSECTION_GAP = 0.3
"""Connectors closer than twice this are one intersection (digitised lines leave slivers), m."""
LANE_TYPES = ("VEHICLE", "BUS")
"""Lane segments kept; the remaining type is BIKE."""

_LAYERS = ("lane_segments", "drivable_areas", "pedestrian_crossings")


def read_map(path: Path) -> RawMap:
    """Reads a map archive of one log.

    Args:
      path: `log_map_archive_*.json`.

    Returns:
      The map in the city frame, m. Identifiers are the source's; a roadblock is named after its
      leftmost lane (`rb_<lane>`), a roadblock connector after its first connector (`rc_<lane>`).

    Raises:
      ScenarioError: the file is missing, no JSON, lacks a layer or a field, or has no car lane.
    """
    archive = _load(path)
    segments = {
        str(row["id"]): row
        for row in _rows(archive, "lane_segments", path)
        if _get(row, "lane_type", path) in LANE_TYPES
    }
    if not segments:
        raise ScenarioError(
            f"{path}: lane_segments has no lane of type {' or '.join(LANE_TYPES)}; "
            "take the log's original map archive"
        )
    lanes = {key: _lane(key, row, path) for key, row in segments.items()}
    lanes = _link(lanes, segments, path)
    roadblocks = _roadblocks(lanes, path)
    roadblocks |= _roadblock_connectors(lanes, roadblocks)
    _drop_neighbors_across_roadblocks(lanes)
    _link_roadblocks(roadblocks, lanes)
    return RawMap(
        name=path.stem.partition("____")[2] or path.stem,
        lanes=lanes,
        roadblocks=roadblocks,
        intersections=_intersections(lanes),
        drivable=[
            RawArea(str(row["id"]), _clean(_xy(row, "area_boundary", path)), DrivableKind.GENERIC)
            for row in _rows(archive, "drivable_areas", path)
        ],
        crosswalks=[
            RawArea(str(row["id"]), _crossing(_xy(row, "edge1", path), _xy(row, "edge2", path)))
            for row in _rows(archive, "pedestrian_crossings", path)
        ],
    )


def centerline(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Returns the mean of two boundaries sampled at equal fractions of their lengths.

    Args:
      left: `[H, 2]` boundary points, m.
      right: `[H, 2]` boundary points, m.

    Returns:
      `[H', 3]` x, y and heading: direction to the following point, the last one repeated (nuPlan's
      rule). Fewer than two rows if the boundaries enclose no length.
    """
    longest = max(_arc_length(left)[-1], _arc_length(right)[-1])
    fraction = np.linspace(0.0, 1.0, max(2, int(np.ceil(longest / CENTERLINE_STEP)) + 1))
    xy = 0.5 * (_at_fraction(left, fraction) + _at_fraction(right, fraction))
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    xy = xy[np.append(True, step > 1e-6)]
    heading = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    return np.column_stack([xy, np.append(heading, heading[-1:])]) if len(xy) > 1 else xy[:0]


def angle_between(a: np.ndarray | float, b: np.ndarray | float) -> np.ndarray:
    """Returns the absolute difference of two angles, in [0, pi], rad."""
    return np.abs((np.subtract(a, b) + np.pi) % (2 * np.pi) - np.pi)


def overall_heading(lane: RawLane) -> float:
    """Returns the direction from the first to the last centre-line point, rad."""
    dx, dy = lane.centerline[-1, :2] - lane.centerline[0, :2]
    return float(np.arctan2(dy, dx))


def _load(path: Path) -> dict[str, Any]:
    try:
        archive = json.loads(path.read_text())
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file; a log needs its map archive") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: not a JSON file ({error}); copy it again") from error
    for layer in _LAYERS:
        if not isinstance(archive, dict) or not isinstance(archive.get(layer), dict):
            raise ScenarioError(
                f"{path}: layer {layer} is missing; expected {', '.join(_LAYERS)} "
                "(an Argoverse 2 log map archive)"
            )
    return archive


def _rows(archive: Mapping[str, Any], layer: str, path: Path) -> list[dict[str, Any]]:
    rows = list(archive[layer].values())
    for row in rows:
        _get(row, "id", path)
    return rows


def _get(row: Mapping[str, Any], name: str, path: Path) -> Any:
    if name not in row:
        raise ScenarioError(
            f"{path}: element {row.get('id', '(without id)')} has no field {name}; "
            "expected the Argoverse 2 map format"
        )
    return row[name]


def _xy(row: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    value = _get(row, name, path)
    try:
        points = np.array([[p["x"], p["y"]] for p in value], float)
    except (KeyError, TypeError, ValueError):
        points = np.empty((0, 2))
    if len(points) < 2 or not np.isfinite(points).all():
        raise ScenarioError(
            f"{path}: element {row['id']}, field {name} is {str(value)[:80]}; "
            "it must be a list of at least 2 points with finite x and y"
        )
    return points


def _lane(key: str, row: Mapping[str, Any], path: Path) -> RawLane:
    left = _xy(row, "left_lane_boundary", path)
    right = _xy(row, "right_lane_boundary", path)
    middle = centerline(left, right)
    parts = _parts(_clean(np.concatenate([left, right[::-1]])))
    if not len(middle) or not parts:
        raise ScenarioError(
            f"{path}: lane segment {key}, left_lane_boundary and right_lane_boundary enclose no "
            "area; remove it from the archive"
        )
    polygon = max(parts, key=lambda p: p.area)
    return RawLane(
        id=key,
        is_connector=bool(_get(row, "is_intersection", path)),
        roadblock="",
        centerline=middle,
        left_boundary=left,
        right_boundary=right,
        polygon=np.asarray(polygon.exterior.coords)[:, :2],
    )


def _link(
    lanes: dict[str, RawLane], segments: Mapping[str, Mapping[str, Any]], path: Path
) -> dict[str, RawLane]:
    """Fills links and neighbours; a link counts if either end declares it (many lack one end)."""
    edges = {}  # a dict keeps the source's order
    for key, row in segments.items():
        edges |= {(key, str(other)): None for other in _get(row, "successors", path)}
    for key, row in segments.items():
        edges |= {(str(other), key): None for other in _get(row, "predecessors", path)}
    edges = [(a, b) for a, b in edges if a in lanes and b in lanes and a != b]
    successors = {key: [b for a, b in edges if a == key] for key in lanes}
    predecessors = {key: [a for a, b in edges if b == key] for key in lanes}

    def neighbor(key: str, side: str, opposite: str) -> str | None:
        other = str(_get(segments[key], f"{side}_neighbor_id", path))
        if other not in lanes or lanes[other].is_connector != lanes[key].is_connector:
            return None
        # An oncoming neighbour names this lane on the same side instead of the opposite one.
        if str(_get(segments[other], f"{opposite}_neighbor_id", path)) != key:
            return None
        turn = angle_between(overall_heading(lanes[key]), overall_heading(lanes[other]))
        return other if turn < SAME_DIRECTION else None

    return {
        key: replace(
            lane,
            successors=successors[key],
            predecessors=predecessors[key],
            left_neighbor=neighbor(key, "left", "right"),
            right_neighbor=neighbor(key, "right", "left"),
        )
        for key, lane in lanes.items()
    }


def _roadblocks(lanes: dict[str, RawLane], path: Path) -> dict[str, RawRoadblock]:
    """Makes one roadblock of every row of neighbouring lanes, and enters it in its lanes."""
    blocks = {}
    for key, lane in lanes.items():
        if lane.is_connector or lane.left_neighbor is not None:
            continue
        row = [key]
        while (right := lanes[row[-1]].right_neighbor) is not None:
            row.append(right)
        blocks[f"rb_{key}"] = _block(f"rb_{key}", row, lanes, is_connector=False)
    for key, lane in lanes.items():
        if not lane.is_connector and not lane.roadblock:
            raise ScenarioError(
                f"{path}: lane segment {key} is a left neighbour of itself through "
                f"left_neighbor_id {lane.left_neighbor}; correct the neighbours"
            )
    return blocks


def _roadblock_connectors(
    lanes: dict[str, RawLane], roadblocks: Mapping[str, RawRoadblock]
) -> dict[str, RawRoadblock]:
    """Groups connectors that lead from the same roadblocks to the same roadblocks.

    Connectors may form chains; the number of links to the roadblock is part of the criterion, so
    that two links of one chain are not taken for parallel lanes. A connector with an end at the
    border of the map stays alone: nothing says where it comes from or leads to.
    """
    groups: dict[object, list[str]] = {}
    for key, lane in lanes.items():
        if not lane.is_connector:
            continue
        origin = _reach(key, lanes, lambda k: lanes[k].predecessors)
        target = _reach(key, lanes, lambda k: lanes[k].successors)
        groups.setdefault((origin, target) if origin and target else key, []).append(key)
    place = {key: i for block in roadblocks.values() for i, key in enumerate(block.lanes)}
    blocks = {}
    for members in groups.values():
        members.sort(
            key=lambda k: (
                min((place.get(p, 0) for p in lanes[k].predecessors), default=0),
                min((place.get(s, 0) for s in lanes[k].successors), default=0),
            )
        )
        name = f"rc_{members[0]}"
        blocks[name] = _block(name, members, lanes, is_connector=True)
    return blocks


def _reach(
    key: str, lanes: Mapping[str, RawLane], step: Callable[[str], Iterable[str]]
) -> frozenset[tuple[str, int]]:
    """Roadblocks reached from a connector through connectors only, with the number of links."""
    found, seen, front, links = set(), {key}, [key], 0
    while front:
        links += 1
        ahead = [k for f in front for k in step(f)]
        found |= {(lanes[k].roadblock, links) for k in ahead if not lanes[k].is_connector}
        front = [k for k in dict.fromkeys(ahead) if lanes[k].is_connector and k not in seen]
        seen |= set(front)
    return frozenset(found)


def _block(
    name: str, members: list[str], lanes: dict[str, RawLane], *, is_connector: bool
) -> RawRoadblock:
    for key in members:
        lanes[key].roadblock = name
    polygon = shapely.union_all([Polygon(lanes[key].polygon) for key in members])
    return RawRoadblock(name, is_connector, polygon, lanes=members)


def _drop_neighbors_across_roadblocks(lanes: dict[str, RawLane]) -> None:
    """Neighbouring connectors that lead to different roadblocks are no choice of lane."""
    for lane in lanes.values():
        for side in ("left_neighbor", "right_neighbor"):
            other = getattr(lane, side)
            if other is not None and lanes[other].roadblock != lane.roadblock:
                setattr(lane, side, None)


def _link_roadblocks(blocks: dict[str, RawRoadblock], lanes: Mapping[str, RawLane]) -> None:
    for name, block in blocks.items():
        after = [lanes[s].roadblock for key in block.lanes for s in lanes[key].successors]
        before = [lanes[p].roadblock for key in block.lanes for p in lanes[key].predecessors]
        block.successors = [b for b in dict.fromkeys(after) if b != name]
        block.predecessors = [b for b in dict.fromkeys(before) if b != name]


def _intersections(lanes: dict[str, RawLane]) -> list[RawArea]:
    """Merges overlapping connectors into areas, and enters these in the connectors."""
    connectors = [lane for lane in lanes.values() if lane.is_connector]
    if not connectors:
        return []
    shapes = [Polygon(lane.polygon) for lane in connectors]
    grown = shapely.union_all(shapely.buffer(shapes, INTERSECTION_GAP, join_style="mitre"))
    grown_parts = [Polygon(part.exterior) for part in _parts(grown)]
    tree = shapely.STRtree(grown_parts)
    part_of = [int(tree.query(s.representative_point(), "within")[0]) for s in shapes]
    areas = {}
    for part in sorted(set(part_of)):
        name = f"in_{connectors[part_of.index(part)].id}"
        shrunk = grown_parts[part].buffer(-INTERSECTION_GAP, join_style="mitre")
        members = [s for s, p in zip(shapes, part_of, strict=True) if p == part]
        # Shrinking may nibble at thin tips: the area covers its connectors in any case.
        areas[part] = RawArea(name, shapely.union_all([shrunk, *members]))
    for lane, part in zip(connectors, part_of, strict=True):
        lane.intersection = areas[part].id
    return list(areas.values())


def _arc_length(points: np.ndarray) -> np.ndarray:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _at_fraction(points: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    s = _arc_length(points)
    at = fraction * s[-1]
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])


def _clean(ring: np.ndarray) -> BaseGeometry:
    """A valid polygon of the same area (the boundaries of merging lanes may cross)."""
    polygon = Polygon(ring) if len(ring) > 2 else Polygon()
    return shapely.union_all(_parts(shapely.make_valid(polygon)))


def _crossing(edge1: np.ndarray, edge2: np.ndarray) -> BaseGeometry:
    # The two edges may run in opposite directions: one of the two orders is a bow tie.
    rings = (np.concatenate([edge1, edge2[::-1]]), np.concatenate([edge1, edge2]))
    return max((_clean(ring) for ring in rings), key=lambda p: p.area)


def _parts(geometry: BaseGeometry) -> list[Polygon]:
    parts = shapely.get_parts(geometry)
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]
