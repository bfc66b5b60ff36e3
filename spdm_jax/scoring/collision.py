"""Contacts between tracked proposals and forecast objects: collisions at fault, and TTC.

The reference walks through time with per-proposal lists of objects already met. Only the first
contact of each (proposal, object) pair can matter: an object at fault at its first contact repeats
the same penalty later, any other is ignored from then on. So the sequential loop becomes a minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Box, boxes_overlap, ego_box
from spdm_jax.scoring.areas import EgoAreas
from spdm_jax.types import AgentForecast, CollisionKind, EgoState

LOOK_AHEAD = (0, 3, 6, 9)
"""TTC steps ahead of each time index (0.0, 0.3, 0.6, 0.9 s)."""
_NUM_AHEAD = len(LOOK_AHEAD)

# From here on a loop over objects beats one broadcast over objects, time and proposals (CPU).
_BROADCAST_LIMIT = 128


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
    never = jnp.int32(steps * _NUM_AHEAD)

    def hits(f, t, target: Box, can):
        here = Box(shift_x[f, t], shift_y[f, t], box.cos[t], box.sin[t], *box[4:])
        return boxes_overlap(here, target) & can

    if num <= _BROADCAST_LIMIT:
        every = slice(None)
        first, key = None, None
        index = jnp.arange(steps, dtype=jnp.int32)[:, None]
        for f in range(_NUM_AHEAD):
            target = Box(
                objects.x[:, f, :, None],
                objects.y[:, f, :, None],
                objects.cos[:, f, :, None],
                objects.sin[:, f, :, None],
                objects.half_length,
                objects.half_width,
            )
            hit = hits(f, every, target, alive[:, f, :, None])  # [A, T, P]
            if f == 0:
                first = jnp.min(jnp.where(hit, index, jnp.int32(steps)), axis=1)
            this = jnp.min(jnp.where(hit & moving, index * _NUM_AHEAD + f, never), axis=1)
            key = this if key is None else jnp.minimum(key, this)
        assert first is not None and key is not None
        return Contacts(first.T, key.T)

    def one_object(args):
        target, can = args

        def at(t, carry):
            first, key = carry
            for f in range(_NUM_AHEAD):
                here = Box(
                    target.x[f, t],
                    target.y[f, t],
                    target.cos[f, t],
                    target.sin[f, t],
                    target.half_length[0, 0],
                    target.half_width[0, 0],
                )
                hit = hits(f, t, here, can[f, t])
                if f == 0:
                    first = jnp.where(hit, jnp.minimum(first, t), first)
                when = t * _NUM_AHEAD + f
                key = jnp.where(hit & moving[t], jnp.minimum(key, when), key)
            return first, key

        start = (jnp.full(num, steps, jnp.int32), jnp.full(num, never, jnp.int32))
        return jax.lax.fori_loop(jnp.int32(0), jnp.int32(steps), at, start)

    first, key = jax.lax.map(one_object, (objects, alive))
    return Contacts(first.T, key.T)


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
