"""Inputs of GameFormer and DTPP from a scene: histories, map pieces and lights near the ego.

All of it is in the frame of the ego's rear axle now. Source: observation adapters of
GameFormer-Planner and DTPP; differs: a map piece counts as near by the distance of its points, not
of its area.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.observation import Observation, is_agent
from spdm_jax.arrays import order_of
from spdm_jax.config import DT
from spdm_jax.geometry import wrap
from spdm_jax.types import (
    Array,
    EgoState,
    LightStatus,
    ObjectType,
    Polygons,
    Route,
    Scenario,
    ScenarioMap,
    Tracks,
)

from .scene_encoder import CROSSWALK_POINTS, LANE_POINTS, SceneFeatures

HISTORY_STEPS = 21
"""Samples of the histories, now included (2 s)."""
LIGHT_ORDER = (LightStatus.GREEN, LightStatus.YELLOW, LightStatus.RED, LightStatus.UNKNOWN)
"""Order of a lane point's light columns."""


@dataclass(frozen=True)
class FeatureConfig:
    """How much of a scene the networks see.

    Attributes:
      radius: map pieces farther away are left out, m (GameFormer 60, DTPP 80).
      neighbors: road users, nearest first.
      lanes: lane centre lines, nearest first.
      crosswalks: pedestrian crossings, nearest first.
      route_lanes: centre lines on the route, nearest first.
      rearmost: neighbours farther behind the rear axle are left out, m; None keeps them, as in
        training.
    """

    radius: float = 60.0
    neighbors: int = 20
    lanes: int = 40
    crosswalks: int = 5
    route_lanes: int = 10
    rearmost: float | None = -6.0


class History(struct.PyTreeNode, kw_only=True):
    """What was seen in the last H steps, oldest first, the last one is now.

    Attributes:
      ego: `[H]` states.
      tracks: `[A, H]`.
    """

    ego: EgoState
    tracks: Tracks


class Neighbors(struct.PyTreeNode, kw_only=True):
    """The road users that the networks see.

    Attributes:
      track: `[N]` int32 rows of the tracks, nearest first.
      valid: `[N]` bool.
    """

    track: Array
    valid: Array


def recorded_history(
    scene: Scenario, iteration: jax.Array | int = 0, steps: int = HISTORY_STEPS
) -> History:
    """Reads the history of one step of the recording.

    Before the recording begins the ego stays as it was first, and nobody else is there.

    Args:
      scene: one scenario.
      iteration: step within the scenario's window.
      steps: H.
    """
    wanted = scene.num_history + iteration + jnp.arange(1 - steps, 1)
    index = jnp.maximum(wanted, 0)
    tracks = scene.tracks
    series = {
        name: getattr(tracks, name)[:, index]
        for name in ("x", "y", "heading", "vx", "vy", "length", "width")
    }
    valid = tracks.valid[:, index] & (wanted >= 0)
    return History(
        ego=jax.tree.map(lambda v: v[index], scene.ego),
        tracks=Tracks(**series, valid=valid, type=tracks.type),
    )


def next_history(history: History, ego: EgoState, seen: Observation) -> History:
    """Drops the oldest step and appends one.

    Args:
      history: up to the step before.
      ego: current state, scalars.
      seen: current objects, rows as in the history.
    """

    def append(values, new):
        return jnp.concatenate([values[..., 1:], new[..., None]], axis=-1)

    old = history.tracks
    names = ("x", "y", "heading", "vx", "vy", "length", "width", "valid")
    series = {name: append(getattr(old, name), getattr(seen, name)) for name in names}
    return History(
        ego=jax.tree.map(append, history.ego, ego), tracks=Tracks(**series, type=old.type)
    )


def pick_neighbors(history: History, config: FeatureConfig) -> Neighbors:
    """Picks the nearest vehicles, pedestrians and bicycles that are present now.

    Those behind are left out after the count, so that fewer may stay, as in the reference.
    """
    tracks, ego = history.tracks, _now(history.ego)
    dx, dy = tracks.x[:, -1] - ego.x, tracks.y[:, -1] - ego.y
    present = tracks.valid[:, -1] & is_agent(tracks.type)
    nearest = order_of(jnp.where(present, jnp.hypot(dx, dy), jnp.inf))[: config.neighbors]
    valid = present[nearest]
    if config.rearmost is not None:
        ahead = dx * jnp.cos(ego.heading) + dy * jnp.sin(ego.heading)
        valid = valid & (ahead[nearest] >= config.rearmost)
    front = order_of(~valid)
    spare = config.neighbors - front.shape[0]
    return Neighbors(
        track=jnp.pad(nearest[front], (0, spare)).astype(jnp.int32),
        valid=jnp.pad(valid[front], (0, spare)),
    )


