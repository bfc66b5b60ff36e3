"""Contacts between tracked proposals and forecast objects: collisions at fault, and TTC.

The reference walks through time with per-proposal lists of objects already met. Only the first
contact of each (proposal, object) pair can matter: an object at fault at its first contact repeats
the same penalty later, any other is ignored from then on. So the sequential loop becomes a minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.arrays import true_indices, visit_true
from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Box, box_at, boxes_overlap, ego_box
from spdm_jax.scoring.areas import EgoAreas
from spdm_jax.scoring.profile import TUPLAN, Profile
from spdm_jax.types import AgentForecast, CollisionKind, EgoState

LOOK_AHEAD = (0, 3, 6, 9)
"""TTC steps ahead of each time index (0.0, 0.3, 0.6, 0.9 s)."""
_NUM_AHEAD = len(LOOK_AHEAD)

# Up to here one object is compared with all times and proposals at once, from here on time by time
# (measured on a CPU: the temporaries no longer fit its cache).
_ALL_TIMES_LIMIT = 256


class Contacts(NamedTuple):
    """First contacts of each proposal with each object.

    Attributes:
      time: `[P, A]` int32 first time index at which the boxes touch, T if never.
      ttc: `[P, A]` int32 first `4 t + k` at which the ego, moved on by `LOOK_AHEAD[k]` steps,
        touches the object's forecast while the ego moves; 4 T if never.
    """

    time: jax.Array
    ttc: jax.Array


def object_boxes(
    forecast: AgentForecast, num_steps: int, profile: Profile = TUPLAN
) -> tuple[Box, jax.Array]:
    """Boxes `[A, F, T]` at time t + LOOK_AHEAD[f], and whether each can be met at all.

    A query for step k uses sample k // `profile.samples_every`; beyond the last one there is
    nothing to be met.
    """
    wanted = (np.arange(num_steps) + np.array(LOOK_AHEAD)[:, None]) // profile.samples_every
    sample = np.minimum(wanted, forecast.heading.shape[1] - 1)
    heading = forecast.heading[:, sample]
    box = Box(
        forecast.x[:, sample],
        forecast.y[:, sample],
        jnp.cos(heading),
        jnp.sin(heading),
        0.5 * forecast.length[:, None, None],
        0.5 * forecast.width[:, None, None],
    )
    alive = (forecast.valid & ~forecast.ignored)[:, None, None]
    return box, alive & forecast.sample_valid[:, sample] & (wanted == sample)


def first_contacts(
    ego: EgoState,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile = TUPLAN,
) -> Contacts:
    """Finds the first contact of every proposal with every object.

    Args:
      ego: tracked proposals `[P, T]`.
      forecast: objects `[A, S]`.
      vehicle: ego dimensions.
      params: thresholds.
      profile: spacing of the forecast's samples and steps of time to collision.

    Returns:
      `Contacts` `[P, A]`.
    """
    num, steps = ego.x.shape
    box = jax.tree.map(jnp.transpose, ego_box(ego, vehicle))  # [T, P]
    speed = jnp.hypot(ego.vx, ego.vy).T
    index = jnp.arange(steps, dtype=jnp.int32)[:, None]
    moving = (speed >= params.ttc_stopped_speed) & (index < profile.ttc_steps)
    reach = [DT * f * speed for f in LOOK_AHEAD]
    shift_x = jnp.stack([box.x + r * box.cos for r in reach])  # [F, T, P]
    shift_y = jnp.stack([box.y + r * box.sin for r in reach])
    objects, alive = object_boxes(forecast, steps, profile)
    # Beyond the steps that are judged only the collision itself, at f = 0, is looked at.
    alive &= (np.arange(steps) < profile.ttc_steps) | (np.arange(_NUM_AHEAD) == 0)[:, None]
    near = alive & _near_any(shift_x, shift_y, box, objects)  # [A, F, T]
    num_objects = near.shape[0]
    never = jnp.int32(steps * _NUM_AHEAD)
    rows, _ = true_indices(jnp.any(near, axis=(1, 2)), num_objects)
    count = jnp.sum(jnp.any(near, axis=(1, 2)), dtype=jnp.int32)

    def meet(f, t, target: Box, can):
        """Hits of one object at `LOOK_AHEAD[f]`: all times (slice) or one (index)."""
        here = Box(shift_x[f, t], shift_y[f, t], box.cos[t], box.sin[t], *box[4:])
        return boxes_overlap(here, target) & can

    def all_times(target: Box, can):
        first = jnp.full(num, steps, jnp.int32)
        key = jnp.full(num, never, jnp.int32)
        for f in range(_NUM_AHEAD):
            at = jax.tree.map(lambda v, f=f: v[min(f, v.shape[0] - 1), :, None], target)
            hit = meet(f, slice(None), at, can[f, :, None])
            if f == 0:
                first = jnp.min(jnp.where(hit, index, jnp.int32(steps)), axis=0)
            this = jnp.min(jnp.where(hit & moving, index * _NUM_AHEAD + f, never), axis=0)
            key = jnp.minimum(key, this)
        return first, key

    def time_by_time(target: Box, can):
        times = jnp.any(can, axis=0)
        begin = jnp.argmax(times).astype(jnp.int32)
        end = steps - jnp.argmax(times[::-1]).astype(jnp.int32)

        def visit(t, carry):
            first, key = carry
            for f in range(_NUM_AHEAD):
                at = jax.tree.map(lambda v, f=f: v[min(f, v.shape[0] - 1), t % v.shape[1]], target)
                hit = meet(f, t, at, can[f, t])
                if f == 0:
                    first = jnp.where(hit, jnp.minimum(first, t), first)
                when = t * _NUM_AHEAD + f
                key = jnp.where(hit & moving[t], jnp.minimum(key, when), key)
            return first, key

        start = (jnp.full(num, steps, jnp.int32), jnp.full(num, never, jnp.int32))
        return jax.lax.fori_loop(begin, end, visit, start)

    one_object = all_times if num <= _ALL_TIMES_LIMIT else time_by_time

    def visit_object(i, carry):
        first, key = carry
        row = rows[i]
        target = jax.tree.map(lambda v: v[row], objects)
        this_first, this_key = one_object(target, near[row])
        return first.at[row].set(this_first), key.at[row].set(this_key)

    start = (
        jnp.full((num_objects, num), steps, jnp.int32),
        jnp.full((num_objects, num), never, jnp.int32),
    )
    first, key = jax.lax.fori_loop(jnp.int32(0), count, visit_object, start)
    return Contacts(first.T, key.T)


def _near_any(shift_x: jax.Array, shift_y: jax.Array, box: Box, objects: Box) -> jax.Array:
    """Whether an object can touch any proposal at all, `[A, F, T]`: bounds against a circle."""
    ego_reach = jnp.hypot(box.half_length, box.half_width)
    # A little slack: rounding must not lose a touching pair.
    reach = 1.001 * (ego_reach + jnp.hypot(objects.half_length, objects.half_width)) + 1e-3
    low_x, high_x = jnp.min(shift_x, axis=2), jnp.max(shift_x, axis=2)
    low_y, high_y = jnp.min(shift_y, axis=2), jnp.max(shift_y, axis=2)
    return (
        (objects.x >= low_x - reach)
        & (objects.x <= high_x + reach)
        & (objects.y >= low_y - reach)
        & (objects.y <= high_y + reach)
    )


def cos_to_object(ego_x, ego_y, ego_heading, x, y) -> jax.Array:
    """Cosine of the angle between the ego's heading and the direction to a point."""
    dx, dy = x - ego_x, y - ego_y
    norm = jnp.sqrt(dx * dx + dy * dy)
    norm = jnp.where(norm > 0, norm, 1)
    return jnp.cos(ego_heading) * (dx / norm) + jnp.sin(ego_heading) * (dy / norm)


