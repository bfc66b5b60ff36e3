"""Turns a stored reference scene into the structures that the library's stages take."""

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax.agents.observation import RedLights, edge_centroids
from spdm_jax.config import IDMParams, VehicleParams
from spdm_jax.geometry import Path, make_path
from spdm_jax.io.grid import build_grid
from spdm_jax.scoring.areas import AreaMasks, pack_bits
from spdm_jax.types import AgentForecast, EgoState, PolygonGrid

STATE_FIELDS = tuple(EgoState.__dataclass_fields__)


def pad(values: np.ndarray, size: int, axis: int = 0, fill=0) -> np.ndarray:
    """Pads one axis up to a size."""
    values = np.asarray(values)
    if values.shape[axis] > size:
        raise ValueError(f"{values.shape[axis]} entries do not fit {size}")
    widths = [(0, 0)] * values.ndim
    widths[axis] = (0, size - values.shape[axis])
    return np.pad(values, widths, constant_values=fill)


def power_bucket(n: int, least: int) -> int:
    """Smallest least x 2^k that holds n."""
    size = least
    while size < n:
        size *= 2
    return size


def ragged(data, name: str) -> list[np.ndarray]:
    """Splits a concatenated array by its offsets."""
    offsets = data[f"{name}_offsets"]
    values = data[f"{name}_points" if name == "path" else f"{name}_xy"]
    return [values[a:b] for a, b in itertools.pairwise(offsets)]


def ego_state(array: np.ndarray, origin: np.ndarray, dtype) -> EgoState:
    """`[..., 11]` reference states to `EgoState` in the local frame."""
    array = np.array(array, float)
    array[..., :2] -= origin
    return EgoState(
        **{name: jnp.asarray(array[..., i], dtype) for i, name in enumerate(STATE_FIELDS)}
    )


def state_array(state: EgoState, origin: np.ndarray) -> np.ndarray:
    """`EgoState` back to `[..., 11]` in the source's frame."""
    array = np.stack([np.asarray(getattr(state, name), float) for name in STATE_FIELDS], -1)
    array[..., :2] += origin
    return array


def padded_grid(polygons, dtype) -> PolygonGrid:
    """Grid with power-of-two sizes, so that many scenes share one compiled program."""
    grid = build_grid(polygons)
    rows = power_bucket(grid.edge_start.shape[0], 2048)
    edges = power_bucket(grid.edges.shape[0], 16384)
    cells = power_bucket(grid.cell_row.shape[0], 32768)
    masks = power_bucket(grid.masks.shape[0], 512)
    words = power_bucket(grid.masks.shape[1], 4)
    return PolygonGrid(
        origin=jnp.asarray(grid.origin, dtype),
        cell_size=jnp.asarray(grid.cell_size, dtype),
        shape=jnp.asarray(grid.shape),
        cell_row=jnp.asarray(pad(grid.cell_row, cells)),
        row_mask=jnp.asarray(pad(grid.row_mask, rows)),
        masks=jnp.asarray(pad(pad(grid.masks, masks), words, 1)),
        edge_start=jnp.asarray(pad(grid.edge_start, rows)),
        edge_count=jnp.asarray(pad(grid.edge_count, rows)),
        edges=jnp.asarray(pad(grid.edges, edges), dtype),
        edge_polygon=jnp.asarray(pad(grid.edge_polygon, edges, fill=-1)),
    )


@dataclass
class GoldenWorld:
    """A stored scene in the library's structures (local frame, padded)."""

    origin: np.ndarray
    vehicle: VehicleParams
    idm: IDMParams
    paths: Path
    grid: PolygonGrid
    masks: AreaMasks
    forecast: AgentForecast
    red: RedLights
    num_objects: int
    num_drivable: int
    num_intersections: int

    def column(self, index: int) -> int:
        """Column of a reference object index (objects, then red lights) in padded arrays."""
        return index if index < self.num_objects else index - self.num_objects + self.size

    @property
    def size(self) -> int:
        """Padded number of objects."""
        return self.forecast.x.shape[0]

    @property
    def columns(self) -> np.ndarray:
        """Columns of all reference objects."""
        lights = int(np.sum(np.asarray(self.red.valid)))
        return np.array([self.column(i) for i in range(self.num_objects + lights)], int)


def vehicle_params(data) -> VehicleParams:
    """Reads the ego's dimensions."""
    width, length, wheel_base, reach = (float(v) for v in data["vehicle_params"][:4])
    return VehicleParams(
        width=width, length=length, wheel_base=wheel_base, rear_axle_to_center=reach
    )


def area_masks(drivable, on_route, num_drivable: int, num_intersections: int, words: int):
    """Bit masks for a grid over drivable polygons followed by intersections."""
    total = num_drivable + num_intersections
    intersection = np.arange(total) >= num_drivable
    lift = lambda flags: jnp.asarray(np.concatenate([flags, np.zeros(num_intersections, bool)]))
    return AreaMasks(
        pack_bits(lift(np.asarray(drivable, bool)), words),
        pack_bits(lift(np.asarray(on_route, bool) & np.asarray(drivable, bool)), words),
        pack_bits(jnp.asarray(intersection), words),
    )


