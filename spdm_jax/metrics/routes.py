"""Which lanes a run drove on: the box centre's route, the corners' lanes, lane changes.

The reference keeps lists of map objects; here a list is a row of flags `[L]` over the map's lanes
and connectors, and its first element is the lowest row.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.map_rows import polygon_distance
from spdm_jax.scoring.areas import Areas
from spdm_jax.types import Lanes


def first_of(members: jax.Array) -> jax.Array:
    """First element of lists `[..., L]`, `[...]` int32; 0 for an empty one."""
    return jnp.argmax(members, axis=-1).astype(jnp.int32)


def _linked(table: jax.Array, lane: jax.Array) -> jax.Array:
    """The lanes that a link table `[L, S]` names for one lane, as a list `[L]`."""
    return jnp.any(table[lane][:, None] == jnp.arange(table.shape[0]), axis=0)


def _names_any(table: jax.Array, members: jax.Array) -> jax.Array:
    """Lanes for which a link table `[L, S]` names a member of lists `[..., L]`, `[..., L]`."""
    result = jnp.zeros(members.shape, bool)
    for slot in range(table.shape[1]):
        named = jnp.take(members, jnp.maximum(table[:, slot], 0), axis=-1)
        result |= named & (table[:, slot] >= 0)
    return result


def following(lanes: Lanes, members: jax.Array) -> jax.Array:
    """Outgoing edges of all members of lists `[..., L]`."""
    return _names_any(lanes.predecessors, members)


def leading_to(lanes: Lanes, members: jax.Array) -> jax.Array:
    """Incoming edges of all members of lists `[..., L]`."""
    return _names_any(lanes.successors, members)


def _look_up(lanes: Lanes, inside: jax.Array) -> jax.Array:
    """The lane among `[..., L]`, else all connectors.

    Lanes do not overlap; where a map has them do so, the lowest row counts.
    """
    plain = inside & ~lanes.is_connector
    one = jnp.arange(inside.shape[-1]) == first_of(plain)[..., None]
    return jnp.where(jnp.any(plain, axis=-1, keepdims=True), plain & one, inside)


def _keep_on(lanes: Lanes, members: jax.Array, inside: jax.Array) -> jax.Array:
    """Members `[L]` that contain a point, else edges out of a single member that do."""
    kept = members & inside
    single = jnp.sum(members, dtype=jnp.int32) == 1
    onward = _linked(lanes.successors, first_of(members)) & inside & single
    return jnp.where(jnp.any(kept), kept, onward)


def _near_members(
    lanes: Lanes, members: jax.Array, x: jax.Array, y: jax.Array, reach: jax.Array
) -> jax.Array:
    """Members `[L]` whose polygon is nearer to a point than `reach`, m."""

    def look(state):
        rest, near = state
        lane = first_of(rest)
        close = polygon_distance(lanes.polygon, lane, x, y) < reach
        return rest.at[lane].set(False), near.at[lane].set(close)

    return jax.lax.while_loop(
        lambda state: jnp.any(state[0]), look, (members, jnp.zeros_like(members))
    )[1]


def driven_route(
    lanes: Lanes,
    areas: Areas,
    x: jax.Array,
    y: jax.Array,
    valid: jax.Array,
    near_connector: jax.Array | float,
) -> jax.Array:
    """Lanes or connectors that a point drove on, `[T, L]` bool.

    Args:
      lanes: of the map.
      areas: `[T]` what contains each point.
      x: `[T]` m.
      y: `[T]` m.
      valid: `[T]` bool, a prefix; the lists after it are empty.
      near_connector: m, a point that leaves its connector for another one, or within an
        intersection for none, stays on it while nearer than this.

    Source: nuPlan `get_route`.
    """

    def step(before, now):
        index, inside, crossing, px, py, real = now
        kept = _keep_on(lanes, before, inside)
        found = _look_up(lanes, inside)
        on_connector = lanes.is_connector[first_of(before)] & jnp.any(before)
        astray = jnp.where(jnp.any(found), lanes.is_connector[first_of(found)], crossing)
        lost = ~jnp.any(kept) & real
        stray = lost & (index > 1) & on_connector & astray
        near = _near_members(lanes, before & stray, px, py, jnp.asarray(near_connector, px.dtype))
        found = jnp.where(jnp.any(near), near, found)
        route = jnp.where(jnp.any(kept), kept, found) & real
        return route, route

    index = jnp.arange(x.shape[0])
    nothing = jnp.zeros(lanes.valid.shape, bool)
    inputs = (index, areas.lanes, areas.intersection, x, y, valid)
    _, route = jax.lax.scan(step, nothing, inputs)

    def settle(after, now):
        """Drops connectors that the route's continuation rules out."""
        following_list, exists = after
        members, real = now
        count = jnp.sum(members, dtype=jnp.int32)
        many = exists & (count > 1)
        fewer = count > jnp.sum(following_list, dtype=jnp.int32)
        # An empty list passes this test and empties the one before it, as in the reference.
        culled = many & fewer & jnp.all(~following_list | members)
        result = jnp.where(culled, following_list, members)
        lane = first_of(following_list)
        to_lane = many & jnp.any(following_list) & ~lanes.is_connector[lane]
        entering = members & _linked(lanes.predecessors, lane)
        result = jnp.where(to_lane & jnp.any(entering), entering, result)
        return (result, real), result

    _, route = jax.lax.scan(settle, (nothing, jnp.bool_(False)), (route, valid), reverse=True)
    return route