def is_ahead(cos: jax.Array, params: ScoringParams) -> jax.Array:
    """Whether a point at this cosine (see `cos_to_object`) lies ahead of the ego."""
    ahead = cos > jnp.cos(params.ahead_angle)
    if cos.dtype == jnp.float64:
        # nuPlan takes arccos without clipping: rounding above 1 gives NaN, which is not ahead.
        ahead &= cos <= 1
    return ahead


def is_behind(cos: jax.Array, params: ScoringParams) -> jax.Array:
    """Whether a point at this cosine (see `cos_to_object`) lies behind the ego."""
    behind = cos < jnp.cos(params.behind_angle)
    if cos.dtype == jnp.float64:
        behind &= cos >= -1
    return behind


# Contacts judged together.
_PAIRS = 256


def _judge(touched: jax.Array, violates, columns: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First violation of each proposal among the pairs that touch.

    Few pairs touch: they are collected and judged a fixed number at a time, until all are done.

    Args:
      touched: `[P, A]` bool.
      violates: called with proposal and object `[N]`; returns the time index of the contact, and
        whether it is a violation and which penalty (the lowest counts) it gets.
      columns: time indices, T.

    Returns:
      `[P]` time index (T if none), object (-1 if none) and lowest penalty (1 if none).
    """
    num, num_objects = touched.shape
    never = jnp.int32(columns * num_objects)

    def some(index, real, carry):
        key, lowest = carry
        row, column = jnp.divmod(index, num_objects)
        time, violation, penalty = violates(row, column)
        row = jnp.where(violation & real, row, num)
        # Equal times are resolved by the object's number.
        key = key.at[row].min(time * num_objects + column, mode="drop")
        return key, lowest.at[row].min(penalty, mode="drop")

    start = (jnp.full(num, never), jnp.ones(num, jnp.float32))
    key, lowest = visit_true(touched.reshape(-1), _PAIRS, some, start)
    hit = key < never
    time = jnp.where(hit, key // num_objects, columns)
    return time, jnp.where(hit, key % num_objects, -1), lowest


class CollisionResult(NamedTuple):
    """Outcome of the at-fault collision rule, `[P]` each.

    Attributes:
      score: 0 (agent), 0.5 (static object) or 1.
      time_index: int32 of the first at-fault contact, T if none.
      object: int32 forecast row, -1 if none.
      kind: int32 `CollisionKind`, -1 if none.
    """

    score: jax.Array
    time_index: jax.Array
    object: jax.Array
    kind: jax.Array


def collision_kind(
    ego: EgoState,
    forecast: AgentForecast,
    proposal: jax.Array,
    item: jax.Array,
    time: jax.Array,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile = TUPLAN,
) -> jax.Array:
    """`CollisionKind` of contacts, int32 `[...]`.

    Args:
      ego: tracked proposals `[P, T]`.
      forecast: objects `[A, S]`.
      proposal: `[...]` rows of `ego`.
      item: `[...]` rows of `forecast`.
      time: `[...]` time index of the contact.
      vehicle: ego dimensions.
      params: thresholds.
      profile: spacing of the forecast's samples.

    Source: nuPlan `get_collision_type`.
    """
    at = lambda values: values[proposal, time]
    x, y, heading = at(ego.x), at(ego.y), at(ego.heading)
    speed = jnp.hypot(at(ego.vx), at(ego.vy))
    sample = time // profile.samples_every
    other = box_at(
        forecast.x[item, sample],
        forecast.y[item, sample],
        forecast.heading[item, sample],
        0.5 * forecast.length[item],
        0.5 * forecast.width[item],
    )
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    front = vehicle.rear_axle_to_center + 0.5 * vehicle.length
    bumper = Box(
        x + front * cos,
        y + front * sin,
        cos,
        sin,
        jnp.zeros((), x.dtype),
        jnp.asarray(0.5 * vehicle.width, x.dtype),
    )
    behind = is_behind(cos_to_object(x, y, heading, other.x, other.y), params)
    stopped_track = ~forecast.is_agent[item] | (forecast.speed[item] <= params.stopped_speed)
    kind = jnp.where(
        boxes_overlap(bumper, other), CollisionKind.ACTIVE_FRONT, CollisionKind.ACTIVE_LATERAL
    )
    kind = jnp.where(behind, CollisionKind.ACTIVE_REAR, kind)
    kind = jnp.where(stopped_track, CollisionKind.STOPPED_TRACK, kind)
    kind = jnp.where(speed <= params.stopped_speed, CollisionKind.STOPPED_EGO, kind)
    return kind.astype(jnp.int32)


def no_at_fault_collision(
    ego: EgoState,
    areas: EgoAreas,
    forecast: AgentForecast,
    contacts: Contacts,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile = TUPLAN,
) -> CollisionResult:
    """Judges first contacts.

    At fault: a stopped track, a contact of the front bumper, or a lateral one while the ego is in
    multiple lanes or off the drivable area.

    Source: tuplan_garage `PDMScorer._calculate_no_at_fault_collision`, nuPlan
    `get_collision_type`; differs: closed-form separating axes instead of shapely.
    """
    steps = ego.x.shape[1]
    out_of_lane = areas.multiple_lanes | areas.non_drivable

    def violates(proposal, item):
        time = jnp.minimum(contacts.time[proposal, item], steps - 1)
        kind = collision_kind(ego, forecast, proposal, item, time, vehicle, params, profile)
        at_fault = (
            (kind == CollisionKind.STOPPED_TRACK)
            | (kind == CollisionKind.ACTIVE_FRONT)
            | ((kind == CollisionKind.ACTIVE_LATERAL) & out_of_lane[proposal, time])
        )
        return time, at_fault, jnp.where(forecast.is_agent[item], 0.0, 0.5).astype(jnp.float32)

    time, item, score = _judge(contacts.time < steps, violates, steps)
    hit = item >= 0
    row, first = jnp.arange(ego.x.shape[0]), jnp.minimum(time, steps - 1)
    who = jnp.maximum(item, 0)
    kind = collision_kind(ego, forecast, row, who, first, vehicle, params, profile)
    return CollisionResult(score.astype(ego.x.dtype), time, item, jnp.where(hit, kind, -1))


class TTCResult(NamedTuple):
    """Outcome of the time-to-collision rule, `[P]` each.

    Attributes:
      score: 0 or 1.
      time_index: int32 of the first violation, T if none.
      object: int32 forecast row, -1 if none.
    """

    score: jax.Array
    time_index: jax.Array
    object: jax.Array


def time_to_collision(
    ego: EgoState,
    areas: EgoAreas,
    in_intersection: jax.Array,
    forecast: AgentForecast,
    contacts: Contacts,
    params: ScoringParams,
    profile: Profile = TUPLAN,
) -> TTCResult:
    """Judges the first projected contact with each object.

    A violation if the object is ahead (within 30 degrees), or if the ego is in multiple lanes, off
    the drivable area or with its rear axle in an intersection and the object is not behind.

    Args:
      ego: tracked proposals `[P, T]`.
      areas: flags at every state.
      in_intersection: `[P, T]` bool, rear axle inside an intersection.
      forecast: objects.
      contacts: first contacts.
      params: thresholds.
      profile: spacing of the forecast's samples.

    Source: tuplan_garage `PDMScorer._calculate_ttc`.
    """
    steps = ego.x.shape[1]
    never = steps * _NUM_AHEAD
    exposed = areas.multiple_lanes | areas.non_drivable | in_intersection

    def violates(proposal, item):
        key = jnp.minimum(contacts.ttc[proposal, item], never - 1)
        time = key // _NUM_AHEAD
        ahead = jnp.asarray(LOOK_AHEAD, jnp.int32)[key % _NUM_AHEAD]
        sample = (time + ahead) // profile.samples_every
        at = lambda values: values[proposal, time]
        x, y = forecast.x[item, sample], forecast.y[item, sample]
        cos = cos_to_object(at(ego.x), at(ego.y), at(ego.heading), x, y)
        violation = is_ahead(cos, params) | (at(exposed) & ~is_behind(cos, params))
        return time, violation, jnp.where(violation, 0.0, 1.0).astype(jnp.float32)

    time, item, score = _judge(contacts.ttc < never, violates, steps)
    return TTCResult(score.astype(ego.x.dtype), time, item)
