"""Questions to a `RawMap`: what contains a point, what is near, how far along a lane.

Answers are nuPlan's, down to its conventions: "within 10 m" means a square of that half side, a
connector counts as near by its baseline (not its area), an outline belongs to no polygon.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawMap

_HEADING_STEP = 0.5  # m, nuPlan takes the heading at a projection towards the point this far on
_CURVATURE_STEP = 2.0  # m, nuPlan's distance between the three points of a curvature
_FLAT = 1e-6  # m^4, below it nuPlan calls three points collinear


class MapLayer(StrEnum):
    """Kinds of map elements that can be asked for."""

    LANE = "lane"
    LANE_CONNECTOR = "lane_connector"
    ROADBLOCK = "roadblock"
    ROADBLOCK_CONNECTOR = "roadblock_connector"
    INTERSECTION = "intersection"
    CROSSWALK = "crosswalk"
    WALKWAY = "walkway"
    CAR_PARK = "car_park"
    STOP_LINE = "stop_line"
    DRIVABLE = "drivable"


@dataclass(frozen=True)
class Projection:
    """A point projected onto a lane's baseline.

    Attributes:
      arc_length: m from the baseline's start.
      pose: `[3]` x, y, heading on the baseline.
    """

    arc_length: float
    pose: np.ndarray


class MapQuery:
    """Spatial index over one map; results keep the map's own order.

    Args:
      raw_map: the map; not copied, must not change afterwards.
    """

    def __init__(self, raw_map: RawMap) -> None:
        self.map = raw_map

    def ids(self, layer: MapLayer) -> list[str]:
        """Returns the ids of a layer in the order of the map."""
        return self._shapes[layer][0]

    def containing(self, layer: MapLayer, points: np.ndarray) -> list[list[str]]:
        """Returns, for each of the `[N, 2]` points, the elements whose area contains it."""
        ids, _ = self._shapes[layer]
        found: list[list[str]] = [[] for _ in points]
        for point, element in self._pairs(layer, points):
            found[point].append(ids[element])
        return found

    def is_drivable(self, points: np.ndarray) -> np.ndarray:
        """Tells for each of the `[N, 2]` points whether it is in the drivable area. `[N]` bool."""
        drivable = np.zeros(len(points), bool)
        drivable[[point for point, _ in self._pairs(MapLayer.DRIVABLE, points)]] = True
        return drivable

    def near(self, layer: MapLayer, point: np.ndarray, radius: float) -> list[str]:
        """Returns the elements that touch the square of half side `radius` (m) around a point."""
        ids, shapes = self._shapes[layer]
        if layer is MapLayer.LANE_CONNECTOR:
            shapes = np.array([self._baselines[i] for i in ids], object)
        x, y = point
        patch = shapely.box(x - radius, y - radius, x + radius, y + radius)
        return [ids[i] for i in np.flatnonzero(shapely.intersects(shapes, patch))]

    def nearest(self, layer: MapLayer, point: np.ndarray) -> tuple[str, float]:
        """Returns the element nearest to a point and its distance, m (0 inside).

        Raises:
          ValueError: the map has no element of this layer.
        """
        ids, shapes = self._shapes[layer]
        if not ids:
            raise ValueError(f"map {self.map.name!r} has no {layer.value}; ask for another layer")
        distance = shapely.distance(shapes, shapely.Point(point))
        return ids[int(np.argmin(distance))], float(distance.min())

    def project(self, lane: str, point: np.ndarray) -> Projection:
        """Projects a point onto a lane's baseline."""
        line = self._baselines[lane]
        at = float(line.project(shapely.Point(point)))
        here, ahead = _at(line, at), _at(line, at + _HEADING_STEP)
        if (here == ahead).all():
            # At the very end the heading is taken backwards.
            step = here - _at(line, at - _HEADING_STEP)
        else:
            step = ahead - here
        return Projection(at, np.array([*here, np.arctan2(step[1], step[0])]))

    def curvature(self, lane: str, arc_length: float) -> float:
        """Returns the signed curvature (left positive) of a lane's baseline, 1/m.

        That of the circle through three points 2 m apart, moved inside the line at its ends.

        Raises:
          ValueError: `arc_length` is not on the baseline.
        """
        line = self._baselines[lane]
        if not 0.0 <= arc_length <= line.length:
            raise ValueError(
                f"arc_length is {arc_length}; lane {lane!r} runs from 0 to {line.length} m"
            )
        step = min(_CURVATURE_STEP, line.length / 2)
        middle = min(max(arc_length, step), line.length - step)
        a, b, c = (_at(line, middle + k * step) for k in (-1, 0, 1))
        ab, bc, ca = (float(np.hypot(*d)) for d in (b - a, c - b, a - c))
        squared = (ab + bc + ca) * (ca - ab + bc) * (ca + ab - bc) * (ab + bc - ca)
        if squared < _FLAT:
            return 0.0
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        return float(np.sign(turn) * np.sqrt(squared) / (ab * bc * ca))

    def roadblocks_along(self, points: np.ndarray) -> list[str]:
        """Returns the roadblocks and roadblock connectors that a driven path passes, in order.

        A point in a roadblock settles it. In overlapping connectors the following points decide,
        and after a settled one its successors are tried first. Source: nuPlan's route extraction;
        differs: overlapping roadblocks wait for the next points, where nuPlan stops with an error.

        Args:
          points: `[N, 2]` rear-axle positions in order of time.
        """
        blocks = self._containing_blocks(points)
        route: list[str] = []
        candidates: list[str] = []
        for point, (inside, fallback) in zip(points, blocks, strict=True):
            if route and self._block_contains(route[-1], point):
                continue
            if route and not candidates:
                candidates = list(self.map.roadblocks[route[-1]].successors)
            candidates = [block for block in candidates if block in inside] or fallback
            if len(candidates) == 1:
                route.append(candidates[0])
                candidates = []
        return route

    def _containing_blocks(self, points: np.ndarray) -> list[tuple[set[str], list[str]]]:
        """Returns per point all blocks around it, and the ones that settle where it is."""
        plain = self.containing(MapLayer.ROADBLOCK, points)
        joining = self.containing(MapLayer.ROADBLOCK_CONNECTOR, points)
        return [({*a, *b}, a or b) for a, b in zip(plain, joining, strict=True)]

    def _block_contains(self, block: str, point: np.ndarray) -> bool:
        return bool(shapely.contains_xy(self.map.roadblocks[block].polygon, *point))

    def _pairs(self, layer: MapLayer, points: np.ndarray) -> list[tuple[int, int]]:
        """Returns (point, element) index pairs, by point and then in map order."""
        points = np.asarray(points, np.float64).reshape(-1, 2)
        pairs = self._tree(layer).query(shapely.points(points), predicate="within")
        return sorted(zip(*pairs.tolist(), strict=True))

    def _tree(self, layer: MapLayer) -> shapely.STRtree:
        if layer not in self._trees:
            self._trees[layer] = shapely.STRtree(self._shapes[layer][1])
        return self._trees[layer]

    @cached_property
    def _trees(self) -> dict[MapLayer, shapely.STRtree]:
        return {}

    @cached_property
    def _baselines(self) -> dict[str, LineString]:
        return {i: LineString(lane.centerline[:, :2]) for i, lane in self.map.lanes.items()}

    @cached_property
    def _shapes(self) -> dict[MapLayer, tuple[list[str], np.ndarray]]:
        """Layer -> ids and areas."""
        lanes, blocks = self.map.lanes.values(), self.map.roadblocks.values()
        elements: dict[MapLayer, Sequence[tuple[str, BaseGeometry]]] = {
            MapLayer.LANE: [
                (e.id, shapely.Polygon(e.polygon)) for e in lanes if not e.is_connector
            ],
            MapLayer.LANE_CONNECTOR: [
                (e.id, shapely.Polygon(e.polygon)) for e in lanes if e.is_connector
            ],
            MapLayer.ROADBLOCK: [(e.id, e.polygon) for e in blocks if not e.is_connector],
            MapLayer.ROADBLOCK_CONNECTOR: [(e.id, e.polygon) for e in blocks if e.is_connector],
        }
        areas = {
            MapLayer.INTERSECTION: self.map.intersections,
            MapLayer.CROSSWALK: self.map.crosswalks,
            MapLayer.WALKWAY: self.map.walkways,
            MapLayer.CAR_PARK: self.map.car_parks,
            MapLayer.STOP_LINE: self.map.stop_lines,
            MapLayer.DRIVABLE: self.map.drivable,
        }
        elements |= {layer: [(e.id, e.polygon) for e in found] for layer, found in areas.items()}
        return {
            layer: ([i for i, _ in found], np.array([shape for _, shape in found], object))
            for layer, found in elements.items()
        }


def _at(line: LineString, arc_length: float) -> np.ndarray:
    """Returns the point `[2]` of a line; like nuPlan, negative lengths count from its end."""
    return shapely.get_coordinates(line.interpolate(arc_length))[0]
