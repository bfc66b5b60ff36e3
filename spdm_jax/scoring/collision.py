"""Contacts between tracked proposals and forecast objects: collisions at fault, and TTC.

The reference walks through time with per-proposal lists of objects already met. Only the first
contact of each (proposal, object) pair can matter: an object at fault at its first contact repeats
the same penalty later, any other is ignored from then on. So the sequential loop becomes a minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.arrays import true_indices
from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Box, boxes_overlap, ego_box
from spdm_jax.scoring.areas import EgoAreas
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


def _object_boxes(forecast: AgentForecast, num_steps: int) -> tuple[Box, jax.Array]:
    """Boxes `[A, F, T]` at time t + LOOK_AHEAD[f], and whether each can be met at all.

    Occupancy maps exist every 0.2 s; a query for step k uses map k // 2.
    """
    sample = (np.arange(num_steps) + np.array(LOOK_AHEAD)[:, None]) // 2
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
    return box, alive & forecast.sample_valid[:, sample]


def first_contacts(
    ego: EgoState, forecast: AgentForecast, vehicle: VehicleParams, params: ScoringParams
) -> Contacts:
    """Finds the first contact of every proposal with every object.

    Args:
      ego: tracked proposals `[P, T]`.
      forecast: objects `[A, S]`.
      vehicle: ego dimensions.
      params: thresholds.

    Returns:
      `Contacts` `[P, A]`.
    """
    num, steps = ego.x.shape
    box = jax.tree.map(jnp.transpose, ego_box(ego, vehicle))  # [T, P]
    speed = jnp.hypot(ego.vx, ego.vy).T
    moving = speed >= params.ttc_stopped_speed
    reach = [DT * f * speed for f in LOOK_AHEAD]
    shift_x = jnp.stack([box.x + r * box.cos for r in reach])  # [F, T, P]
    shift_y = jnp.stack([box.y + r * box.sin for r in reach])
    objects, alive = _object_boxes(forecast, steps)
    near = alive & _near_any(shift_x, shift_y, box, objects)  # [A, F, T]
    num_objects = near.shape[0]
    never = jnp.int32(steps * _NUM_AHEAD)
    index = jnp.arange(steps, dtype=jnp.int32)[:, None]
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


def _cos_to_object(ego_x, ego_y, ego_heading, x, y) -> jax.Array:
    """Cosine of the angle between the ego's heading and the direction to a point."""
    dx, dy = x - ego_x, y - ego_y
    norm = jnp.sqrt(dx * dx + dy * dy)
    norm = jnp.where(norm > 0, norm, 1)
    return jnp.cos(ego_heading) * (dx / norm) + jnp.sin(ego_heading) * (dy / norm)


def _is_ahead(cos: jax.Array, params: ScoringParams) -> jax.Array:
    ahead = cos > jnp.cos(params.ahead_angle)
    if cos.dtype == jnp.float64:
        # nuPlan takes arccos without clipping: rounding above 1 gives NaN, which is not ahead.
        ahead &= cos <= 1
    return ahead


def _is_behind(cos: jax.Array, params: ScoringParams) -> jax.Array:
    behind = cos < jnp.cos(params.behind_angle)
    if cos.dtype == jnp.float64:
        behind &= cos >= -1
    return behind


class CollisionResult(NamedTuple):
    """Outcome of the at-fault collision rule.

    Attributes:
      score: `[P]` 0 (agent), 0.5 (static object) or 1.
      time_index: `[P]` int32 of the first at-fault contact, T if none.
      object: `[P]` int32 forecast row, -1 if none.
      kind: `[P]` int32 `CollisionKind`, -1 if none.
      pair_kind: `[P, A]` int32 kind of each pair's first contact, -1 if they never touch.
    """

    score: jax.Array
    time_index: jax.Array
    object: jax.Array
    kind: jax.Array
    pair_kind: jax.Array


