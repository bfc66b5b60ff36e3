"""DIPP's network inputs from a scenario.

The network was made for Waymo's motion data. What nuPlan's format has no counterpart for is chosen
here: heights by type, line types by whether a lane lies beyond them, all lanes as surface streets.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from spdm_jax.arrays import order_of
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import wrap
from spdm_jax.types import EgoState, LightStatus, Polylines, ScenarioMap

from .dipp import HEIGHT, DIPPFeatures
from .scene_encoder import SceneFeatures

EGO_HEIGHT = 1.777
"""m (nuPlan's Pacifica)."""
HEIGHTS = (1.6, 1.75, 1.7)
"""Of vehicles, pedestrians and bicycles, m; scenarios hold none."""
TYPE_CODES = (1, 2, 3)
"""Of the same."""
SURFACE_STREET = 2
"""Waymo's lane types: 0 undefined, 1 freeway, 2 surface street, 3 bike lane."""
BROKEN_WHITE, SOLID_WHITE = 1, 2
"""Waymo's line types, of 11."""
LIGHT_CODES = {LightStatus.RED: 4, LightStatus.YELLOW: 5, LightStatus.GREEN: 6}
"""Waymo's states of lights that are no arrows, of 9."""
STOP_SIGN = 1
"""nuPlan's type of a stop line at a stop sign."""
NOT_ZERO = 1e-6
"""Stands for a first x of exactly 0, which the network reads as a missing element, m."""


@dataclass(frozen=True)
class DIPPFeatureConfig:
    """Static sizes.

    Attributes:
      history: samples of 0.1 s, the last one now.
      neighbors: A, nearest objects.
      lanes: lane sequences of each actor.
      crosswalks: crosswalks of each actor.
      points: of a lane sequence and of a crosswalk.
      lane_length: longest lane sequence, m.
      sequence: lanes in one.
      reach: elements farther from the actor are left out, m.
    """

    history: int = 20
    neighbors: int = 10
    lanes: int = 6
    crosswalks: int = 4
    points: int = 100
    lane_length: float = 150.0
    sequence: int = 12
    reach: float = 60.0


def dipp_features(
    scene: ScenarioMap,
    lights: jax.Array,
    ego: EgoState,
    base: SceneFeatures,
    vehicle: VehicleParams,
    config: DIPPFeatureConfig,
) -> DIPPFeatures:
    """Returns the network's inputs of one step.

    Lane sequences start at the point nearest to their actor and follow first successors.

    Args:
      scene: the map.
      lights: `[L]` `LightStatus` of the lane connectors now.
      ego: current state, scalars.
      base: GameFormer's features of the same step, with a history at least as long.
      vehicle: ego dimensions.
      config: static sizes.

    Raises:
      ValueError: `base` has a shorter history or fewer neighbours than the config asks for.
    """
    for name, given, wanted in (
        ("ego_past", base.ego_past.shape[0], config.history),
        ("neighbors_past", base.neighbors_past.shape[0], config.neighbors),
    ):
        if given < wanted:
            raise ValueError(f"base.{name} has {given} rows; DIPPFeatureConfig asks for {wanted}")
    own = _ego(base.ego_past[-config.history :], vehicle)
    neighbors = _neighbors(base.neighbors_past[: config.neighbors, -config.history :])
    now = jnp.concatenate([own[-1:, :2], neighbors[:, -1, :2]])
    present = jnp.concatenate([jnp.ones(1, bool), neighbors[:, -1, HEIGHT] != 0])
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    places = jnp.stack(
        [ego.x + cos * now[:, 0] - sin * now[:, 1], ego.y + sin * now[:, 0] + cos * now[:, 1]], -1
    )
    return DIPPFeatures(
        ego=own,
        neighbors=neighbors,
        map_lanes=_lanes(scene, lights, places, present, ego, config),
        map_crosswalks=_crosswalks(scene, places, present, ego, config),
    )


def _ego(past: jax.Array, vehicle: VehicleParams) -> jax.Array:
    """`[H, 8]` from GameFormer's `[H, 7]`, whose velocities are in the body frame."""
    cos, sin = jnp.cos(past[:, 2]), jnp.sin(past[:, 2])
    vx, vy = past[:, 3], past[:, 4]
    velocity = jnp.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1)
    size = jnp.asarray([vehicle.length, vehicle.width, EGO_HEIGHT], past.dtype)
    size = jnp.broadcast_to(size, (past.shape[0], 3))
    return jnp.concatenate([past[:, :3], velocity, size], axis=-1)


def _neighbors(past: jax.Array) -> jax.Array:
    """`[A, H, 9]` from GameFormer's `[A, H, 11]`: type and height follow from its one-hot."""
    kind = past[..., 8:11]
    height = kind @ jnp.asarray(HEIGHTS, past.dtype)
    code = kind @ jnp.asarray(TYPE_CODES, past.dtype)
    parts = past[..., :5], past[..., 6:8], height[..., None], code[..., None]
    return jnp.concatenate(parts, axis=-1)


def _local(x, y, heading, ego: EgoState) -> jax.Array:
    """Poses `[...]` in the frame of the ego, `[..., 3]`."""
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    dx, dy = x - ego.x, y - ego.y
    turned = wrap(heading - ego.heading)
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, turned], axis=-1)


