"""Reads the map of a closed-loop golden through the library's own reader interface."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.build import build_scenario
from spdm_jax.io.nuplan_map import line_headings
from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock, RawScenario, RawTracks
from spdm_jax.padding import PaddingConfig, batch, to_device
from spdm_jax.types import DrivableKind, Scenario, ScenarioInfo, ScenarioMap

# One size for the maps at hand, whose unit scenes have a single lane.
_SIZES = PaddingConfig(
    roadblock_edges=(4096, 16384, 65536),
    grid_cells=(131072, 524288, 2097152),
    grid_edges=(32768, 131072, 524288),
)


@dataclass(frozen=True)
class DevkitMap:
    """A golden's map in the library's structures.

    Attributes:
      scenario: carrier of the map (one standing step of an ego, a route of one roadblock); padded
        to common sizes, so that different maps share compiled programs. NumPy leaves, float64.
      info: identifiers in row order (`lane_ids`, `roadblock_ids`, `intersection_ids`).
      raw: what it was built from.
      extra: what the map file says beyond that, by lane id: `curvature_at_start`,
        `stop_polygon_ids` and so on.
    """

    scenario: Scenario
    info: ScenarioInfo
    raw: RawMap
    extra: Mapping[str, Mapping[str, Any]]

    @property
    def origin(self) -> np.ndarray:
        """`[2]` map coordinates of the local frame, float64."""
        return np.asarray(self.scenario.origin, float)

    def on_device(self, dtype: Any) -> ScenarioMap:
        """Returns the map with JAX leaves of a floating type."""
        return to_device(self.scenario, dtype).map

    def lane_rows(self, ids: Sequence[str]) -> list[int]:
        """Returns the rows of lanes and lane connectors."""
        return [self.info.lane_ids.index(key) for key in ids]


@lru_cache(maxsize=64)
def load_devkit_map(path: Path) -> DevkitMap:
    """Reads and builds the whole map of a golden; nothing of it is cropped away."""
    data = json.loads(path.read_text(encoding="utf-8"))
    raw = raw_devkit_map(data, path.stem)
    first = next(iter(raw.lanes.values()))
    ego = np.zeros((1, 11))
    ego[0, :3] = first.centerline[0]
    empty = np.zeros((0, 1))
    scenario, info = build_scenario(
        RawScenario(
            token=path.stem,
            log_name="golden",
            scenario_type="golden",
            source="golden",
            map=raw,
            time_us=np.zeros(1, np.int64),
            num_history=0,
            num_iterations=1,
            ego=ego,
            ego_valid=np.ones(1, bool),
            tracks=RawTracks(
                ids=[],
                type=np.zeros(0, int),
                pose=np.zeros((0, 1, 3)),
                velocity=np.zeros((0, 1, 2)),
                size=np.zeros((0, 1, 2)),
                valid=empty.astype(bool),
            ),
            lights=[{}],
            route_roadblocks=[first.roadblock],
        ),
        margin=1e6,
    )
    padded = jax.tree.map(lambda leaf: leaf[0], batch([scenario], _SIZES))
    return DevkitMap(padded, info, raw, {**data["lanes"], **data["lane_connectors"]})


def raw_devkit_map(data: Mapping[str, Any], name: str) -> RawMap:
    """Returns the map of a golden file in map coordinates."""
    intersections = {key: _shape(item) for key, item in data["intersections"].items()}
    car_parks = {key: _shape(item) for key, item in data["carpark_areas"].items()}
    blocks = {**data["roadblocks"], **data["roadblock_connectors"]}
    interior = {key: item["interior"] for key, item in blocks.items()}
    lanes: dict[str, RawLane] = {}
    for layer, is_connector in (("lanes", False), ("lane_connectors", True)):
        for key, item in data[layer].items():
            (ring,) = item["polygon"]
            xy = np.asarray(item["baseline"], float)[:, :2]
            middle = shapely.LineString(xy).interpolate(0.5, normalized=True)
            around = [area for area, shape in intersections.items() if shape.covers(middle)]
            row = interior[item["roadblock_id"]]
            place = row.index(key)
            stops = item.get("stop_polygon_ids", [])
            lanes[key] = RawLane(
                id=key,
                is_connector=is_connector,
                roadblock=item["roadblock_id"],
                centerline=np.column_stack([xy, line_headings(xy)]),
                # The file has no lane edges, and nothing here asks for them.
                left_boundary=xy,
                right_boundary=xy,
                polygon=np.asarray(ring, float)[:, :2],
                successors=item["outgoing"],
                predecessors=item["incoming"],
                left_neighbor=row[place - 1] if place and not is_connector else None,
                right_neighbor=row[place + 1]
                if place + 1 < len(row) and not is_connector
                else None,
                speed_limit=item["speed_limit_mps"],
                intersection=around[0] if is_connector and around else None,
                has_traffic_light=bool(item.get("has_traffic_lights", False)),
                stop_line=stops[0] if stops else None,
            )
    roadblocks = {
        key: RawRoadblock(
            id=key,
            is_connector=key in data["roadblock_connectors"],
            polygon=_shape(item),
            lanes=item["interior"],
            successors=item["outgoing"],
            predecessors=item["incoming"],
        )
        for key, item in blocks.items()
    }

    def kind(key: str) -> DrivableKind:
        if key in intersections:
            return DrivableKind.INTERSECTION
        # The file does not tell road segments from generic areas.
        return DrivableKind.CAR_PARK if key in car_parks else DrivableKind.ROAD_SEGMENT

    return RawMap(
        name=name,
        lanes=lanes,
        roadblocks=roadblocks,
        intersections=[RawArea(key, shape) for key, shape in intersections.items()],
        car_parks=[RawArea(key, shape) for key, shape in car_parks.items()],
        drivable=[
            RawArea(item["id"], _shape(item), kind(item["id"])) for item in data["drivable_area"]
        ],
        crosswalks=[RawArea(key, _shape(item)) for key, item in data["crosswalks"].items()],
        stop_lines=[RawArea(key, _shape(item)) for key, item in data["stop_polygons"].items()],
    )


def _shape(item: Mapping[str, Any]) -> BaseGeometry:
    parts = [shapely.Polygon(np.asarray(ring, float)[:, :2]) for ring in item["polygon"]]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)
