"""Picks the part of a map that one scenario needs; search trees and grid are shared by many."""

import operator
from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.grid import build_grid
from spdm_jax.io.raw import RawArea, RawMap
from spdm_jax.types import PolygonGrid


class MapIndex:
    """Search trees over one map, and its latest grid, to use for all of its scenarios.

    Attributes:
      map: the map.
    """

    def __init__(self, raw_map: RawMap) -> None:
        self.map = raw_map
        self._lane_ids = list(raw_map.lanes)
        self._block_ids = list(raw_map.roadblocks)
        self._lane_tree = shapely.STRtree([_lane_area(x.polygon) for x in raw_map.lanes.values()])
        self._block_tree = shapely.STRtree([x.polygon for x in raw_map.roadblocks.values()])
        # Lanes that their roadblock does not list come after those that it does.
        listed: dict[str, dict[str, None]] = {
            key: {lane: None for lane in block.lanes if lane in raw_map.lanes}
            for key, block in raw_map.roadblocks.items()
        }
        for key, lane in raw_map.lanes.items():
            if lane.roadblock in listed:
                listed[lane.roadblock].setdefault(key)
        self._lanes_of = {key: list(lanes) for key, lanes in listed.items()}
        self._trees = {
            layer: shapely.STRtree([area.polygon for area in areas])
            for layer, areas in _areas(raw_map).items()
        }
        self._grid: tuple[list[str], list[RawArea], PolygonGrid, np.ndarray] | None = None

    def crop(self, path: np.ndarray, roadblocks: Sequence[str], margin: float) -> RawMap:
        """Returns what lies within `margin` of a path or of some roadblocks, never cut.

        A roadblock near enough, or with a lane near enough, comes with all its lanes; a lane comes
        with its intersection and stop line.

        Args:
          path: `[N, 2]` positions joined by straight lines, N >= 1.
          roadblocks: ids of roadblocks of the map.
          margin: m.
        """
        whole = self.map
        line = shapely.LineString(path) if len(path) > 1 else shapely.Point(path[0])
        reach = np.array([line, *(whole.roadblocks[key].polygon for key in roadblocks)])

        near_lanes = [self._lane_ids[i] for i in _near(self._lane_tree, reach, margin)]
        chosen = {self._block_ids[i] for i in _near(self._block_tree, reach, margin)}
        chosen.update(roadblocks)
        chosen.update(whole.lanes[lane].roadblock for lane in near_lanes)
        blocks = {key: block for key, block in whole.roadblocks.items() if key in chosen}
        lanes = {key: whole.lanes[key] for block in blocks for key in self._lanes_of[block]}
        for key in near_lanes:
            lanes.setdefault(key, whole.lanes[key])

        needed = {
            "intersections": {lane.intersection for lane in lanes.values()},
            "stop_lines": {lane.stop_line for lane in lanes.values()},
        }
        kept: dict[str, list[RawArea]] = {}
        for layer, areas in _areas(whole).items():
            rows = set(_near(self._trees[layer], reach, margin))
            ids = needed.get(layer, set())
            kept[layer] = [area for i, area in enumerate(areas) if i in rows or area.id in ids]
        return RawMap(name=whole.name, lanes=lanes, roadblocks=blocks, **kept)

    def grid(self, part: RawMap, origin: np.ndarray) -> PolygonGrid:
        """Returns the grid over lanes, car parks and intersections of a part of this map.

        It is computed about the corner of those lanes, not about the scenario's origin: so
        scenarios that keep the same part share it, and whether they do leaves no trace in it.

        Args:
          part: as `crop` returns it.
          origin: `[2]` origin of the scenario's local frame.
        """
        lanes, areas = list(part.lanes), [*part.car_parks, *part.intersections]
        if self._grid is None or self._grid[0] != lanes or not _same(self._grid[1], areas):
            corner = np.floor(np.min([x.polygon.min(0) for x in part.lanes.values()], axis=0))
            polygons = [shapely.Polygon(lane.polygon - corner) for lane in part.lanes.values()]
            shapes = np.array([area.polygon for area in areas], object)
            shapes = shapely.transform(shapes, lambda xy: xy - corner)
            self._grid = lanes, areas, build_grid([*polygons, *shapes]), corner
        _, _, grid, corner = self._grid
        return grid.replace(origin=grid.origin + (corner - origin))


def _same(first: Sequence[RawArea], second: Sequence[RawArea]) -> bool:
    return len(first) == len(second) and all(map(operator.is_, first, second))


def _areas(raw_map: RawMap) -> dict[str, list[RawArea]]:
    return {
        "intersections": raw_map.intersections,
        "car_parks": raw_map.car_parks,
        "drivable": raw_map.drivable,
        "crosswalks": raw_map.crosswalks,
        "walkways": raw_map.walkways,
        "stop_lines": raw_map.stop_lines,
    }


def _near(tree: shapely.STRtree, reach: np.ndarray, margin: float) -> Iterable[int]:
    """Returns the rows within `margin` of any geometry of `reach`, ascending."""
    return np.unique(tree.query(reach, predicate="dwithin", distance=margin)[1]).tolist()


def _lane_area(ring: np.ndarray) -> BaseGeometry:
    # A ring that is no polygon is refused once a scenario keeps it, so it needs a place as well.
    real = ring[np.isfinite(ring).all(axis=1)]
    closed = len(real) > 0 and np.array_equal(real[0], real[-1])
    if len(real) == len(ring) and len(ring) >= 3 + closed:
        return shapely.Polygon(ring)
    return shapely.MultiPoint(real)
