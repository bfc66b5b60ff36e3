"""The IDM planner with lane changes by MOBIL.

Kesting, Treiber, Helbing 2007: a change must not make the new follower brake hard, and it must be
worth it, the ones behind considered. What a planner needs beyond that is this project's own choice.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.observation import is_agent
from spdm_jax.config import Scalar, VehicleParams
from spdm_jax.geometry import Box, Path, ego_box, interpolate, make_path, project, wrap
from spdm_jax.planner import StepInput
from spdm_jax.proposals.corridor import corridor_axis, corridors_hit_boxes
from spdm_jax.proposals.lanes import sequence_path
from spdm_jax.scoring.areas import areas_at
from spdm_jax.simulation.agent_state import AgentParams
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.simulation.idm_agents import idm_acceleration
from spdm_jax.simulation.idm_driver import boxes_seen, first_route, follow_path, idm_params
from spdm_jax.types import Lanes, ObjectType, Scenario

_CHANGE_POINTS = 33
"""Points of a path between two lanes."""


class MobilParams(struct.PyTreeNode, kw_only=True):
    """Settings of the lane choice.

    Attributes:
      politeness: weight of what the followers gain.
      threshold: gain from which a change that the route does not ask for is worth it, m/s^2.
      straight_seconds: how long a change goes straight on first, s.
      change_seconds: how long it then takes, s.
      min_change_length: m.
      standing_speed: what is slower stands, m/s.
      push_share: share of its target speed at which the ego waits for a gap.
    """

    politeness: Scalar = 0.5
    threshold: Scalar = 0.2
    straight_seconds: Scalar = 0.5
    change_seconds: Scalar = 4.0
    min_change_length: Scalar = 12.0
    standing_speed: Scalar = 1.0
    push_share: Scalar = 0.5


class MobilState(NamedTuple):
    """What the planner carries.

    Attributes:
      lanes: `[L]` bool, lanes of the path.
      path: what the ego follows.
      settled: arc length on it at which the last change ends, m.
      target_speed: m/s.
      changes: `[L]` int32 least number of lane changes from each lane to the goal; L if it cannot
        be reached.
      overflow: `[]` bool, some path did not fit.
    """

    lanes: jax.Array
    path: Path
    settled: jax.Array
    target_speed: jax.Array
    changes: jax.Array
    overflow: jax.Array


class Neighbours(NamedTuple):
    """Who drives before and behind the ego in one lane; a gap is inf where nobody does.

    Attributes:
      lead_gap: m between bumpers.
      lead_speed: along the lane, m/s.
      follow_gap: m.
      follow_speed: m/s.
    """

    lead_gap: jax.Array
    lead_speed: jax.Array
    follow_gap: jax.Array
    follow_speed: jax.Array


def changes_to_goal(lanes: Lanes, on_route: jax.Array, goal: jax.Array) -> jax.Array:
    """Least number of lane changes from each lane to a goal lane along the route, `[L]` int32.

    Args:
      lanes: lane table.
      on_route: `[L]` bool.
      goal: `[L]` bool.
    """
    never = on_route.shape[0]
    beside = jnp.stack([lanes.left_neighbor, lanes.right_neighbor], axis=1)

    def least(changes, table):
        there = jnp.where((table >= 0) & on_route[table], changes[table], never)
        return jnp.min(there, axis=1)

    def relax(state):
        changes, _ = state
        onward = least(changes, lanes.successors)
        aside = jnp.where(lanes.is_connector, never, least(changes, beside) + 1)
        better = jnp.where(on_route, jnp.minimum(onward, aside), never)
        better = jnp.minimum(changes, better)
        return better, jnp.any(better < changes)

    start = jnp.where(goal, 0, never).astype(jnp.int32)
    return jax.lax.while_loop(lambda state: state[1], relax, (start, jnp.bool_(True)))[0]


def mobil_gain(
    speed: jax.Array,
    length: jax.Array,
    target_speed: jax.Array,
    here: Neighbours,
    there: Neighbours,
    params: AgentParams,
    politeness: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Judges one lane change.

    Args:
      speed: of the ego, m/s.
      length: of the ego, m.
      target_speed: of the ego; a faster follower keeps its own speed, m/s.
      here: in the ego's lane.
      there: in the lane to change to.
      params: IDM; its strongest deceleration is the safe limit.
      politeness: weight of the followers.

    Returns:
      The gain, m/s^2, and whether the change is safe: there is room, and neither the new follower
      nor the ego would brake at the limit.

    Source: Kesting et al. 2007, equations 2 and 3.
    """

    def accel(v, gap, lead_speed):
        return idm_acceleration(v, jnp.maximum(target_speed, v), gap, lead_speed, params)

    def follower_gain(who: Neighbours, enters: bool):
        exists = jnp.isfinite(who.follow_gap)
        gap = jnp.where(exists, who.follow_gap, 0)
        v = who.follow_speed
        with_ego = accel(v, gap, speed)
        without = accel(v, gap + length + who.lead_gap, who.lead_speed)
        gain = with_ego - without if enters else without - with_ego
        return jnp.where(exists, gain, 0), ~exists | (with_ego > -params.decel_max)

    own = accel(speed, there.lead_gap, there.lead_speed)
    own_gain = own - accel(speed, here.lead_gap, here.lead_speed)
    new_gain, spared = follower_gain(there, enters=True)
    old_gain, _ = follower_gain(here, enters=False)
    room = jnp.minimum(there.lead_gap, there.follow_gap) > params.min_gap
    safe = room & spared & (own > -params.decel_max)
    return own_gain + politeness * (new_gain + old_gain), safe


