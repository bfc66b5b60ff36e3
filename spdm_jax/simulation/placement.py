"""Who becomes a reactive agent at iteration 0, and where it is put on its lane."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import true_indices
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Box, boxes_overlap, ego_box, point_segment_sq
from spdm_jax.scoring.areas import areas_at
from spdm_jax.simulation.agent_paths import append_lane, empty_path, path_end, path_pose
from spdm_jax.simulation.agent_state import (
    ROUTE_MEMORY,
    Agent,
    AgentParams,
    AgentSizes,
    RoadFacts,
    Traffic,
    replayed_boxes,
)
from spdm_jax.simulation.history import Snapshot
from spdm_jax.simulation.script import Script
from spdm_jax.simulation.shapes import shape_circle, vehicle_shape
from spdm_jax.types import EgoState, ObjectType, Polylines, ScenarioMap

_CANDIDATES = 8
"""Lanes or connectors that may contain one vehicle's centre."""
_HEADING_REACH = 0.5
"""Length of the chord that gives a baseline's heading at a point, m."""


class _Segment(NamedTuple):
    """Where a vehicle lands on a lane."""

    lane: jax.Array  # -1: not on a lane
    progress: jax.Array
    x: jax.Array
    y: jax.Array
    heading: jax.Array


def _on_line(lines: Polylines, lane: jax.Array, x: jax.Array, y: jax.Array, size: int) -> _Segment:
    """Nearest point of one baseline and the direction of the next half metre.

    Source: nuPlan `get_nearest_pose_from_position`.
    """
    index = jnp.arange(size)
    count = lines.count[lane]
    source = jnp.clip(
        lines.start[lane] + jnp.minimum(index, count - 1), 0, lines.points.shape[0] - 1
    )
    px, py = lines.points[source, 0], lines.points[source, 1]
    length = jnp.hypot(jnp.diff(px), jnp.diff(py))
    begin = jnp.concatenate([jnp.zeros_like(px[:1]), jnp.cumsum(length)])
    square, share = point_segment_sq(x, y, px[:-1], py[:-1], px[1:], py[1:])
    best = jnp.argmin(jnp.where(index[:-1] < count - 1, square, jnp.inf))
    progress = begin[best] + share[best] * length[best]

    def at(s):
        s = jnp.clip(s, 0, begin[-1])
        k = jnp.clip(jnp.sum((begin <= s).astype(jnp.int32)), 1, jnp.maximum(count - 1, 1)) - 1
        f = jnp.clip((s - begin[k]) / jnp.where(length[k] > 0, length[k], 1), 0, 1)
        return px[k] + f * (px[k + 1] - px[k]), py[k] + f * (py[k + 1] - py[k])

    here = at(progress)
    ends = progress >= begin[-1]
    there = at(jnp.where(ends, progress - _HEADING_REACH, progress + _HEADING_REACH))
    sign = jnp.where(ends, -1, 1)
    dx, dy = sign * (there[0] - here[0]), sign * (there[1] - here[1])
    # A baseline that runs towards -x has the heading +pi, whatever rounding (of map coordinates in
    # the source, of local ones here) has done to dy.
    rounding = jnp.maximum(1e-9, 4 * jnp.finfo(dy.dtype).eps * jnp.abs(here[1]))
    dy = jnp.where(jnp.abs(dy) <= rounding, 0, dy)
    heading = jnp.arctan2(dy, dx)
    return _Segment(lane, progress, here[0], here[1], heading)


def _segment_of(
    inside: jax.Array,
    crossing: jax.Array,
    scene_map: ScenarioMap,
    x: jax.Array,
    y: jax.Array,
    heading: jax.Array,
    size: int,
) -> _Segment:
    """Lane of one vehicle whose centre lies in the lanes `inside` `[L]`, or in a crossing."""
    lanes = scene_map.lanes
    on_lane = inside & ~lanes.is_connector
    on_connector = inside & lanes.is_connector & crossing
    candidate, real = true_indices(jnp.where(jnp.any(on_lane), on_lane, on_connector), _CANDIDATES)
    found = jax.vmap(lambda lane: _on_line(lanes.centerline, lane, x, y, size))(candidate)
    # As published, the difference of headings is not wrapped.
    error = jnp.where(real, jnp.abs(found.heading - heading), jnp.inf)
    best = jax.tree.map(lambda v: v[jnp.argmin(error)], found)
    return best._replace(lane=jnp.where(jnp.any(real), best.lane, -1))


