"""nuPlan's IDM baseline as planner: along the route's centreline, behind what is ahead."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.agents.observation import (
    Observation,
    RedLights,
    ego_inside,
    is_agent,
    red_lights,
)
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import (
    Box,
    Path,
    box_at,
    box_distance,
    boxes_overlap,
    ego_box,
    interpolate,
    project,
    segment_box_distance,
    wrap,
)
from spdm_jax.planner import StepInput
from spdm_jax.proposals.corridor import corridor_axis, corridor_hits_lights, corridors_hit_boxes
from spdm_jax.proposals.lanes import drivable_lanes, sequence_path, starting_lane
from spdm_jax.simulation.agent_state import AgentParams
from spdm_jax.simulation.controller import Plan
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.simulation.idm_agents import idm_acceleration
from spdm_jax.types import Scenario

NUM_SAMPLES = 16
SAMPLE_SECONDS = 0.5
PLAN_SECONDS = NUM_SAMPLES * SAMPLE_SECONDS

_START_RADIUS = 50.0  # m, lanes among which the ego's own is looked for
_MAX_LIGHTS, _MAX_LIGHT_EDGES = 16, 2048


class RouteState(NamedTuple):
    """What the planner fixes at the start.

    Attributes:
      sequence: `[S]` int32 lanes along the route from the ego's on, -1 padded.
      path: their centreline.
      target_speed: m/s.
      overflow: `[]` bool, the path did not fit.
    """

    sequence: jax.Array
    path: Path
    target_speed: jax.Array
    overflow: jax.Array


def idm_params() -> AgentParams:
    """Settings of nuPlan's IDM planner; `radius` is how far it looks for objects."""
    return AgentParams(decel_max=3.0, radius=40.0)


def _light_distance(red: RedLights, ego: Box) -> jax.Array:
    """Distance from the ego box to each red area, `[R]`."""
    ax, ay, bx, by = red.edges.T
    edge = segment_box_distance(ax, ay, bx, by, ego)
    edge = jnp.where(red.edge_valid, edge, jnp.inf)
    nearest = jax.ops.segment_min(edge, red.slot, num_segments=red.valid.shape[0])
    return jnp.where(ego_inside(red, ego), 0, nearest)


def boxes_seen(seen: Observation) -> Box:
    """Boxes `[A]` of the objects of one step."""
    half_length, half_width = 0.5 * seen.length, 0.5 * seen.width
    return box_at(seen.x, seen.y, seen.heading, half_length, half_width)


def first_route(
    scene: Scenario, params: AgentParams, vehicle: VehicleParams, max_path_points: int
) -> RouteState:
    """The ego's lane and path at iteration 0, found as PDM-Closed finds its centreline."""
    ego = jax.tree.map(lambda values: values[scene.num_history], scene.ego)
    box = ego_box(ego, vehicle)
    lanes, _ = drivable_lanes(scene.map, box.x, box.y, jnp.asarray(_START_RADIUS, box.x.dtype))
    lane = starting_lane(scene.map, scene.route, lanes, ego, vehicle)
    sequence = scene.route.centerline_lanes[scene.route.slot_of_lane[lane]]
    path, overflow = sequence_path(scene.map.lanes.centerline, sequence, max_path_points)
    limit = scene.map.lanes.speed_limit[lane]
    limit = jnp.where(limit > 0, limit, params.target_speed)
    return RouteState(sequence, path, jnp.maximum(limit, ego.vx), overflow | (lane < 0))