def neighbours_on(
    path: Path,
    ego: Box,
    others: Box,
    velocity: jax.Array,
    present: jax.Array,
    follows: jax.Array,
    heading: jax.Array,
) -> Neighbours:
    """Who is next to the ego along a lane's path.

    Args:
      path: the lane's centreline, from behind the ego on.
      ego: its box.
      others: `[A]` boxes.
      velocity: `[A]` speed along the box's heading, m/s.
      present: `[A]` bool.
      follows: `[A]` bool, objects that drive.
      heading: `[A]` rad.
    """
    at = project(path, ego.x, ego.y)
    s = project(path, others.x, others.y)
    x, y, direction = interpolate(path, s)
    turn = wrap(heading - direction)
    cos, sin = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    across = others.half_length * sin + others.half_width * cos
    along = others.half_length * cos + others.half_width * sin
    in_lane = present & (jnp.hypot(others.x - x, others.y - y) < ego.half_width + across)
    reach = along + ego.half_length
    ahead = jnp.where(in_lane & (s >= at), s - at - reach, jnp.inf)
    behind = jnp.where(in_lane & (s < at) & follows & (jnp.cos(turn) > 0), at - s - reach, jnp.inf)
    speed = velocity * jnp.cos(turn)
    lead, follower = jnp.argmin(ahead), jnp.argmin(behind)
    return Neighbours(ahead[lead], speed[lead], behind[follower], speed[follower])


