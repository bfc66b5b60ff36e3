"""What a picture shows of one scene, cut out of the padded batches: NumPy, no padding left.

Positions are in the scene's local frame, m. The figure and the page both draw from these, so that
they cannot disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from spdm_jax.config import VehicleParams
from spdm_jax.io.flatten import split_geometries, split_polylines, split_rings
from spdm_jax.results import ScenarioSet
from spdm_jax.types import LightStatus, Scenario

Rings = list[np.ndarray]
"""One polygon: closed rings `[N, 2]`, the outline counter-clockwise, then holes clockwise."""

_TOLERANCE = 0.05  # m; finer detail of the map is not visible


@dataclass(frozen=True)
class MapView:
    """The map around one point.

    Attributes:
      road: drivable area, merged.
      crosswalks: pedestrian crossings, merged.
      route: areas of the route's lanes, merged.
      lane_edges: `[N, 2]` boundaries of lanes (not of connectors).
      centerlines: `[N, 2]` of lanes and connectors.
      red: `[N, 2]` centre lines of connectors whose light is red.
      stop_bars: `[2, 2]` lines across the start of those.
    """

    road: list[Rings]
    crosswalks: list[Rings]
    route: list[Rings]
    lane_edges: list[np.ndarray]
    centerlines: list[np.ndarray]
    red: list[np.ndarray]
    stop_bars: list[np.ndarray]


@dataclass(frozen=True)
class ObjectsView:
    """Objects observed at one step.

    Attributes:
      track: `[N]` rows in `Tracks`.
      ids: identifiers in the source.
      type: `[N]` `ObjectType`.
      pose: `[N, 3]` box centre x, y, heading.
      size: `[N, 2]` length, width.
    """

    track: np.ndarray
    ids: list[str]
    type: np.ndarray
    pose: np.ndarray
    size: np.ndarray


def take_scene(scenes: ScenarioSet, index: int) -> Scenario:
    """Returns one scenario of a set.

    Raises:
      ValueError: there is no such row.
    """
    if not 0 <= index < len(scenes):
        raise ValueError(f"index is {index}; the set has {len(scenes)} scenarios, first one 0")
    return jax.tree.map(lambda values: np.asarray(values)[index], scenes.batch)


def ego_pose(scene: Scenario, step: int, vehicle: VehicleParams) -> np.ndarray:
    """Returns the recorded box centre `[3]` of the ego at a step after iteration 0."""
    at = int(scene.num_history) + step
    ego = scene.ego
    return ego_center(np.array([ego.x[at], ego.y[at], ego.heading[at]]), vehicle)


def ego_center(pose: np.ndarray, vehicle: VehicleParams) -> np.ndarray:
    """Moves rear-axle poses `[..., 3]` to the centre of the ego's box."""
    way = float(vehicle.rear_axle_to_center)
    heading = pose[..., 2]
    shift = np.stack([way * np.cos(heading), way * np.sin(heading), np.zeros_like(heading)], -1)
    return pose + shift


def box_corners(pose: np.ndarray, length, width) -> np.ndarray:
    """Returns corners `[..., 4, 2]` of boxes with centre poses `[..., 3]`.

    Order: front left, rear left, rear right, front right.
    """
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    forward = np.stack([cos, sin], -1) * 0.5 * np.asarray(length)[..., None]
    left = np.stack([-sin, cos], -1) * 0.5 * np.asarray(width)[..., None]
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return np.stack([pose[..., :2] + a * forward + b * left for a, b in signs], -2)


def read_map(scene: Scenario, center: np.ndarray, reach: float, step: int = 0) -> MapView:
    """Cuts the map to a square around a point.

    Args:
      scene: one scenario.
      center: `[2]` m.
      reach: half side of the square, m.
      step: step after iteration 0 whose traffic lights are shown.
    """
    low, high = center[:2] - reach, center[:2] + reach

    def cut(shape: BaseGeometry) -> BaseGeometry:
        return shapely.clip_by_rect(shape, *low, *high)

    def area(shapes: Sequence[BaseGeometry]) -> list[Rings]:
        merged = shapely.union_all([shapely.make_valid(cut(s)) for s in shapes if not s.is_empty])
        return [_rings(p) for p in _parts(shapely.simplify(merged, _TOLERANCE), "Polygon")]

    def lines(points: Sequence[np.ndarray]) -> list[np.ndarray]:
        shapes = [cut(shapely.LineString(p[:, :2])) for p in points if len(p) > 1]
        short = shapely.simplify(np.array(shapes, object), _TOLERANCE)
        return [np.asarray(part.coords) for s in short for part in _parts(s, "LineString")]

    lanes = scene.map.lanes
    chosen = lambda rows, mask: [row for row, yes in zip(rows, mask, strict=True) if yes]
    center_rows = split_polylines(lanes.centerline)
    valid = np.asarray(lanes.valid)
    plain = valid & ~np.asarray(lanes.is_connector)
    red = valid & (np.asarray(scene.lights[int(scene.num_history) + step]) == LightStatus.RED)
    left = split_polylines(lanes.left_boundary)
    right = split_polylines(lanes.right_boundary)
    areas = [shapely.Polygon(ring) for ring in split_rings(lanes.polygon)]
    return MapView(
        road=area(split_geometries(scene.map.drivable)),
        crosswalks=area(split_geometries(scene.map.crosswalks)),
        route=area(chosen(areas, valid & np.asarray(scene.route.lane_on_route))),
        lane_edges=lines([*chosen(left, plain), *chosen(right, plain)]),
        centerlines=lines(chosen(center_rows, valid)),
        red=lines(chosen(center_rows, red)),
        stop_bars=lines(
            [
                np.stack([a[0, :2], b[0, :2]])
                for a, b in zip(chosen(left, red), chosen(right, red), strict=True)
                if len(a) and len(b)
            ]
        ),
    )


def _parts(shape: BaseGeometry, kind: str) -> list[Any]:
    """Flattens collections to non-empty parts of one kind; cutting leaves points and slivers."""
    if shape.is_empty:
        return []
    inner = getattr(shape, "geoms", None)
    if inner is None:
        return [shape] if shape.geom_type == kind else []
    return [part for one in inner for part in _parts(one, kind)]


def _rings(polygon: shapely.Polygon) -> Rings:
    return [np.asarray(ring.coords) for ring in shapely.get_rings(orient(polygon))]


def read_objects(scene: Scenario, ids: Sequence[str], step: int = 0) -> ObjectsView:
    """Returns the objects observed at a step after iteration 0."""
    at = int(scene.num_history) + step
    tracks = scene.tracks
    track = np.flatnonzero(tracks.valid[:, at])
    column = lambda *fields: np.stack([np.asarray(f)[track, at] for f in fields], -1)
    return ObjectsView(
        track=track,
        ids=[ids[int(row)] for row in track],
        type=np.asarray(tracks.type)[track],
        pose=column(tracks.x, tracks.y, tracks.heading),
        size=column(tracks.length, tracks.width),
    )