def scene_features(
    scene: ScenarioMap,
    route: Route,
    lights: jax.Array,
    history: History,
    neighbors: Neighbors,
    config: FeatureConfig,
) -> SceneFeatures:
    """Builds the inputs of one step.

    Args:
      scene: the map.
      route: the corrected route.
      lights: `[L]` `LightStatus` of the lane connectors now.
      history: of the last 2 s.
      neighbors: of `pick_neighbors`.
      config: how much is seen.
    """
    ego = _now(history.ego)
    centre, lanes = scene.lanes.centerline, scene.lanes
    gap = _row_gaps(centre.points[:, :2], centre.row, centre.valid, centre.start.shape[0], ego)
    near = lanes.valid & (gap <= config.radius)
    rows, found = _nearest(jnp.where(near, gap, jnp.inf), config.lanes)
    status = jnp.stack([lights[rows] == light for light in LIGHT_ORDER], axis=-1)
    status = jnp.where(found[:, None], status, False).astype(ego.x.dtype)
    shape = (config.lanes, LANE_POINTS, len(LIGHT_ORDER))
    lane_points = _resampled(centre.points, centre.start[rows], centre.count[rows], LANE_POINTS)
    on_route = jnp.where(near & route.lane_on_route, gap, jnp.inf)
    route_rows, route_found = _nearest(on_route, config.route_lanes)
    route_points = _resampled(
        centre.points, centre.start[route_rows], centre.count[route_rows], LANE_POINTS
    )
    return SceneFeatures(
        ego_past=_ego_past(history.ego, ego),
        neighbors_past=_neighbors_past(history.tracks, neighbors, ego),
        lanes=jnp.concatenate(
            [
                _with_heading(lane_points, found, ego),
                jnp.broadcast_to(status[:, None], shape),
            ],
            axis=-1,
        ),
        crosswalks=_crosswalks(scene.crosswalks, ego, config),
        route_lanes=_with_heading(route_points, route_found, ego),
    )


def recorded_futures(
    scene: Scenario, neighbors: Neighbors, iteration: jax.Array | int, count: int, steps: int
) -> tuple[jax.Array, jax.Array]:
    """Recorded futures for training, first at 0.1 s.

    Args:
      scene: one scenario.
      neighbors: of `pick_neighbors`.
      iteration: step within the scenario's window.
      count: A, neighbours that are predicted.
      steps: T.

    Returns:
      The ego's poses `[T, 3]` and those of the neighbours `[A, T, 3]`, in the frame of the ego's
      rear axle now; zero where there is no record.
    """
    now = scene.num_history + iteration
    index = jnp.minimum(now + 1 + jnp.arange(steps), scene.ego_valid.shape[0] - 1)
    beyond = now + 1 + jnp.arange(steps) >= scene.ego_valid.shape[0]
    ego = jax.tree.map(lambda v: v[now], scene.ego)
    future = jax.tree.map(lambda v: v[index], scene.ego)
    there = scene.ego_valid[index] & ~beyond
    poses = jnp.stack(local_pose(future.x, future.y, future.heading, ego), axis=-1)
    rows = neighbors.track[:count]
    tracks = scene.tracks
    seen = tracks.valid[rows][:, index] & ~beyond & neighbors.valid[:count, None]
    pick = lambda values: values[rows][:, index]
    others = local_pose(pick(tracks.x), pick(tracks.y), pick(tracks.heading), ego)
    return (
        jnp.where(there[:, None], poses, 0),
        jnp.where(seen[..., None], jnp.stack(others, axis=-1), 0),
    )


def _now(ego: EgoState) -> EgoState:
    return jax.tree.map(lambda v: v[-1], ego)


def _local_point(x, y, ego: EgoState):
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    dx, dy = x - ego.x, y - ego.y
    return dx * cos + dy * sin, dy * cos - dx * sin


def local_pose(x, y, heading, ego: EgoState):
    """Poses in the frame of the ego's rear axle: x, y, heading."""
    return *_local_point(x, y, ego), wrap(heading - ego.heading)


def _ego_past(past: EgoState, ego: EgoState) -> jax.Array:
    pose = local_pose(past.x, past.y, past.heading, ego)
    return jnp.stack([*pose, past.vx, past.vy, past.ax, past.ay], axis=-1)