def change_path(
    lane: Path, x: jax.Array, y: jax.Array, speed: jax.Array, params: MobilParams
) -> tuple[Path, jax.Array, jax.Array]:
    """The way from a point beside a lane's path onto it: straight on, then a smooth shift.

    Args:
      lane: `[M]` path of the lane to change to.
      x: m.
      y: m.
      speed: m/s.
      params: durations.

    Returns:
      `Path` `[M]` from the point on, the arc length on it at which the shift ends, and whether it
      did not fit.
    """
    size = lane.x.shape[0]
    begin = project(lane, x, y)
    bx, by, bh = interpolate(lane, begin)
    aside = (y - by) * jnp.cos(bh) - (x - bx) * jnp.sin(bh)
    straight = params.straight_seconds * speed
    length = jnp.maximum(params.change_seconds * speed, params.min_change_length)
    way = jnp.linspace(0, 1, _CHANGE_POINTS, dtype=x.dtype) * (straight + length)
    t = jnp.clip((way - straight) / length, 0, 1)
    offset, slope = aside * (1 - t * t * (3 - 2 * t)), -aside * 6 * t * (1 - t) / length
    sx, sy, sh = interpolate(lane, begin + way)
    sx, sy = sx - offset * jnp.sin(sh), sy + offset * jnp.cos(sh)
    passed = jnp.sum((lane.progress <= begin + way[-1]).astype(jnp.int32))
    index = jnp.arange(size)
    rest = jnp.clip(passed + index - _CHANGE_POINTS, 0, size - 1)
    pick = jnp.minimum(index, _CHANGE_POINTS - 1)
    join = lambda shift, lane: jnp.where(index < _CHANGE_POINTS, shift[pick], lane[rest])
    count = _CHANGE_POINTS + jnp.maximum(lane.count - passed, 0)
    path = make_path(
        join(sx, lane.x),
        join(sy, lane.y),
        join(sh + jnp.arctan(slope), lane.heading),
        jnp.minimum(count, size).astype(jnp.int32),
    )
    return path, path.progress[_CHANGE_POINTS - 1], count > size


def _first_predecessor(lanes: Lanes, on_route: jax.Array, lane: jax.Array) -> jax.Array:
    """One of the lanes before a lane, of the route if possible; -1 for none."""
    options = lanes.predecessors[lane]
    rank = jnp.where((options >= 0) & (lane >= 0), jnp.where(on_route[options], 0, 1), 2)
    best = jnp.argmin(rank)
    return jnp.where(rank[best] < 2, options[best], -1)