def place_agents(
    scene_map: ScenarioMap,
    facts: RoadFacts,
    objects: Snapshot,
    ego: EgoState,
    vehicle: VehicleParams,
    params: AgentParams,
    sizes: AgentSizes,
    script: Script | None = None,
) -> Traffic:
    """Turns the vehicles of iteration 0 into agents on their baselines.

    Vehicles on no lane are dropped, and so are those that touch a replayed object, the ego or an
    earlier agent once they have been moved onto their baseline. A lane without a speed limit gives
    its agent the target speed of the agent accepted before.

    Args:
      scene_map: the map.
      facts: `road_facts` of it.
      objects: the log at iteration 0; an unknown velocity (NaN) counts as the ego's speed.
      ego: the ego at iteration 0.
      vehicle: ego dimensions.
      params: nuPlan's settings.
      sizes: static room.
      script: of an interPlan scenario; its stopped vehicles stay where they are, whatever they
        touch and on no lane as well.

    Source: nuPlan `build_idm_agents_on_map_rails`.
    """
    num = objects.type.shape[0]
    areas = areas_at(scene_map, objects.x, objects.y)
    segment = jax.lax.map(
        lambda given: _segment_of(
            given[0], given[1], scene_map, given[2], given[3], given[4], sizes.path_points
        ),
        (areas.lanes, areas.intersection, objects.x, objects.y, objects.heading),
    )
    wanted = objects.valid & (objects.type == ObjectType.VEHICLE)
    stays = jnp.zeros(num, bool)
    if script is not None:
        stays = wanted & script.stopped
        keep = lambda own, snapped: jnp.where(stays, own, snapped)
        segment = segment._replace(
            x=keep(objects.x, segment.x),
            y=keep(objects.y, segment.y),
            heading=keep(objects.heading, segment.heading),
        )
    wanted &= stays | (segment.lane >= 0)
    box = Box(
        segment.x,
        segment.y,
        jnp.cos(segment.heading),
        jnp.sin(segment.heading),
        0.5 * objects.length,
        0.5 * objects.width,
    )
    fixed, present, overflow = replayed_boxes(objects, sizes.replayed)
    own = ego_box(ego, vehicle)
    limit = jnp.where(segment.lane >= 0, scene_map.lanes.speed_limit[segment.lane], jnp.nan)

    def decide(carry, row):
        accepted, target = carry
        here = jax.tree.map(lambda v: v[row], box)
        blocked = jnp.any(present & boxes_overlap(fixed, here))
        blocked |= boxes_overlap(own, here) | jnp.any(accepted & boxes_overlap(box, here))
        takes = wanted[row] & (stays[row] | ~blocked)
        target = jnp.where(takes & (limit[row] > 0), limit[row], target)
        return (accepted.at[row].set(takes), target), target

    fallback = jnp.asarray(params.target_speed, objects.x.dtype)
    start = (jnp.zeros(num, bool), fallback)
    (accepted, _), target = jax.lax.scan(decide, start, jnp.arange(num))

    room = min(num, sizes.agents)
    row, used = true_indices(accepted, room)
    speed = jnp.hypot(objects.vx, objects.vy)
    speed = jnp.where(jnp.isnan(speed), jnp.hypot(ego.vx, ego.vy), speed)

    def make(row, used):
        lane = jnp.maximum(segment.lane[row], 0)
        start = empty_path(sizes.path_points, objects.x.dtype)
        path, too_long = append_lane(start, jnp.zeros_like(objects.x[0]), scene_map.lanes, lane)
        x, y, heading = path_pose(path, jnp.clip(segment.progress[row], 0, path_end(path)))
        own = objects.x[row], objects.y[row], objects.heading[row]
        x, y, heading = jax.tree.map(lambda a, b: jnp.where(stays[row], a, b), own, (x, y, heading))
        body = jax.tree.map(lambda v: v[row], box)
        # Until it has moved, its footprint is its box.
        point = lambda v: jnp.broadcast_to(v, (sizes.footprint_points,))
        shape = vehicle_shape(point(body.x), point(body.y), body.half_width, body)
        return Agent(
            track=jnp.where(used, row, -1).astype(jnp.int32),
            active=used,
            length=objects.length[row],
            width=objects.width[row],
            path=path,
            progress=segment.progress[row],
            speed=speed[row],
            target_speed=target[row],
            route=jnp.full(ROUTE_MEMORY, -1, jnp.int32).at[-1].set(lane),
            x=x,
            y=y,
            heading=heading,
            shape=shape,
            circle=shape_circle(shape),
            moved=jnp.bool_(False),
            skipped=jnp.bool_(False),
            overflow=used & too_long,
        )

    agents = jax.vmap(make)(row, used)
    overflow |= facts.overflow | (jnp.sum(accepted) > room)
    overflow |= jnp.any(agents.overflow)
    count = jnp.minimum(jnp.sum(accepted), room).astype(jnp.int32)
    return Traffic(agents=agents, count=count, overflow=overflow)