def follow_path(
    scene: Scenario,
    given: StepInput,
    time: jax.Array,
    path: Path,
    target_speed: jax.Array,
    params: AgentParams,
    vehicle: VehicleParams,
) -> tuple[Plan, jax.Array]:
    """Plans along a path by the intelligent driver model behind what its corridor holds now.

    Args:
      scene: map and route.
      given: the step's input.
      time: s.
      path: what the box centre follows.
      target_speed: m/s.
      params: settings, of the scene's dtype.
      vehicle: ego dimensions.

    Returns:
      The plan, and whether the red lights did not fit.

    Source: nuPlan `AbstractIDMPlanner`.
    """
    ego, seen = given.ego, given.observation
    dtype = ego.x.dtype
    half_width = jnp.asarray(0.5 * vehicle.width, dtype)
    first, others = ego_box(ego, vehicle), boxes_seen(seen)
    near = jnp.hypot(seen.x - first.x, seen.y - first.y) <= params.radius
    present = seen.valid & near
    speed = jnp.where(is_agent(seen.type), jnp.hypot(seen.vx, seen.vy), 0)
    start = project(path, first.x, first.y)
    axis = corridor_axis(path, start, start + target_speed * PLAN_SECONDS)
    in_corridor = corridors_hit_boxes(
        jax.tree.map(lambda v: v[None], axis),
        half_width,
        jax.tree.map(lambda v: v[None, None], others),
        present[None, None],
    )[0, 0, 0]
    red = red_lights(
        seen.lights,
        scene.route.lane_on_route,
        jnp.zeros(scene.map.lanes.valid.shape, bool),
        scene.map.lanes.polygon,
        _MAX_LIGHTS,
        _MAX_LIGHT_EDGES,
    )
    barred = corridor_hits_lights(axis, half_width, red)

    def standing(progress):
        x, y, heading = interpolate(path, progress)
        return box_at(x, y, heading, first.half_length, first.half_width), heading

    def rear_axle(progress):
        box, heading = standing(progress)
        reach = vehicle.rear_axle_to_center
        return box.x - reach * box.cos, box.y - reach * box.sin, heading

    def sample(carry, _):
        progress, v, box, heading = carry
        hit = present & (in_corridor | boxes_overlap(box, others))
        gap = jnp.where(hit, box_distance(box, others), jnp.inf)
        to_light = _light_distance(red, box)
        to_light = jnp.where(barred | (red.valid & (to_light <= 0)), to_light, jnp.inf)
        lead, light = jnp.argmin(gap), jnp.min(to_light)
        stands = light < gap[lead]
        along = speed[lead] * jnp.cos(wrap(seen.heading[lead] - heading))
        lead_speed = jnp.where(stands, 0, along)
        space = jnp.minimum(light, gap[lead])
        free = jnp.isinf(space)
        wall = path.length - progress - 0.5 * vehicle.length
        space, lead_speed = jnp.where(free, wall, space), jnp.where(free, 0, lead_speed)
        accel = idm_acceleration(v, target_speed, space, lead_speed, params)
        progress = progress + v * SAMPLE_SECONDS
        v = jnp.maximum(v + accel * SAMPLE_SECONDS, 0)
        return (progress, v, *standing(progress)), rear_axle(progress)

    # The plan starts on the path, not at the ego: the tracker is to see how far the ego is off it.
    _, poses = jax.lax.scan(sample, (start, ego.vx, *standing(start)), None, length=NUM_SAMPLES)
    x, y, heading = (
        jnp.concatenate([now[None], rest])
        for now, rest in zip(rear_axle(start), poses, strict=True)
    )
    seconds = jnp.arange(NUM_SAMPLES + 1).astype(dtype) * SAMPLE_SECONDS
    plan = Plan(x=x, y=y, heading=heading, time=seconds, start=time)
    return plan, red.overflow


def idm_driver(
    params: AgentParams | None = None,
    vehicle: VehicleParams | None = None,
    max_path_points: int = 1024,
) -> Driver:
    """The IDM planner: objects as they stand now, not forecast; one lane for the whole run.

    Args:
      params: nuPlan's settings by default.
      vehicle: ego dimensions.
      max_path_points: room for the path.

    Source: nuPlan `IDMPlanner`.
    """
    given_params, vehicle = params or idm_params(), vehicle or VehicleParams()

    def init(scene: Scenario) -> RouteState:
        return first_route(scene, given_params, vehicle, max_path_points)

    def step(scene: Scenario, given: StepInput, time: jax.Array, state: RouteState) -> Driven:
        params = jax.tree.map(lambda v: jnp.asarray(v, given.ego.x.dtype), given_params)
        plan, overflow = follow_path(
            scene, given, time, state.path, state.target_speed, params, vehicle
        )
        return Driven(plan, state, state.overflow | overflow)

    return Driver("IDM", init, step)
