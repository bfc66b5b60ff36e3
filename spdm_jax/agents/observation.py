"""What the planner sees at one step: the objects near the ego, and red lights on the route."""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import order_of, prefix_count, true_indices
from spdm_jax.config import PlannerConfig
from spdm_jax.geometry import Box, boxes_overlap, crosses_upward_ray, segment_meets_box
from spdm_jax.types import Array, LightStatus, ObjectType, Polygons


class Observation(struct.PyTreeNode, kw_only=True):
    """The world at one step; `A` rows are those of `Scenario.tracks`.

    Attributes:
      x, y, heading: `[A]` box centres.
      vx, vy: `[A]` velocity along the map axes, m/s.
      length, width: `[A]` m.
      type: `[A]` int32 `ObjectType`.
      valid: `[A]` bool, present now.
      lights: `[L]` int8 `LightStatus` per lane connector.
      step: `[]` int32, index on the scenario's time axis.
    """

    x: Array
    y: Array
    heading: Array
    vx: Array
    vy: Array
    length: Array
    width: Array
    type: Array
    valid: Array
    lights: Array
    step: Array


class SelectedObjects(struct.PyTreeNode, kw_only=True):
    """Objects of one step in the reference's order.

    Attributes:
      track: `[A']` int32 rows of the observation: static, vehicles, pedestrians, bicycles, each
        nearest first.
      valid: `[A']` bool.
    """

    track: Array
    valid: Array


def is_agent(object_type: jax.Array) -> jax.Array:
    """Vehicle, pedestrian or bicycle."""
    return object_type <= ObjectType.BICYCLE


def select_objects(
    observation: Observation,
    ego_x: jax.Array,
    ego_y: jax.Array,
    excluded: jax.Array,
    radius: jax.Array,
    config: PlannerConfig,
) -> SelectedObjects:
    """Keeps the nearest objects of each class within a radius of the ego's centre.

    Args:
      observation: all objects.
      ego_x: ego centre, m.
      ego_y: ego centre, m.
      excluded: `[A]` bool, objects dropped for good (met at an earlier step).
      radius: m.
      config: how many of each class.

    Returns:
      `SelectedObjects` with min(A, `config.max_objects`) rows.

    Source: tuplan_garage `PDMObservation.update`.
    """
    distance = jnp.hypot(observation.x - ego_x, observation.y - ego_y)
    present = observation.valid & ~excluded & (distance <= radius)
    group = jnp.where(
        is_agent(observation.type),
        1 + observation.type,
        jnp.zeros_like(observation.type),
    )
    # Group order is static, vehicle, pedestrian, bicycle = 0, 1, 2, 3; absent objects come last.
    group = jnp.where(present, group, 4)
    # Place within the own group, nearest first.
    num = group.shape[0]
    same = group[:, None] == group[None, :]
    closer = distance[:, None] < distance[None, :]
    earlier = jnp.arange(num)[:, None] < jnp.arange(num)[None, :]
    tied = distance[:, None] == distance[None, :]
    rank = jnp.sum(same & (closer | (tied & earlier)), axis=0)
    caps = jnp.asarray(
        [config.max_static, config.max_vehicles, config.max_pedestrians, config.max_bicycles, 0]
    )
    keep = rank < caps[group]
    order = order_of(rank, group, ~keep)[: min(num, config.max_objects)]
    return SelectedObjects(track=order, valid=keep[order])


class RedLights(struct.PyTreeNode, kw_only=True):
    """Areas of the red lane connectors on the route, as edges.

    Attributes:
      edges: `[V, 4]` x0, y0, x1, y1.
      slot: `[V]` int32, the light an edge belongs to.
      edge_valid: `[V]` bool.
      centroid: `[R, 2]` area centroid.
      lane: `[R]` int32 lane index.
      valid: `[R]` bool.
      ignored: `[R]` bool, the ego was entirely inside now or earlier.
      overflow: `[]` bool, more red lights than slots or edges: the result is not to be used.
    """

    edges: Array
    slot: Array
    edge_valid: Array
    centroid: Array
    lane: Array
    valid: Array
    ignored: Array
    overflow: Array


def red_lights(
    lights: jax.Array,
    lane_on_route: jax.Array,
    passed: jax.Array,
    polygons: Polygons,
    max_lights: int,
    max_edges: int,
) -> RedLights:
    """Collects the red connectors of the route into fixed-size buffers.

    Args:
      lights: `[L]` status now.
      lane_on_route: `[L]` bool.
      passed: `[L]` bool, lights ignored for the rest of the run.
      polygons: lane areas, row = lane.
      max_lights: slots.
      max_edges: room for their edges.
    """
    red = (lights == LightStatus.RED) & lane_on_route
    lane, valid = true_indices(red, max_lights)
    lane = jnp.where(valid, lane, -1)
    slot_of_lane = jnp.where(red, prefix_count(red) - 1, max_lights)
    use = polygons.valid & red[polygons.row] & (slot_of_lane[polygons.row] < max_lights)
    index, edge_valid = true_indices(use, max_edges)
    a, b = polygons.xy[index], polygons.next_xy[index]
    slot = jnp.where(edge_valid, slot_of_lane[polygons.row[index]], max_lights).astype(jnp.int32)
    overflow = (jnp.sum(red) > max_lights) | (jnp.sum(use) > max_edges)
    edges = jnp.concatenate([a, b], axis=1)
    return RedLights(
        edges=jnp.where(edge_valid[:, None], edges, 0),
        slot=slot,
        edge_valid=edge_valid,
        centroid=edge_centroids(edges, slot, edge_valid, max_lights),
        lane=lane,
        valid=valid,
        ignored=valid & passed[lane],
        overflow=overflow,
    )


def edge_centroids(edges: jax.Array, slot: jax.Array, valid: jax.Array, num: int) -> jax.Array:
    """Area centroids `[num, 2]` of polygons given as edges (shoelace about a point of each)."""
    pivot = (
        jnp.zeros((num, 2), edges.dtype)
        .at[slot]
        .set(jnp.where(valid[:, None], edges[:, :2], 0), mode="drop")
    )
    here = pivot[jnp.clip(slot, 0, num - 1)]
    a, b = edges[:, :2] - here, edges[:, 2:] - here
    cross = jnp.where(valid, a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1], 0)

    def total(values):
        return jax.ops.segment_sum(values, slot, num_segments=num)

    area = total(cross)
    moment = total(cross[:, None] * (a + b))
    return pivot + moment / jnp.where(area != 0, 3 * area, 1)[:, None]


def ego_inside(red: RedLights, ego: Box) -> jax.Array:
    """Whether the ego box lies entirely within each red area, `[R]` bool."""
    ax, ay, bx, by = red.edges.T
    num = red.valid.shape[0]
    meets = segment_meets_box(ax, ay, bx, by, ego) & red.edge_valid
    crossings = crosses_upward_ray(ego.x, ego.y, ax, ay, bx, by) & red.edge_valid
    touched = jax.ops.segment_max(meets.astype(jnp.int32), red.slot, num_segments=num) > 0
    parity = jax.ops.segment_sum(crossings.astype(jnp.int32), red.slot, num_segments=num)
    return red.valid & ~touched & (parity % 2 == 1)


def ego_contacts(ego: Box, x, y, heading, length, width) -> jax.Array:
    """Whether the ego box touches each object box, `[A]` bool."""
    other = Box(x, y, jnp.cos(heading), jnp.sin(heading), 0.5 * length, 0.5 * width)
    return boxes_overlap(ego, other)