def no_at_fault_collision(
    ego: EgoState,
    areas: EgoAreas,
    forecast: AgentForecast,
    contacts: Contacts,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> CollisionResult:
    """Judges first contacts.

    At fault: a stopped track, a contact of the front bumper, or a lateral one while the ego is in
    multiple lanes or off the drivable area.

    Source: tuplan_garage `PDMScorer._calculate_no_at_fault_collision`, nuPlan
    `get_collision_type`; differs: closed-form separating axes instead of shapely.
    """
    steps = ego.x.shape[1]
    touched = contacts.time < steps
    t = jnp.minimum(contacts.time, steps - 1)

    def at(values):
        return jnp.take_along_axis(values, t, axis=1)

    x, y, heading = at(ego.x), at(ego.y), at(ego.heading)
    speed = jnp.hypot(at(ego.vx), at(ego.vy))
    box = ego_box(ego, vehicle)
    row = jnp.arange(forecast.x.shape[0])
    sample = t // 2
    other = Box(
        forecast.x[row, sample],
        forecast.y[row, sample],
        jnp.cos(forecast.heading[row, sample]),
        jnp.sin(forecast.heading[row, sample]),
        0.5 * forecast.length,
        0.5 * forecast.width,
    )
    cos, sin = at(box.cos), at(box.sin)
    bumper = Box(
        at(box.x) + box.half_length * cos,
        at(box.y) + box.half_length * sin,
        cos,
        sin,
        jnp.zeros_like(box.half_length),
        box.half_width,
    )
    behind = _is_behind(_cos_to_object(x, y, heading, other.x, other.y), params)
    stopped_track = ~forecast.is_agent | (forecast.speed <= params.stopped_speed)
    kind = jnp.where(
        speed <= params.stopped_speed,
        CollisionKind.STOPPED_EGO,
        jnp.where(
            stopped_track,
            CollisionKind.STOPPED_TRACK,
            jnp.where(
                behind,
                CollisionKind.ACTIVE_REAR,
                jnp.where(
                    boxes_overlap(bumper, other),
                    CollisionKind.ACTIVE_FRONT,
                    CollisionKind.ACTIVE_LATERAL,
                ),
            ),
        ),
    ).astype(jnp.int32)
    out_of_lane = at(areas.multiple_lanes | areas.non_drivable)
    at_fault = touched & (
        (kind == CollisionKind.STOPPED_TRACK)
        | (kind == CollisionKind.ACTIVE_FRONT)
        | ((kind == CollisionKind.ACTIVE_LATERAL) & out_of_lane)
    )
    penalty = jnp.where(forecast.is_agent, 0.0, 0.5).astype(ego.x.dtype)
    score = jnp.min(jnp.where(at_fault, penalty, 1.0), axis=1, initial=1.0)
    time = jnp.where(at_fault, contacts.time, steps)
    first, who = _first(time, steps)
    hit = first < steps
    return CollisionResult(
        score=score.astype(ego.x.dtype),
        time_index=first,
        object=jnp.where(hit, who, -1),
        kind=jnp.where(hit, jnp.take_along_axis(kind, who[:, None], 1)[:, 0], -1),
        pair_kind=jnp.where(touched, kind, -1),
    )


def _first(time: jax.Array, never: int) -> tuple[jax.Array, jax.Array]:
    """Smallest entry of each row of `[P, A]` and its column; `never` and 0 where A is 0."""
    if time.shape[1] == 0:
        empty = jnp.zeros(time.shape[0], jnp.int32)
        return empty + never, empty
    return jnp.min(time, axis=1), jnp.argmin(time, axis=1).astype(jnp.int32)


class TTCResult(NamedTuple):
    """Outcome of the time-to-collision rule.

    Attributes:
      score: `[P]` 0 or 1.
      time_index: `[P]` int32 of the first violation, T if none.
      object: `[P]` int32 forecast row, -1 if none.
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

    Source: tuplan_garage `PDMScorer._calculate_ttc`.
    """
    steps = ego.x.shape[1]
    never = steps * _NUM_AHEAD
    touched = contacts.ttc < never
    key = jnp.minimum(contacts.ttc, never - 1)
    t = key // _NUM_AHEAD
    ahead = jnp.asarray(LOOK_AHEAD, jnp.int32)[key % _NUM_AHEAD]
    sample = (t + ahead) // 2
    row = jnp.arange(forecast.x.shape[0])

    def at(values):
        return jnp.take_along_axis(values, t, axis=1)

    cos = _cos_to_object(
        at(ego.x), at(ego.y), at(ego.heading), forecast.x[row, sample], forecast.y[row, sample]
    )
    exposed = at(areas.multiple_lanes | areas.non_drivable | in_intersection)
    violation = touched & (_is_ahead(cos, params) | (exposed & ~_is_behind(cos, params)))
    first, who = _first(jnp.where(violation, t, steps), steps)
    hit = first < steps
    return TTCResult(
        score=jnp.where(hit, 0.0, 1.0).astype(ego.x.dtype),
        time_index=first,
        object=jnp.where(hit, who, -1),
    )