def _neighbors_past(tracks: Tracks, neighbors: Neighbors, ego: EgoState) -> jax.Array:
    """`[N, H, 11]`; gaps repeat what was seen next."""
    valid = tracks.valid[neighbors.track]
    steps = jnp.arange(valid.shape[1])
    known = jnp.where(valid, steps, steps.shape[0] - 1)
    source = jax.lax.cummin(known, axis=1, reverse=True)
    pick = lambda values: jnp.take_along_axis(values[neighbors.track], source, axis=1)
    x, y, heading = local_pose(pick(tracks.x), pick(tracks.y), pick(tracks.heading), ego)
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    vx, vy = pick(tracks.vx), pick(tracks.vy)
    kind = tracks.type[neighbors.track]
    one_hot = [
        jnp.broadcast_to((kind == t)[:, None], x.shape).astype(x.dtype)
        for t in (ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.BICYCLE)
    ]
    columns = [
        x,
        y,
        heading,
        vx * cos + vy * sin,
        vy * cos - vx * sin,
        _yaw_rate(heading),
        pick(tracks.length),
        pick(tracks.width),
        *one_hot,
    ]
    return jnp.where(neighbors.valid[:, None, None], jnp.stack(columns, axis=-1), 0)


def _yaw_rate(heading: jax.Array) -> jax.Array:
    """Slope of parabolas through three samples each, as nuPlan's filter of window 3."""
    step = wrap(jnp.diff(heading, axis=-1)) / DT
    first = 1.5 * step[:, :1] - 0.5 * step[:, 1:2]
    last = 1.5 * step[:, -1:] - 0.5 * step[:, -2:-1]
    return jnp.concatenate([first, 0.5 * (step[:, 1:] + step[:, :-1]), last], axis=-1)


def _row_gaps(xy, row, valid, num: int, ego: EgoState) -> jax.Array:
    """Distance from the ego to the nearest point of each row, `[num]`; inf for empty ones."""
    gap = jnp.hypot(xy[:, 0] - ego.x, xy[:, 1] - ego.y)
    return jax.ops.segment_min(jnp.where(valid, gap, jnp.inf), row, num_segments=num)


def _nearest(gap: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Rows with the smallest gaps and which of them are real, `[count]` each."""
    rows = jax.lax.top_k(-gap, min(count, gap.shape[0]))[1]
    rows = jnp.pad(rows, (0, count - rows.shape[0]))
    place = jnp.arange(count)
    return rows, jnp.isfinite(gap[rows]) & (place < gap.shape[0])


def _shares(count: jax.Array, points: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Index and share beyond it of points spread evenly over the index of `count` points."""
    # Whole numbers until the division, so that both ends are hit exactly.
    numerator = jnp.arange(points) * jnp.maximum(count - 1, 0)[:, None]
    index = numerator // (points - 1)
    share = (numerator - index * (points - 1)).astype(dtype) / (points - 1)
    return index, share


def _resampled(table, start, count, points: int) -> jax.Array:
    """`[R, points, 2]` points of polylines, interpolated over the point index."""
    index, share = _shares(count, points, table.dtype)
    low = start[:, None] + index
    high = start[:, None] + jnp.minimum(index + 1, jnp.maximum(count - 1, 0)[:, None])
    a, b = table[low, :2], table[high, :2]
    return a + share[..., None] * (b - a)


def _crosswalks(areas: Polygons, ego: EgoState, config: FeatureConfig) -> jax.Array:
    gap = _row_gaps(areas.xy, areas.row, areas.valid, areas.start.shape[0], ego)
    gap = jnp.where((areas.count > 0) & (gap <= config.radius), gap, jnp.inf)
    rows, found = _nearest(gap, config.crosswalks)
    start, count = areas.start[rows], areas.count[rows]
    # An outline ends where it began: one more point than edges.
    index, share = _shares(count + 1, CROSSWALK_POINTS, areas.xy.dtype)
    edge = start[:, None] + jnp.minimum(index, jnp.maximum(count - 1, 0)[:, None])
    share = jnp.where(index >= count[:, None], 1, share)
    a, b = areas.xy[edge], areas.next_xy[edge]
    return _with_heading(a + share[..., None] * (b - a), found, ego)


def _with_heading(xy: jax.Array, found: jax.Array, ego: EgoState) -> jax.Array:
    """`[R, P, 3]` in the ego frame; the last point has the heading of the one before."""
    x, y = _local_point(xy[..., 0], xy[..., 1], ego)
    heading = jnp.arctan2(jnp.diff(y, axis=-1), jnp.diff(x, axis=-1))
    heading = jnp.concatenate([heading, heading[..., -1:]], axis=-1)
    return jnp.where(found[:, None, None], jnp.stack([x, y, heading], axis=-1), 0)