class CornerLanes(NamedTuple):
    """Where the box's corners were.

    Attributes:
      corners: `[T, 4, L]` bool, the list of each corner.
      common: `[T, L]` bool, objects that all corners share or that connect them.
      in_lane: `[T]` bool, there are such objects.
      apart: `[T]` bool, some corner is on a lane and there are no such objects.
    """

    corners: jax.Array
    common: jax.Array
    in_lane: jax.Array
    apart: jax.Array


def corner_lanes(lanes: Lanes, inside: jax.Array) -> CornerLanes:
    """Follows the box's corners through the lanes.

    Args:
      lanes: of the map.
      inside: `[T, 4, L]` bool, lanes and connectors that contain each corner.

    Source: nuPlan `extract_corners_route` and `get_common_or_connected_route_objs_of_corners`.
    """

    def step(candidates, now):
        index, here = now
        following_candidates, lists = jnp.zeros_like(candidates), []
        for corner in range(4):
            kept = _keep_on(lanes, candidates, here[corner])
            found = _look_up(lanes, here[corner])
            lost = ~jnp.any(kept)
            members = jnp.where(lost, found, kept)
            candidates = candidates | (members & lost & (index == 1))
            following_candidates = following_candidates | members
            lists.append(members)
        return following_candidates, jnp.stack(lists)

    index = jnp.arange(inside.shape[0])
    _, corners = jax.lax.scan(step, jnp.zeros(lanes.valid.shape, bool), (index, inside))

    front_left, rear_left, rear_right, front_right = (corners[:, i] for i in range(4))
    shared = front_left & rear_left & rear_right & front_right
    right_onward = rear_right | following(lanes, rear_right)
    left_onward = rear_left | following(lanes, rear_left)
    rear = (rear_left & right_onward) | (rear_right & left_onward)
    left_back = front_left | leading_to(lanes, front_left)
    right_back = front_right | leading_to(lanes, front_right)
    joined = left_back & right_onward & right_back & left_onward
    joined &= jnp.any(rear, axis=-1, keepdims=True)
    on_lane = jnp.any(corners, axis=-1)
    common = jnp.where(jnp.any(shared, axis=-1, keepdims=True), shared, joined)
    common &= jnp.all(on_lane, axis=-1)[:, None]
    in_lane = jnp.any(common, axis=-1)
    return CornerLanes(corners, common, in_lane, jnp.any(on_lane, axis=-1) & ~in_lane)


class LaneChanges(NamedTuple):
    """Lane changes of a run, each at the sample that ends it.

    Attributes:
      ended: `[T]` bool; a change that the run's end cuts off ends at its last sample.
      succeeded: `[T]` bool, it led to a lane that does not follow the first one.
      duration: `[T]` s, 0 where none ended.
      number: `[]`.
      longest: `[]` s, NaN without lane changes, like the two fields that follow.
      mean: `[]` s.
      failed_ratio: `[]`.
    """

    ended: jax.Array
    succeeded: jax.Array
    duration: jax.Array
    number: jax.Array
    longest: jax.Array
    mean: jax.Array
    failed_ratio: jax.Array


def lane_changes(
    lanes: Lanes, corners: CornerLanes, time: jax.Array, valid: jax.Array
) -> LaneChanges:
    """Finds lane changes: from in a lane, over several, to in a lane or to off all lanes.

    Args:
      lanes: of the map.
      corners: `[T]`.
      time: `[T]` s.
      valid: `[T]` bool, a prefix.

    Source: nuPlan `find_lane_changes`.
    """
    reachable = corners.common | following(lanes, corners.common)

    def step(state, now):
        open_, start, origin, was_in_lane, reach = state
        common, apart, in_lane, moment, last, next_reach = now
        ended = open_ & (~apart | last)
        succeeded = ended & in_lane & ~jnp.any(origin & common)
        duration = jnp.where(ended, moment - start, 0)
        begins = ~open_ & apart & was_in_lane
        # A change that begins with the last sample ends with it.
        ended |= begins & last
        start = jnp.where(begins, moment, start)
        origin = jnp.where(begins, reach, origin)
        open_ = (open_ | begins) & ~ended
        return (open_, start, origin, in_lane, next_reach), (ended, succeeded, duration)

    count = jnp.sum(valid, dtype=jnp.int32)
    last = jnp.arange(time.shape[0]) == count - 1
    nothing = jnp.zeros(lanes.valid.shape, bool)
    start = (jnp.bool_(False), time[0], nothing, jnp.bool_(False), nothing)
    inputs = (
        corners.common,
        corners.apart & valid,
        corners.in_lane & valid,
        time,
        last,
        reachable,
    )
    _, (ended, succeeded, duration) = jax.lax.scan(step, start, inputs)
    ended &= valid
    number = jnp.sum(ended, dtype=jnp.int32)
    share = lambda v: jnp.where(number > 0, v / jnp.maximum(number, 1), jnp.nan)
    duration = jnp.where(ended, duration, 0)
    return LaneChanges(
        ended=ended,
        succeeded=succeeded & ended,
        duration=duration,
        number=number,
        longest=jnp.where(number > 0, jnp.max(duration), jnp.nan),
        mean=share(jnp.sum(duration)),
        failed_ratio=share(jnp.sum(ended & ~succeeded).astype(time.dtype)),
    )
