"""Every leaf of a `Scenario`: its path, type and axes, written down once.

Scenario files are checked against this table and batches are padded by it, so a field added to
`spdm_jax.types` needs one line here.
"""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_type_hints

import numpy as np
from flax import struct

from spdm_jax.types import Scenario


@dataclass(frozen=True)
class Leaf:
    """Type and axes of one leaf.

    Attributes:
      dtype: NumPy name of the host type.
      axes: name of a free axis, or its fixed length, for each dimension.
      fill: value of padded entries.
    """

    dtype: str
    axes: tuple[str | int, ...]
    fill: int = 0


def _polylines(path: str, rows: str, points: str) -> dict[str, Leaf]:
    return {
        f"{path}.points": Leaf("float64", (points, 3)),
        f"{path}.row": Leaf("int32", (points,)),
        f"{path}.valid": Leaf("bool", (points,)),
        f"{path}.start": Leaf("int32", (rows,)),
        f"{path}.count": Leaf("int32", (rows,)),
    }


def _polygons(path: str, rows: str, edges: str) -> dict[str, Leaf]:
    return {
        f"{path}.xy": Leaf("float64", (edges, 2)),
        f"{path}.next_xy": Leaf("float64", (edges, 2)),
        f"{path}.row": Leaf("int32", (edges,)),
        f"{path}.valid": Leaf("bool", (edges,)),
        f"{path}.start": Leaf("int32", (rows,)),
        f"{path}.count": Leaf("int32", (rows,)),
    }


_EGO_FIELDS = (
    "x",
    "y",
    "heading",
    "vx",
    "vy",
    "ax",
    "ay",
    "steering",
    "steering_rate",
    "yaw_rate",
    "yaw_acceleration",
)
_TRACK_FIELDS = ("x", "y", "heading", "vx", "vy", "length", "width")
_LANE, _BLOCK = "map.lanes", "map.roadblocks"
_INDEX = -1

LEAVES: dict[str, Leaf] = {
    f"{_LANE}.valid": Leaf("bool", ("lanes",)),
    f"{_LANE}.is_connector": Leaf("bool", ("lanes",)),
    **_polylines(f"{_LANE}.centerline", "lanes", "centerline_points"),
    **_polylines(f"{_LANE}.left_boundary", "lanes", "left_boundary_points"),
    **_polylines(f"{_LANE}.right_boundary", "lanes", "right_boundary_points"),
    **_polygons(f"{_LANE}.polygon", "lanes", "lane_edges"),
    f"{_LANE}.length": Leaf("float64", ("lanes",)),
    f"{_LANE}.successors": Leaf("int32", ("lanes", "lane_links"), _INDEX),
    f"{_LANE}.predecessors": Leaf("int32", ("lanes", "lane_links"), _INDEX),
    f"{_LANE}.left_neighbor": Leaf("int32", ("lanes",), _INDEX),
    f"{_LANE}.right_neighbor": Leaf("int32", ("lanes",), _INDEX),
    f"{_LANE}.roadblock": Leaf("int32", ("lanes",), _INDEX),
    f"{_LANE}.intersection": Leaf("int32", ("lanes",), _INDEX),
    f"{_LANE}.speed_limit": Leaf("float64", ("lanes",)),
    f"{_LANE}.has_traffic_light": Leaf("bool", ("lanes",)),
    f"{_LANE}.stop_line": Leaf("int32", ("lanes",), _INDEX),
    f"{_BLOCK}.valid": Leaf("bool", ("roadblocks",)),
    f"{_BLOCK}.is_connector": Leaf("bool", ("roadblocks",)),
    **_polygons(f"{_BLOCK}.polygon", "roadblocks", "roadblock_edges"),
    f"{_BLOCK}.successors": Leaf("int32", ("roadblocks", "roadblock_links"), _INDEX),
    f"{_BLOCK}.predecessors": Leaf("int32", ("roadblocks", "roadblock_links"), _INDEX),
    **_polygons("map.intersections", "intersections", "intersection_edges"),
    "map.intersection_type": Leaf("int32", ("intersections",)),
    **_polygons("map.car_parks", "car_parks", "car_park_edges"),
    **_polygons("map.drivable", "drivable", "drivable_edges"),
    "map.drivable_kind": Leaf("int32", ("drivable",)),
    **_polygons("map.crosswalks", "crosswalks", "crosswalk_edges"),
    **_polygons("map.walkways", "walkways", "walkway_edges"),
    **_polygons("map.stop_lines", "stop_lines", "stop_line_edges"),
    "map.stop_line_type": Leaf("int32", ("stop_lines",)),
    "map.grid.origin": Leaf("float64", (2,)),
    "map.grid.cell_size": Leaf("float64", ()),
    "map.grid.shape": Leaf("int32", (2,)),
    "map.grid.cell_row": Leaf("int32", ("grid_cells",)),
    "map.grid.row_mask": Leaf("int32", ("grid_rows",)),
    "map.grid.edge_start": Leaf("int32", ("grid_rows",)),
    "map.grid.edge_count": Leaf("int32", ("grid_rows",)),
    "map.grid.masks": Leaf("uint32", ("grid_masks", "grid_words")),
    "map.grid.edges": Leaf("float64", ("grid_edges", 4)),
    "map.grid.edge_polygon": Leaf("int32", ("grid_edges",), _INDEX),
    "route.roadblocks": Leaf("int32", ("route_roadblocks",), _INDEX),
    "route.given_roadblocks": Leaf("int32", ("route_roadblocks",), _INDEX),
    "route.lane_on_route": Leaf("bool", ("lanes",)),
    "route.slot_of_lane": Leaf("int32", ("lanes",), _INDEX),
    "route.start_lane": Leaf("int32", ("slots",), _INDEX),
    "route.centerline_lanes": Leaf("int32", ("slots", "sequence"), _INDEX),
    "route.reaches_goal": Leaf("bool", ("slots",)),
    "route.goal_lanes": Leaf("int32", ("slots", "sequence"), _INDEX),
    "route.branch_lanes": Leaf("int32", ("branches", "sequence"), _INDEX),
    "route.branch_start": Leaf("int32", ("branches",), _INDEX),
    "route.mission_goal": Leaf("float64", (3,)),
    "route.has_mission_goal": Leaf("bool", ()),
    **{f"ego.{name}": Leaf("float64", ("time",)) for name in _EGO_FIELDS},
    "ego_valid": Leaf("bool", ("time",)),
    **{f"tracks.{name}": Leaf("float64", ("tracks", "time")) for name in _TRACK_FIELDS},
    "tracks.valid": Leaf("bool", ("tracks", "time")),
    "tracks.type": Leaf("int32", ("tracks",)),
    "lights": Leaf("int8", ("time", "lanes")),
    "time": Leaf("float64", ("time",)),
    "num_history": Leaf("int32", ()),
    "num_iterations": Leaf("int32", ()),
    "origin": Leaf("float64", (2,)),
}
"""Leaves of a `Scenario` by field path."""

