"""How the oncoming lane is borrowed: how fast, and when (an extension of SPDM).

The final score decides how: nuPlan's driving-direction metric counts the metres that the *centre*
of the ego's box drives against a lane's direction within 1 s (its sum spans 1.1 s). Under 2 m cost
nothing, under 6 m halve the score of the whole drive, more take all of it. Passing a standing van
faster than 5.4 m/s therefore scores 0, faster than 1.8 m/s at most 0.5, below that up to 1, while
waiting behind it for good scores 0 wherever the way behind it makes up four fifths of the expert's.
So the ego slows down before its centre crosses the border, passes at `PACE` of what costs nothing,
and gains speed only when it is back across. With its centre on its own side and merely its body
across it may drive as fast as it likes: that is stage 1's business, the offsets of its paths.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.agents.observation import Observation, is_agent
from spdm_jax.config import DT, PlannerParams, VehicleParams
from spdm_jax.geometry import Path, interpolate, project
from spdm_jax.proposals.oncoming import OncomingLane, beyond_border, lateral_offset
from spdm_jax.proposals.spline import CURVE_POINTS, RouteLanePaths, cubic_distance, drive
from spdm_jax.scoring.driving import METRIC_WINDOW
from spdm_jax.types import EgoState

PACE = 0.93
"""Speed in the oncoming lane as a part of the highest that the metric lets pass in full."""
STANDING = 0.5
"""Speed below which an object stands, and above which it comes towards the ego, m/s."""
SIDE_ROOM = 0.3
"""Room beside an obstacle below which it blocks the centreline, m."""
GAP_TIME = 1.0
"""Time for which an oncoming object must still be away when the ego is back, s."""
NEXT_OBSTACLE = 20.0
"""Distance from the first obstacle within which another one belongs to it, m."""
_TRACKED = 1.0  # s ahead, to which the tracker looks when it fits the speed
_LEAST = 1.0  # s, for any change of speed
_GAINING = 1.2  # s per m/s of speed to be gained
_LOSING, _BEFORE = 0.75, 0.5  # s per m/s of speed to be lost, and s besides


class Surroundings(NamedTuple):
    """What passing depends on, measured along the centreline from beside the ego, m.

    Attributes:
      oncoming: the lane to borrow.
      back: `[]` station at which the rear axle is back on the centreline.
      blocked: `[]` bool, something stands in the way and is not passed yet.
      room: `[]` bool, the oncoming lane goes on until the ego is back.
      entered: `[]` bool, the ego's centre is in the oncoming lane already.
      ahead: `[A]` station of the near end of whatever comes towards the ego, inf for all others.
      behind: `[A]` of its far end.
      speed: `[A]` at which it comes, m/s.
    """

    oncoming: OncomingLane
    back: jax.Array
    blocked: jax.Array
    room: jax.Array
    entered: jax.Array
    ahead: jax.Array
    behind: jax.Array
    speed: jax.Array


def surroundings(
    oncoming: OncomingLane,
    centerline: Path,
    ego: EgoState,
    seen: Observation,
    params: PlannerParams,
) -> Surroundings:
    """Finds what blocks the ego's lane and what comes towards it.

    All objects count, however far away they are seen: those that the scorer forecasts end at
    `map_radius`, which somebody who comes at 10 m/s covers in 5 s.

    Args:
      oncoming: the lane to borrow.
      centerline: stage-1 centreline.
      ego: current state, scalars.
      seen: objects of this step.
      params: ego dimensions and merge distances.
    """
    vehicle = params.vehicle
    along = project(centerline, seen.x, seen.y)
    x, y, heading = interpolate(centerline, along)
    along = along - project(centerline, ego.x, ego.y)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    offset = (seen.y - y) * cos - (seen.x - x) * sin
    speed = seen.vx * cos + seen.vy * sin
    turn = seen.heading - heading
    cos, sin = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    half_length = 0.5 * (seen.length * cos + seen.width * sin)
    half_width = 0.5 * (seen.length * sin + seen.width * cos)
    near, far = along - half_length, along + half_length

    rear, _ = overhangs(vehicle)
    stands = jnp.hypot(seen.vx, seen.vy) < STANDING
    narrow = jnp.abs(offset) < half_width + 0.5 * vehicle.width + SIDE_ROOM
    blocks = seen.valid & stands & narrow & (far > -rear)
    first = jnp.min(jnp.where(blocks, far, jnp.inf))
    joined = blocks & (near < first + NEXT_OBSTACLE)
    end = jnp.max(jnp.where(joined, far, 0))
    back = end + rear + params.spline.merge_min_distance
    room = project(oncoming.own, oncoming.path.x[-1], oncoming.path.y[-1])

    inner = offset * oncoming.side
    in_lane = (inner + half_width > oncoming.border) & (inner - half_width < 3 * oncoming.border)
    comes = seen.valid & is_agent(seen.type) & in_lane & (speed < -STANDING) & (far > -rear)
    return Surroundings(
        oncoming=oncoming,
        back=back,
        blocked=jnp.any(blocks),
        room=back < room,
        entered=beyond_border(oncoming, ego, vehicle),
        ahead=jnp.where(comes, near, jnp.inf),
        behind=jnp.where(comes, far, jnp.inf),
        speed=jnp.where(comes, -speed, 0),
    )


def offered(around: Surroundings) -> OncomingLane:
    """The oncoming lane as a branch of stage 2: usable only where something blocks the own one.

    Elsewhere, and once the ego is past, all K paths are those of route lanes, the way back too.
    """
    lane = around.oncoming
    return lane._replace(usable=lane.usable & around.blocked)


def overhangs(vehicle: VehicleParams) -> tuple[jax.Array, jax.Array]:
    """Distances from the rear axle to the rear and to the front bumper, m."""
    half = 0.5 * vehicle.length
    return half - vehicle.rear_axle_to_center, half + vehicle.rear_axle_to_center


def passing_speed(params: PlannerParams) -> jax.Array:
    """Speed in the oncoming lane, m/s."""
    return PACE * params.scoring.driving_direction_compliant / (METRIC_WINDOW * DT)


def drive_borrowing(
    paths: RouteLanePaths,
    ego: EgoState,
    target_speed: jax.Array,
    params: PlannerParams,
    num_states: int,
    around: Surroundings,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """`drive`, but slow wherever the ego's centre is in the oncoming lane.

    On the borrowed paths the target speeds are spread like the others, the highest being
    `passing_speed`, and reached when the centre crosses the border. Paths of other lanes that start
    in the oncoming lane are driven at that speed until they have left it, and with their own cubic
    from there on. A borrowed path is offered only where it is of use and safe (`may_borrow`).

    Args:
      paths: `[K]` paths.
      ego: current state, scalars.
      target_speed: `[S]` m/s.
      params: traced settings.
      num_states: T.
      around: what the ego has around it.

    Returns:
      As `drive`.
    """
    assert paths.borrowed is not None
    x, y, heading, valid = drive(paths, ego, target_speed, params.spline, num_states)
    dtype = target_speed.dtype
    slow = jnp.asarray(passing_speed(params), dtype)
    first, last = _stays(paths.path, around.oncoming, params.vehicle)

    speeds = slow * target_speed / jnp.max(target_speed)
    begin, time = jax.vmap(lambda way: _slowing(way, ego, speeds))(first)  # [K, S]

    def entering(target, begin, time):
        accel = jnp.where(begin > 0, 0, ego.ax)
        after = cubic_distance(ego.vx, accel, target, time, num_states)
        return _joined(ego.vx * DT * jnp.arange(num_states), begin, after)

    leaving = cubic_distance(ego.vx, ego.ax, slow, _gain_time(ego.vx, slow), num_states)
    horizon = jnp.asarray(params.spline.horizon, dtype)
    gaining = jax.vmap(lambda v: cubic_distance(slow, jnp.zeros((), dtype), v, horizon, num_states))
    after = gaining(target_speed)

    def returning(way):
        left = jnp.sum(leaving < way + _TRACKED * slow, dtype=jnp.int32)
        return jax.vmap(lambda row: _joined(leaving, left, row))(after)

    distance = jnp.where(
        paths.borrowed[:, None, None],
        jax.vmap(jax.vmap(entering), in_axes=(None, 0, 0))(speeds, begin, time),
        jax.vmap(returning)(last),
    )
    slowed = paths.borrowed | (last > 0)
    pose = jax.vmap(interpolate)(paths.path, distance)
    choose = lambda new, old: jnp.where(slowed[:, None, None], new, old)
    fits = distance[..., -1] <= paths.path.length[:, None]
    until = DT * begin + time
    allowed = may_borrow(around, first, until, speeds, params) | ~paths.borrowed[:, None]
    valid = jnp.where(slowed[:, None], paths.valid[:, None] & fits & allowed, valid)
    return choose(pose[0], x), choose(pose[1], y), choose(pose[2], heading), valid


def may_borrow(
    around: Surroundings,
    first: jax.Array,
    until: jax.Array,
    speeds: jax.Array,
    params: PlannerParams,
) -> jax.Array:
    """Whether each borrowed path may be driven at each speed, `[K, S]` bool.

    Something must stand in the ego's way, not passed yet, with room to return beyond it before the
    oncoming lane ends; and whatever comes towards the ego, at its present speed, must either be
    past before the ego crosses the border or arrive `GAP_TIME` after it is back. Scoring looks 4 s
    ahead, which is less than it takes to pass, so nothing else keeps the ego from being caught out
    there. Who comes out of a side road later, or gains speed, is not foreseen. Once the centre is
    across, the ego may go on until the obstacle is behind it: scoring then chooses between that,
    waiting and going back.

    Args:
      around: what the ego has around it.
      first: `[K]` m to the border.
      until: `[K, S]` s to the border.
      speeds: `[S]` m/s beyond the border.
      params: ego dimensions.
    """
    rear, front = overhangs(params.vehicle)
    crossing = jnp.minimum(first, around.back)[:, None]
    time = until + (around.back - crossing) / speeds
    time, until = time[..., None], until[..., None]
    past = around.behind - around.speed * until < crossing[..., None] - rear
    late = around.ahead - around.speed * (time + GAP_TIME) > around.back + front
    free = jnp.all(past | late, axis=-1)
    return around.blocked & (around.entered | (around.room & free))


def _stays(
    path: Path, oncoming: OncomingLane, vehicle: VehicleParams
) -> tuple[jax.Array, jax.Array]:
    """Where the connecting curves `[K]` first and last have the centre in the oncoming lane, m.

    The first is the path's length and the last 0 for a curve that has not.
    """
    x, y, heading, progress = (
        v[:, :CURVE_POINTS] for v in (path.x, path.y, path.heading, path.progress)
    )
    reach = vehicle.rear_axle_to_center
    x, y = x + reach * jnp.cos(heading), y + reach * jnp.sin(heading)
    offset = lateral_offset(oncoming.own, x, y) * oncoming.side
    inside = oncoming.usable & (offset > oncoming.border)
    first = jnp.min(jnp.where(inside, progress, path.length[:, None]), axis=1)
    return first, jnp.max(jnp.where(inside, progress, 0), axis=1)


def _joined(first: jax.Array, left: jax.Array, then: jax.Array) -> jax.Array:
    """Distance `[T]` along one profile for `left` steps, then along another one."""
    step = jnp.arange(first.shape[0])
    at = jnp.minimum(left, first.shape[0] - 1)
    return jnp.where(step <= at, first, first[at] + then[jnp.maximum(step - at, 0)])


def _gain_time(v0: jax.Array, v1: jax.Array) -> jax.Array:
    """Time of a comfortable gain of speed, s."""
    return jnp.maximum(_GAINING * (v1 - v0), _LEAST)


def _slowing(way: jax.Array, ego: EgoState, speeds: jax.Array) -> tuple[jax.Array, jax.Array]:
    """When to begin and how long to take to have each speed `[S]` after a way: step, s.

    The ego keeps its speed as long as comfort lets it; speed is gained at once.
    """
    mean = 0.5 * (ego.vx + speeds)
    wanted = jnp.maximum(_LOSING * (ego.vx - speeds) + _BEFORE, _LEAST)
    begin = jnp.floor((way - mean * wanted) / jnp.maximum(ego.vx * DT, 1e-3))
    begin = jnp.where(speeds > ego.vx, 0, jnp.maximum(begin, 0)).astype(jnp.int32)
    # The way of a cubic over T is mean x T + a0 T^2 / 12.
    root = jnp.sqrt(jnp.maximum(mean**2 + ego.ax * way / 3, 0))
    now = jnp.maximum(2 * way / jnp.maximum(mean + root, 1e-3), _LEAST)
    time = jnp.where(begin > 0, wanted, now)
    return begin, jnp.where(speeds > ego.vx, _gain_time(ego.vx, speeds), time)