def _nearest_rows(places, points, row, valid, num_rows, count, reach):
    """Rows `[N, count]` nearest to places `[N, 2]`, whether near enough, and their nearest point.

    The point is an index into the flat table `[M, 2]`.
    """
    square = jnp.sum((places[:, None] - points) ** 2, axis=-1)
    square = jnp.where(valid, square, jnp.inf)
    best = jax.vmap(lambda v: jax.ops.segment_min(v, row, num_segments=num_rows))(square)
    kept = min(count, num_rows)
    rows = jax.vmap(lambda v: order_of(v)[:kept])(best)
    rows = jnp.pad(rows, ((0, 0), (0, count - kept)))
    near = jnp.take_along_axis(best, rows, axis=1) <= reach**2
    near = near & (jnp.arange(count) < kept)
    own = row == rows[..., None]
    point = jnp.argmin(jnp.where(own, square[:, None], jnp.inf), axis=-1)
    return rows, near, point


def _sample(lines: Polylines, row: jax.Array, share: jax.Array) -> jax.Array:
    """Points `[..., 3]` of polylines by the share of their points that lie before."""
    last = jnp.maximum(lines.count[row] - 1, 0)
    index = lines.start[row] + jnp.round(share * last.astype(share.dtype)).astype(jnp.int32)
    return lines.points[jnp.clip(index, 0, lines.points.shape[0] - 1)]


def _lanes(scene, lights, places, present, ego, config) -> jax.Array:
    lanes, dtype = scene.lanes, places.dtype
    center = lanes.centerline
    usable = center.valid & lanes.valid[center.row]
    rows, near, point = _nearest_rows(
        places,
        center.points[:, :2],
        center.row,
        usable,
        lanes.valid.shape[0],
        config.lanes,
        config.reach,
    )

    def follow(lane, _):
        after = jnp.where(lane >= 0, lanes.successors[jnp.maximum(lane, 0), 0], -1)
        return after, lane

    _, sequence = jax.lax.scan(follow, rows, length=config.sequence)
    sequence = jnp.moveaxis(sequence, 0, -1)
    length = jnp.where(sequence >= 0, lanes.length[sequence], 0)
    end = jnp.cumsum(length, axis=-1)
    inside = (point - center.start[rows]).astype(dtype)
    share = inside / jnp.maximum(center.count[rows] - 1, 1).astype(dtype)
    begin = share * length[..., 0]
    driven = jnp.minimum(end[..., -1] - begin, config.lane_length)
    grid = jnp.linspace(0, 1, config.points, dtype=dtype)
    arc = begin[..., None] + driven[..., None] * grid
    # The end of the last lane belongs to it.
    real = jnp.sum(sequence >= 0, axis=-1, keepdims=True)
    part = jnp.sum(arc[..., None] >= end[..., None, :], axis=-1)
    part = jnp.clip(part, 0, real - 1)
    lane = jnp.take_along_axis(sequence, part, axis=-1)
    offset = arc - jnp.take_along_axis(end - length, part, axis=-1)
    along = jnp.maximum(jnp.take_along_axis(length, part, axis=-1), 1e-3)
    share = jnp.clip(offset / along, 0, 1)
    columns = []
    for line in (center, lanes.left_boundary, lanes.right_boundary):
        found = _sample(line, lane, share)
        columns.append(_local(found[..., 0], found[..., 1], found[..., 2], ego))
    limit = lanes.speed_limit[lane]
    side = lambda neighbor: jnp.where(neighbor[lane] >= 0, BROKEN_WHITE, SOLID_WHITE)
    following = jnp.take_along_axis(sequence, jnp.minimum(part + 1, real - 1), axis=-1)
    stops = (lights[following] == LightStatus.RED) & (lights[lane] != LightStatus.RED)
    last = jnp.diff(part, axis=-1, append=part[..., -1:]) > 0
    line = lanes.stop_line[lane]
    sign = (line >= 0) & (scene.stop_line_type[jnp.maximum(line, 0)] == STOP_SIGN)
    light = jnp.zeros_like(limit)
    for status, code in LIGHT_CODES.items():
        light = jnp.where(lights[lane] == status, jnp.asarray(code, limit.dtype), light)
    numbers = [
        jnp.where(jnp.isnan(limit), 0, limit),
        jnp.full(lane.shape, SURFACE_STREET),
        side(lanes.left_neighbor),
        side(lanes.right_neighbor),
        light,
        stops & last,
        lanes.is_connector[lane],
        sign,
    ]
    columns.append(jnp.stack([v.astype(dtype) for v in numbers], axis=-1))
    return _present(jnp.concatenate(columns, axis=-1), near & present[:, None])


def _crosswalks(scene, places, present, ego, config) -> jax.Array:
    outlines, dtype = scene.crosswalks, places.dtype
    rows, near, _ = _nearest_rows(
        places,
        outlines.xy,
        outlines.row,
        outlines.valid,
        outlines.count.shape[0],
        config.crosswalks,
        config.reach,
    )
    count = outlines.count[rows][..., None]
    share = jnp.linspace(0, 1, config.points, endpoint=False, dtype=dtype)
    index = outlines.start[rows][..., None] + (share * count.astype(dtype)).astype(jnp.int32)
    index = jnp.clip(index, 0, outlines.xy.shape[0] - 1)
    here, there = outlines.xy[index], outlines.next_xy[index]
    heading = jnp.arctan2(there[..., 1] - here[..., 1], there[..., 0] - here[..., 0])
    points = _local(here[..., 0], here[..., 1], heading, ego)
    return _present(points, near & present[:, None])


def _present(elements: jax.Array, real: jax.Array) -> jax.Array:
    """Zeroes missing elements `[N, E, P, F]`, and keeps real ones from looking like them."""
    first = elements[..., 0, 0]
    elements = elements.at[..., 0, 0].set(jnp.where(first == 0, NOT_ZERO, first))
    return jnp.where(real[..., None, None], elements, 0)