def red_areas(rings: list[np.ndarray], origin, dtype, ignored=None) -> RedLights:
    """Red lane connectors from rings."""
    slots = 8 if len(rings) <= 8 else power_bucket(len(rings), 8)
    edges = [np.concatenate([r[:-1], r[1:]], 1) - np.tile(origin, 2) for r in rings]
    count = power_bucket(sum(map(len, edges)), 256)
    slot = np.concatenate([np.full(len(e), i) for i, e in enumerate(edges)] or [np.zeros(0, int)])
    flat = np.concatenate(edges) if edges else np.zeros((0, 4))
    valid = np.arange(count) < len(flat)
    slot = jnp.asarray(pad(slot.astype(np.int32), count, fill=slots))
    padded = jnp.asarray(pad(flat, count), dtype)
    ring_valid = np.arange(slots) < len(rings)
    ignored = np.zeros(len(rings), bool) if ignored is None else ignored
    return RedLights(
        edges=padded,
        slot=slot,
        edge_valid=jnp.asarray(valid),
        centroid=edge_centroids(padded, slot, jnp.asarray(valid), slots),
        lane=jnp.asarray(np.where(ring_valid, np.arange(slots), -1).astype(np.int32)),
        valid=jnp.asarray(ring_valid),
        ignored=jnp.asarray(pad(np.asarray(ignored, bool), slots)),
        overflow=jnp.asarray(False),
    )


def forecast_from_corners(data, origin, dtype) -> AgentForecast:
    """Objects from stored corners (front left, rear left, rear right, front right)."""
    corners = data["obj_corners"] - origin  # [S, n, 4, 2]
    num = corners.shape[1]
    size = power_bucket(max(num, 1), 16 if num <= 16 else 64)
    center = corners.mean(2)
    front = corners[:, :, 0] - corners[:, :, 1]
    side = corners[:, :, 0] - corners[:, :, 3]
    heading = np.arctan2(front[..., 1], front[..., 0])

    def column(values, kind=dtype):
        return jnp.asarray(pad(np.asarray(values), size), kind)

    return AgentForecast(
        x=column(center[..., 0].T),
        y=column(center[..., 1].T),
        heading=column(heading.T),
        sample_valid=jnp.ones((size, corners.shape[0]), bool),
        length=column(np.hypot(*np.moveaxis(front, -1, 0))[0]),
        width=column(np.hypot(*np.moveaxis(side, -1, 0))[0]),
        type=column(data["obj_type"], jnp.int32),
        is_agent=column(data["obj_is_agent"], bool),
        speed=column(np.where(data["obj_is_agent"], data["obj_speed"], 0)),
        current_heading=column(data["obj_heading"]),
        track=column(data["obj_raw_index"], jnp.int32),
        valid=jnp.asarray(np.arange(size) < num),
        ignored=column(data["initially_collided"][:num], bool),
    )


def paths_from(points: list[np.ndarray], origin, dtype) -> Path:
    """Stacks reference paths into one padded `Path` `[L, M]`."""
    size = power_bucket(max(map(len, points)), 256)
    rows = []
    for row in points:
        local = row - np.array([*origin, 0.0])
        x, y, heading = (jnp.asarray(pad(local[:, c], size), dtype) for c in range(3))
        rows.append(make_path(x, y, heading, jnp.asarray(len(row), jnp.int32)))
    return jax.tree.map(lambda *v: jnp.stack(v), *rows)


def load_world(data, dtype) -> GoldenWorld:
    """Builds the world of one `scene_*.npz`."""
    origin = np.round(np.asarray(data["ego_state"][:2], float))
    drivable = [shapely.Polygon(ring - origin) for ring in ragged(data, "drivable")]
    crossings = [shapely.Polygon(ring - origin) for ring in ragged(data, "intersection")]
    grid = padded_grid([*drivable, *crossings], dtype)
    num = len(data["obj_type"])
    get = lambda name: jnp.asarray(data[f"idm_{name}"], dtype)
    return GoldenWorld(
        origin=origin,
        vehicle=vehicle_params(data),
        idm=IDMParams(
            min_gap=get("min_gap"),
            headway_time=get("headway_time"),
            accel_max=get("accel_max"),
            decel_max=get("decel_max"),
            fallback_speed=get("fallback_target_velocity"),
        ),
        paths=paths_from(ragged(data, "path"), origin, dtype),
        grid=grid,
        masks=area_masks(
            np.ones(len(drivable), bool),
            data["drivable_on_route"],
            len(drivable),
            len(crossings),
            grid.masks.shape[1],
        ),
        forecast=forecast_from_corners(data, origin, dtype),
        red=red_areas(ragged(data, "red"), origin, dtype, data["initially_collided"][num:]),
        num_objects=num,
        num_drivable=len(drivable),
        num_intersections=len(crossings),
    )