def mobil_driver(
    params: AgentParams | None = None,
    mobil: MobilParams | None = None,
    vehicle: VehicleParams | None = None,
    max_path_points: int = 1024,
) -> Driver:
    """The IDM planner that may change to a lane beside it.

    While no change is under way and the ego's centre is in a lane (not a connector) of its path,
    the neighbours on the route are judged, the one nearer to the goal first. Towards the goal a
    safe change is enough, away from it none is allowed; while there is no gap the ego slows down.

    Args:
      params: IDM; nuPlan's settings by default.
      mobil: lane choice.
      vehicle: ego dimensions.
      max_path_points: room for the path.

    Source: Kesting et al. 2007; the planner around it is ours.
    """
    given_params, given_mobil = params or idm_params(), mobil or MobilParams()
    vehicle = vehicle or VehicleParams()

    def init(scene: Scenario) -> MobilState:
        lanes, route = scene.map.lanes, scene.route
        first = first_route(scene, given_params, vehicle, max_path_points)
        num = lanes.valid.shape[0]
        x, y, _ = route.mission_goal
        on_route = route.lane_on_route & lanes.valid
        goal = areas_at(scene.map, x, y).lanes & on_route & route.has_mission_goal
        last = jnp.max(jnp.where(route.roadblocks >= 0, jnp.arange(route.roadblocks.shape[0]), 0))
        of_last = on_route & (lanes.roadblock == route.roadblocks[last])
        goal = jnp.where(jnp.any(goal), goal, of_last)
        return MobilState(
            lanes=_members(first.sequence, num),
            path=first.path,
            settled=jnp.zeros_like(first.target_speed),
            target_speed=first.target_speed,
            changes=changes_to_goal(lanes, on_route, goal),
            overflow=first.overflow,
        )

    def step(scene: Scenario, given: StepInput, time: jax.Array, state: MobilState) -> Driven:
        ego, seen = given.ego, given.observation
        dtype = ego.x.dtype
        params, mobil = jax.tree.map(lambda v: jnp.asarray(v, dtype), (given_params, given_mobil))
        lanes, on_route = scene.map.lanes, scene.route.lane_on_route
        body, others = ego_box(ego, vehicle), boxes_seen(seen)
        present = seen.valid & (jnp.hypot(seen.x - body.x, seen.y - body.y) <= params.radius)
        velocity = jnp.where(is_agent(seen.type), jnp.hypot(seen.vx, seen.vy), 0)
        follows = (seen.type == ObjectType.VEHICLE) | (seen.type == ObjectType.BICYCLE)

        inside = areas_at(scene.map, body.x, body.y).lanes & state.lanes & ~lanes.is_connector
        lane = jnp.argmax(inside)
        ready = jnp.any(inside) & (project(state.path, body.x, body.y) >= state.settled)
        beside = jnp.stack([lanes.left_neighbor[lane], lanes.right_neighbor[lane]])
        changes, own_changes = state.changes[beside], state.changes[lane]
        exists = ready & (beside >= 0) & on_route[beside]
        allowed, asked = exists & (changes <= own_changes), exists & (changes < own_changes)

        def lane_path(lane):
            before = _first_predecessor(lanes, on_route, lane)
            earlier = _first_predecessor(lanes, on_route, before)
            onward = scene.route.centerline_lanes[scene.route.slot_of_lane[lane]]
            sequence = jnp.concatenate([jnp.stack([earlier, before]), onward])
            return onward, *sequence_path(lanes.centerline, sequence, max_path_points)

        sequences, paths, long = jax.vmap(lane_path)(jnp.concatenate([lane[None], beside]))
        around = jax.vmap(
            lambda path: neighbours_on(path, body, others, velocity, present, follows, seen.heading)
        )(paths)
        here = jax.tree.map(lambda v: v[0], around)
        gain, safe = jax.vmap(
            lambda there: mobil_gain(
                ego.vx,
                jnp.asarray(vehicle.length, dtype),
                state.target_speed,
                here,
                there,
                params,
                mobil.politeness,
            )
        )(jax.tree.map(lambda v: v[1:], around))
        shifts, settled, too_long = jax.vmap(
            lambda path: change_path(path, body.x, body.y, ego.vx, mobil)
        )(jax.tree.map(lambda v: v[1:], paths))
        # What the ego could not stop for after the change bars it, too.
        braking = ego.vx * ego.vx / (2 * params.decel_max) + 0.5 * vehicle.length + params.min_gap
        axes = jax.vmap(corridor_axis)(shifts, jnp.zeros_like(settled), settled + braking)
        stands = present & (velocity < mobil.standing_speed)
        barred = corridors_hit_boxes(
            axes,
            jnp.asarray(0.5 * vehicle.width, dtype),
            jax.tree.map(lambda v: v[None, None], others),
            stands[None, None],
        )[0, :, 0]
        barred = jnp.any(barred, axis=-1)

        goes = allowed & safe & ~barred & (asked | (gain > mobil.threshold))
        side = jnp.argmin(jnp.where(goes, changes, jnp.iinfo(changes.dtype).max))
        go = jnp.any(goes)
        pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(go, a[side], b), new, old)
        members = jax.vmap(lambda s: _members(s, on_route.shape[0]))(sequences[1:])
        state = state._replace(
            lanes=pick(members, state.lanes),
            path=pick(shifts, state.path),
            settled=pick(settled, state.settled),
            overflow=state.overflow | (go & (long[1:] | too_long)[side]),
        )
        waits = ~go & jnp.any(asked & ~safe & ~barred)
        target = state.target_speed * jnp.where(waits, mobil.push_share, 1)
        plan, overflow = follow_path(scene, given, time, state.path, target, params, vehicle)
        return Driven(plan, state, state.overflow | overflow)

    return Driver("IDM + MOBIL (ours)", init, step)


def _members(sequence: jax.Array, num: int) -> jax.Array:
    """The lanes of a sequence as flags `[num]`."""
    return jnp.any(sequence[:, None] == jnp.arange(num), axis=0)
