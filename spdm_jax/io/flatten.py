"""Ragged geometry to flat arrays and back (host, float64)."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.types import Polygons, Polylines


def polylines(lines: Sequence[np.ndarray], origin: np.ndarray) -> Polylines:
    """Stores polylines back to back.

    Args:
      lines: `[N, 3]` x, y, heading each, or `[N, 2]`: the heading is then that of the segment that
        follows the point (at the last point, of the segment before it; 0 for a single point).
      origin: `[2]` subtracted from the positions.
    """
    count = np.array([len(line) for line in lines], np.int32)
    row = np.repeat(np.arange(len(lines), dtype=np.int32), count)
    columns = max((line.shape[1] for line in lines), default=3)
    flat = np.concatenate([np.zeros((0, columns)), *lines])
    points = np.zeros((len(flat), 3))
    points[:, :2] = flat[:, :2] - origin
    if columns == 3:
        points[:, 2] = flat[:, 2]
    elif len(flat):
        points[:, 2] = _headings(points[:, :2], row)
    return Polylines(
        points=points, row=row, valid=np.ones(len(flat), bool), start=_starts(count), count=count
    )


def _headings(xy: np.ndarray, row: np.ndarray) -> np.ndarray:
    step = np.diff(xy, axis=0)
    inner = row[1:] == row[:-1]
    forward = np.where(inner, np.arctan2(step[:, 1], step[:, 0]), 0.0)
    heading = np.append(forward, 0.0)
    last = np.append(~inner, True)
    before = np.insert(forward, 0, 0.0)
    return np.where(last, before, heading)


def split_polylines(lines: Polylines) -> list[np.ndarray]:
    """Returns the `[N, 3]` points of every row; inverse of `polylines` in the local frame."""
    points = np.asarray(lines.points)
    return [points[a : a + n] for a, n in zip(lines.start, lines.count, strict=True)]


def polygons_of_rings(rings: Sequence[np.ndarray], origin: np.ndarray) -> Polygons:
    """Stores one ring `[V, 2]` per row (closing point optional), in the direction given."""
    count = np.array([len(ring) for ring in rings], int)
    xy = np.concatenate([np.zeros((0, 2)), *rings]) - origin
    ring = np.repeat(np.arange(len(rings)), count)
    return _polygons(xy, ring, np.arange(len(rings)), len(rings))


def polygons_of_geometries(geometries: Sequence[BaseGeometry], origin: np.ndarray) -> Polygons:
    """Stores one Polygon or MultiPolygon per row.

    Outlines run counter-clockwise and holes clockwise, which tells them apart afterwards; a hole
    follows its outline.
    """
    parts, row_of_part = shapely.get_parts(np.array(geometries, object), return_index=True)
    rings, part_of_ring = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    outline = np.diff(part_of_ring, prepend=-1) != 0
    reverse = (shapely.is_ccw(rings) != outline)[ring]
    count = np.bincount(ring, minlength=len(rings))
    first = (np.cumsum(count) - count)[ring]
    place = np.arange(len(xy)) - first
    xy = xy[first + np.where(reverse, count[ring] - 1 - place, place)] - origin
    return _polygons(xy, ring, row_of_part[part_of_ring], len(geometries))


def _polygons(xy: np.ndarray, ring: np.ndarray, row_of_ring: np.ndarray, rows: int) -> Polygons:
    """Closes rings given as points; a point equal to the next of its ring adds no edge."""
    keep = np.any(xy != _following(xy, ring), axis=1)
    xy, ring = xy[keep], ring[keep]
    row = row_of_ring[ring].astype(np.int32)
    count = np.bincount(row, minlength=rows).astype(np.int32)
    return Polygons(
        xy=xy,
        next_xy=_following(xy, ring),
        row=row,
        valid=np.ones(len(xy), bool),
        start=_starts(count),
        count=count,
    )


def _following(xy: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Returns the point after each point within its ring."""
    following = np.roll(xy, -1, axis=0)
    last = np.diff(ring, append=-1) != 0
    first = np.diff(ring, prepend=-1) != 0
    following[last] = xy[first]
    return following


def split_rings(polygons: Polygons) -> list[np.ndarray]:
    """Returns all points of every row as one ring `[V, 2]`; inverse of `polygons_of_rings`."""
    xy = np.asarray(polygons.xy)
    return [xy[a : a + n] for a, n in zip(polygons.start, polygons.count, strict=True)]


def split_geometries(polygons: Polygons) -> list[BaseGeometry]:
    """Returns the geometry of every row; inverse of `polygons_of_geometries`."""
    xy, next_xy = np.asarray(polygons.xy), np.asarray(polygons.next_xy)
    geometries: list[BaseGeometry] = []
    for a, n in zip(polygons.start, polygons.count, strict=True):
        points, following = xy[a : a + n], next_xy[a : a + n]
        cuts = np.flatnonzero(np.any(following[:-1] != points[1:], axis=1)) + 1
        parts: list[tuple[np.ndarray, list[np.ndarray]]] = []
        for ring in np.split(points, cuts):
            if parts and not shapely.is_ccw(shapely.LinearRing(ring)):
                parts[-1][1].append(ring)
            else:
                parts.append((ring, []))
        shapes = [shapely.Polygon(outline, holes) for outline, holes in parts]
        geometries.append(shapes[0] if len(shapes) == 1 else shapely.MultiPolygon(shapes))
    return geometries


def index_table(ids: Iterable[Iterable[str | None]], row_of: Mapping[str, int]) -> np.ndarray:
    """Returns the rows of the ids of each entry, unknown ones left out, -1 padded.

    Args:
      ids: one sequence of ids per entry.
      row_of: row of each known id.

    Returns:
      `[N, W]` int32; W is the length of the longest entry, but at least 1.
    """
    rows = [[row_of[key] for key in entry if key is not None and key in row_of] for entry in ids]
    table = np.full((len(rows), max([1, *map(len, rows)])), -1, np.int32)
    for i, entry in enumerate(rows):
        table[i, : len(entry)] = entry
    return table


def _starts(count: np.ndarray) -> np.ndarray:
    return (np.cumsum(count) - count).astype(np.int32)
