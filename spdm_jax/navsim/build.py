"""Builds a `NavsimScene` from plain arrays (host, float64): checks, local frame, padding."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.config import NUM_STATES, VehicleParams
from spdm_jax.geometry import Path
from spdm_jax.navsim import layers, timing
from spdm_jax.navsim.batch import pad, room
from spdm_jax.navsim.fields import Fields
from spdm_jax.navsim.types import (
    NUM_FRAMES,
    NUM_POSES,
    LoggedObjects,
    NavsimScene,
    PreviousPlan,
    RedConnectors,
)
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import Array, EgoState, ObjectType

_STATE = len(STATE_COLUMNS)
_NUM_KINDS = layers.CAR_PARK + 1
# NAVSIM's map reaches 100 m from the ego; polygons are whole.
_MAX_REACH = 2000.0


def from_arrays(arrays: Mapping[str, Any], *, name: str = "scene") -> NavsimScene:
    """Builds one frame from arrays in map coordinates.

    Args:
      arrays: by field name; shapes as exported from NAVSIM. `n` objects, `m` red connectors, `D`
        map objects, `r` closed rings.

        - `ego_state [11]`, `start_time_us []`, `vehicle_params [4+]` (width, length, wheel base,
          rear axle to centre), `centerline [c, 3]`, `reference [41, 3]` (PDM-Closed's trajectory).
        - `map_ring_offsets [r+1]`, `map_ring_xy [sum, 2]`, `map_ring_object [r]`, `map_kind [D]`
          (0 road block, 1 lane, 2 lane connector, 3 intersection, 4 car park), `map_on_route [D]`.
        - `obj_type [n]`, `obj_size [n, 2]` (length, width), `log_pose [11, n, 3]`,
          `log_velocity [11, n, 2]`, `log_valid [11, n]`.
        - `log_red [m, 11]`, `red_offsets [m+1]`, `red_xy [sum, 2]`; may be left out.
        - `ego_past [K, 11]`, `ego_past_us [K]`, oldest first, the current state last; may be left
          out.
        - `human_poses [8, 3]` in the ego frame; may be left out.
        - `prev_poses [8, 3]` (or `[N, 8, 3]`, one for each trajectory) in the ego frame of the past
          state at `prev_start_time_us []`; may be left out.
      name: of the frame, for error texts.

    Returns:
      `NavsimScene` with NumPy leaves (float64), padded to few sizes.

    Raises:
      ValueError: a field is missing or of no use; names frame, field and value.
    """
    fields = Fields(arrays, name)
    ego = fields.numbers("ego_state", (_STATE,))
    start = int(fields.integers("start_time_us", ()))
    if start < 0:
        raise fields.error("start_time_us", f"is {start}; it must not be negative")
    origin = np.round(ego[:2])
    vehicle = _vehicle(fields)
    polygons, kind, on_route = _map(fields, origin)
    grid, masks = layers.map_layers(polygons, kind, on_route, vehicle)
    reference = fields.numbers("reference", (NUM_STATES, 3))
    past, past_us = _past(fields, start)
    sampled = timing.past_samples(past, past_us)[1] if past is not None else np.zeros((0, _STATE))
    has_human = fields.has("human_poses")
    human = fields.numbers("human_poses", (NUM_POSES, 3)) if has_human else np.zeros((NUM_POSES, 3))
    scene = NavsimScene(
        ego=_state(ego, origin),
        vehicle=vehicle,
        centerline=_centerline(fields, origin),
        grid=grid,
        masks=masks,
        objects=_objects(fields, origin),
        red=_red(fields, origin),
        past=timing.ego_past(sampled, room("past", len(sampled))),
        reference=reference - np.array([*origin, 0.0]),
        human_poses=human,
        has_human=np.array(has_human),
        previous=_previous(fields, origin, start, past, past_us),
        sampling=timing.sampling(start),
        origin=origin,
        start_time_us=np.array(start, np.int64),
    )
    return pad(scene)[0]


def _state(row: np.ndarray, origin: np.ndarray) -> EgoState:
    row = np.array(row, float)
    row[:2] -= origin
    return EgoState(**{column: np.array(row[i]) for i, column in enumerate(STATE_COLUMNS)})


def _vehicle(fields: Fields) -> VehicleParams:
    values = fields.numbers("vehicle_params", (None,))
    if len(values) < 4 or not (values[:4] > 0).all():
        raise fields.error(
            "vehicle_params",
            f"is {values.tolist()}; it must start with width, length, wheel base and distance from "
            "rear axle to centre, all positive",
        )
    width, length, wheel_base, reach = (np.array(v) for v in values[:4])
    return VehicleParams(
        width=width, length=length, wheel_base=wheel_base, rear_axle_to_center=reach
    )


def _centerline(fields: Fields, origin: np.ndarray) -> Path:
    points = fields.numbers("centerline", (None, 3))
    if len(points) < 2:
        raise fields.error("centerline", f"has {len(points)} points; it needs two or more")
    x, y = (points[:, :2] - origin).T
    progress: Array = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
    if progress[-1] <= 0:
        raise fields.error("centerline", "has no length: all its points are one")
    heading: Array = np.unwrap(points[:, 2])
    count: Array = np.array(len(points), np.int32)
    return Path(x, y, heading, progress, count, progress[-1])


def _map(fields: Fields, origin: np.ndarray) -> tuple[list[BaseGeometry], np.ndarray, np.ndarray]:
    kind = fields.integers("map_kind", (None,))
    on_route = fields.flags("map_on_route", (len(kind),))
    fields.within("map_kind", kind, 0, _NUM_KINDS - 1)
    if not np.isin(kind, layers.DRIVABLE_KINDS).any():
        raise fields.error(
            "map_kind",
            "holds no road block, intersection or car park (0, 3, 4), so nothing would be drivable",
        )
    rings = fields.rings("map_ring")
    owner = fields.integers("map_ring_object", (len(rings),))
    fields.within("map_ring_object", owner, 0, len(kind) - 1)
    missing = np.setdiff1d(np.arange(len(kind)), owner)
    if len(missing):
        raise fields.error("map_ring_object", f"names no ring of map object {missing[0]}")
    far = [np.abs(ring - origin).max() for ring in rings]
    if max(far) > _MAX_REACH:
        ring = int(np.argmax(far))
        raise fields.error(
            "map_ring_xy",
            f"puts ring {ring} {max(far):.0f} m from the ego, {_MAX_REACH:.0f} m are the most; are "
            "map and ego in the same frame?",
        )
    parts: list[list[BaseGeometry]] = [[] for _ in kind]
    for ring, row in zip(rings, owner, strict=True):
        polygon = shapely.Polygon(ring - origin)
        parts[row].append(polygon if polygon.is_valid else shapely.make_valid(polygon))
    whole = [own[0] if len(own) == 1 else shapely.union_all(own) for own in parts]
    return whole, kind, on_route


def _objects(fields: Fields, origin: np.ndarray) -> LoggedObjects:
    kind = fields.integers("obj_type", (None,))
    count = len(kind)
    fields.within("obj_type", kind, 0, int(max(ObjectType)))
    size = fields.numbers("obj_size", (count, 2))
    if not (size > 0).all():
        row = int(np.argwhere(size <= 0)[0, 0])
        raise fields.error("obj_size", f"of object {row} is {size[row].tolist()}; must be positive")
    valid = fields.flags("log_valid", (NUM_FRAMES, count))
    pose = fields.numbers("log_pose", (NUM_FRAMES, count, 3), valid)
    velocity = fields.numbers("log_velocity", (NUM_FRAMES, count, 2), valid)
    local = np.where(valid[..., None], pose - np.array([*origin, 0.0]), 0.0)
    return LoggedObjects(
        x=local[..., 0].T,
        y=local[..., 1].T,
        heading=local[..., 2].T,
        vx=np.where(valid, velocity[..., 0], 0.0).T,
        vy=np.where(valid, velocity[..., 1], 0.0).T,
        valid=valid.T,
        length=size[:, 0],
        width=size[:, 1],
        type=kind.astype(np.int32),
    )


def _red(fields: Fields, origin: np.ndarray) -> RedConnectors:
    if not fields.has("log_red"):
        rings, red = [], np.zeros((0, NUM_FRAMES), bool)
    else:
        rings = fields.rings("red")
        red = fields.flags("log_red", (len(rings), NUM_FRAMES))
    edges = [np.concatenate([r[:-1], r[1:]], axis=1) - np.tile(origin, 2) for r in rings]
    count = np.array([len(e) for e in edges], np.int32).reshape(-1)
    return RedConnectors(
        edges=np.concatenate(edges) if edges else np.zeros((0, 4)),
        start=(np.cumsum(count) - count).astype(np.int32),
        count=count,
        red=red,
    )


def _past(fields: Fields, start: int) -> tuple[np.ndarray | None, np.ndarray]:
    if not fields.has("ego_past"):
        return None, np.zeros(0, np.int64)
    times = fields.integers("ego_past_us", (None,))
    states = fields.numbers("ego_past", (len(times), _STATE))
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise fields.error("ego_past_us", f"is {times.tolist()}; needs two or more rising stamps")
    if times[-1] != start:
        raise fields.error(
            "ego_past_us", f"ends at {times[-1]}; the last one must be start_time_us, {start}"
        )
    return states, times


def _previous(
    fields: Fields, origin: np.ndarray, start: int, past: np.ndarray | None, past_us: np.ndarray
) -> PreviousPlan:
    if not fields.has("prev_poses"):
        nowhere = _state(np.array([*origin, *np.zeros(_STATE - 2)]), origin)
        return PreviousPlan(
            ego=nowhere,
            poses=np.zeros((1, NUM_POSES, 3)),
            sampling=timing.sampling(0),
            steps=np.array(0, np.int32),
            present=np.array(False),
        )
    stamp = int(fields.integers("prev_start_time_us", ()))
    if not 0 <= start - stamp <= timing.MAX_PLAN_AGE_US:
        raise fields.error(
            "prev_start_time_us",
            f"is {stamp}, {(start - stamp) * 1e-6:g} s before start_time_us; a previous plan may "
            f"be 0 to {timing.MAX_PLAN_AGE_US * 1e-6:g} s old",
        )
    at = np.flatnonzero(past_us == stamp)
    if past is None or not len(at):
        raise fields.error(
            "prev_start_time_us", f"is {stamp}; ego_past_us must hold that stamp, with its state"
        )
    poses = fields.numbers("prev_poses", None)
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or poses.shape[1:] != (NUM_POSES, 3) or not len(poses):
        raise fields.error("prev_poses", f"has shape {poses.shape}; expected [8, 3] or [N, 8, 3]")
    return PreviousPlan(
        ego=_state(past[at[0]], origin),
        poses=poses,
        sampling=timing.sampling(stamp),
        steps=np.array(round((start - stamp) / timing.SAMPLE_US), np.int32),
        present=np.array(True),
    )