KINDS = {path: np.dtype(leaf.dtype) for path, leaf in LEAVES.items()}
"""Host types of the leaves by field path."""


def leaves_of(tree: struct.PyTreeNode) -> dict[str, Any]:
    """Returns the leaves of a scenario (batch, or part) by field path, in the order of fields."""
    leaves: dict[str, Any] = {}
    _collect(tree, "", leaves)
    return leaves


def _collect(node: struct.PyTreeNode, prefix: str, leaves: dict[str, Any]) -> None:
    for name, kind in _fields(type(node)):
        value = getattr(node, name)
        if kind is None:
            leaves[prefix + name] = value
        else:
            _collect(value, f"{prefix}{name}.", leaves)


def from_leaves(leaves: Mapping[str, Any]) -> Scenario:
    """Inverse of `leaves_of`.

    Raises:
      KeyError: a path is missing.
    """
    return _assemble(Scenario, "", leaves)


def _assemble(node: type, prefix: str, leaves: Mapping[str, Any]) -> Any:
    values = {}
    for name, kind in _fields(node):
        path = prefix + name
        values[name] = leaves[path] if kind is None else _assemble(kind, f"{path}.", leaves)
    return node(**values)


@functools.cache
def _fields(node: type) -> tuple[tuple[str, type | None], ...]:
    """Fields of a node, each with its class where it is a node itself."""
    hints = get_type_hints(node)
    nested = lambda kind: isinstance(kind, type) and issubclass(kind, struct.PyTreeNode)
    names = [field.name for field in dataclasses.fields(node)]
    return tuple((name, hints[name] if nested(hints[name]) else None) for name in names)


def check_leaves(leaves: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Checks types and shapes against `LEAVES` and returns the length of every free axis.

    Raises:
      ValueError: a leaf has another type, number of axes or length than the table (or an earlier
        leaf with the same axis) says; names path and both values.
    """
    sizes: dict[str, int] = {}
    origin: dict[str, str] = {}
    for path, leaf in LEAVES.items():
        array = leaves[path]
        if array.dtype != KINDS[path]:
            raise ValueError(f"{path}: dtype {array.dtype}, expected {leaf.dtype}")
        if array.ndim != len(leaf.axes):
            raise ValueError(f"{path}: shape {array.shape}, expected axes {leaf.axes}")
        for axis, size in zip(leaf.axes, array.shape, strict=True):
            if isinstance(axis, int):
                if size != axis:
                    raise ValueError(f"{path}: shape {array.shape}, expected axes {leaf.axes}")
            elif sizes.setdefault(axis, size) != size:
                raise ValueError(
                    f"{path}: shape {array.shape}, but {origin[axis]} has {sizes[axis]} {axis}"
                )
            else:
                origin.setdefault(axis, path)
    return sizes
