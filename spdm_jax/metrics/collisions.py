"""Collisions and time to collision of a run.

Each object collides once: at the first sample at which its box touches the ego's. From then on no
metric sees it.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import visit_true
from spdm_jax.geometry import Box, box_at, boxes_overlap
from spdm_jax.metrics.motion import Motion
from spdm_jax.metrics.params import MetricConfig, MetricParams
from spdm_jax.simulation.history import Snapshot
from spdm_jax.types import Array, CollisionKind, EgoState, ObjectType

OBJECT_CLASSES = ("VRUs", "vehicles", "objects")
"""Classes that collisions are counted by, in order."""
_CLASS_OF = (1, 0, 0, 2, 2, 2, 2)  # indexed by ObjectType
_PAIRS = 256  # pairs of sample and object that are projected together


class Collisions(struct.PyTreeNode, kw_only=True):
    """Collisions of one run; fields `[A]` are about the first contact with each object.

    Attributes:
      time_index: `[A]` int32 sample of the first contact, T if none.
      kind: `[A]` int32 `CollisionKind`, -1 if none.
      energy: `[A]` m/s, half the speed difference at contact, 0 if none.
      at_fault: `[A]` bool.
      count: `[3]` at-fault collisions by `OBJECT_CLASSES`.
      energy_max, energy_min, energy_mean: `[3]` m/s of those, NaN where there are none.
      at_fault_now: `[T]` bool, an at-fault collision happens at that sample.
      score: `[]` 0 ... 1.
    """

    time_index: Array
    kind: Array
    energy: Array
    at_fault: Array
    count: Array
    energy_max: Array
    energy_min: Array
    energy_mean: Array
    at_fault_now: Array
    score: Array


def _boxes(objects: Snapshot) -> Box:
    return box_at(objects.x, objects.y, objects.heading, 0.5 * objects.length, 0.5 * objects.width)


def _speed(objects: Snapshot) -> jax.Array:
    """Speed `[T, A]` m/s; static objects stand whatever their velocity says."""
    is_agent = objects.type <= ObjectType.BICYCLE
    return jnp.where(is_agent, jnp.hypot(objects.vx, objects.vy), 0)


def cos_to(ego: EgoState, x: jax.Array, y: jax.Array) -> jax.Array:
    """Cosine of the angle between the ego's heading and points `[T, A]`, from the rear axle `[T]`.

    Source: nuPlan `is_agent_ahead`, `is_agent_behind`.
    """
    at = lambda v: v[:, None]
    dx, dy = x - at(ego.x), y - at(ego.y)
    distance = jnp.hypot(dx, dy)
    along = dx * jnp.cos(at(ego.heading)) + dy * jnp.sin(at(ego.heading))
    return along / jnp.where(distance > 0, distance, 1)


def collisions(
    ego: EgoState,
    move: Motion,
    objects: Snapshot,
    valid: jax.Array,
    in_lane: jax.Array,
    params: MetricParams,
) -> Collisions:
    """Finds and judges the first contact with every object.

    At fault: contacts with a standing object, those of the front bumper, and lateral ones while
    the ego is not within one lane.

    Args:
      ego: `[T]` rear-axle states.
      move: `[T]` its box.
      objects: `[T, A]`, `type` `[A]`.
      valid: `[T]` bool, a prefix.
      in_lane: `[T]` bool, all corners in one lane or in connected ones.
      params: thresholds.

    Source: nuPlan `no_ego_at_fault_collisions`, `_get_collision_type`, `ego_delta_v_collision`.
    """
    steps = valid.shape[0]
    boxes = _boxes(objects)
    present = objects.valid & valid[:, None]
    touching = boxes_overlap(jax.tree.map(_column, move.box), boxes) & present
    hit = jnp.any(touching, axis=0)
    first = jnp.where(hit, jnp.argmax(touching, axis=0), steps).astype(jnp.int32)

    sample = jnp.minimum(first, steps - 1)
    at = lambda values: jnp.take_along_axis(values, sample[None], axis=0)[0]
    box = jax.tree.map(at, boxes)
    speed, other_speed = move.speed[sample], at(_speed(objects))
    turn = jnp.cos(ego.heading[sample] - at(objects.heading))
    square = speed**2 + other_speed**2 - 2 * speed * other_speed * turn
    energy = 0.5 * jnp.sqrt(jnp.maximum(square, 0))

    here = jax.tree.map(lambda v: jnp.broadcast_to(v, (steps,))[sample], move.box)
    bumper = here._replace(
        x=here.x + here.half_length * here.cos,
        y=here.y + here.half_length * here.sin,
        half_length=jnp.zeros_like(here.half_length),
    )
    behind = at(cos_to(ego, objects.x, objects.y)) < jnp.cos(params.behind_angle)
    kind = jnp.where(
        boxes_overlap(bumper, box), CollisionKind.ACTIVE_FRONT, CollisionKind.ACTIVE_LATERAL
    )
    kind = jnp.where(behind, CollisionKind.ACTIVE_REAR, kind)
    kind = jnp.where(other_speed <= params.stopped_speed, CollisionKind.STOPPED_TRACK, kind)
    kind = jnp.where(speed <= params.stopped_speed, CollisionKind.STOPPED_EGO, kind)
    at_fault = hit & (
        (kind == CollisionKind.STOPPED_TRACK)
        | (kind == CollisionKind.ACTIVE_FRONT)
        | ((kind == CollisionKind.ACTIVE_LATERAL) & ~in_lane[sample])
    )

    member = at_fault & (jnp.asarray(_CLASS_OF)[objects.type] == jnp.arange(3)[:, None])
    count = jnp.sum(member, axis=1, dtype=jnp.int32)
    some = count > 0
    reduce = lambda function, fill: jnp.where(
        some, function(jnp.where(member, energy, fill), axis=1), jnp.nan
    )
    allowed = jnp.asarray(params.collisions_allowed, energy.dtype)
    score = jnp.prod(jnp.maximum(1 - count / (allowed + 1), 0))
    return Collisions(
        time_index=first,
        kind=jnp.where(hit, kind, -1).astype(jnp.int32),
        energy=jnp.where(hit, energy, 0),
        at_fault=at_fault,
        count=count,
        energy_max=reduce(_max, -jnp.inf),
        energy_min=reduce(_min, jnp.inf),
        energy_mean=reduce(jnp.sum, 0) / jnp.maximum(count, 1),
        at_fault_now=jnp.any(at_fault & (first == jnp.arange(steps)[:, None]), axis=1),
        score=score,
    )


def _max(values: jax.Array, axis: int) -> jax.Array:
    # An initial value lets runs without objects pass.
    return jnp.max(values, axis=axis, initial=-jnp.inf)


def _min(values: jax.Array, axis: int) -> jax.Array:
    return jnp.min(values, axis=axis, initial=jnp.inf)


def _column(values: jax.Array) -> jax.Array:
    return values[:, None] if values.ndim else values


class TimeToCollision(struct.PyTreeNode, kw_only=True):
    """Time to collision of one run.

    Attributes:
      values: `[T]` s, 0 at an at-fault collision, inf where nothing is met.
      object: `[T]` int32 object met first (or at fault), -1 where none.
      minimum: `[]` s.
      score: `[]` 0 or 1.
    """

    values: Array
    object: Array
    minimum: Array
    score: Array


def time_to_collision(
    ego: EgoState,
    move: Motion,
    objects: Snapshot,
    valid: jax.Array,
    in_lane: jax.Array,
    in_intersection: jax.Array,
    contacts: Collisions,
    params: MetricParams,
    config: MetricConfig,
) -> TimeToCollision:
    """Projects ego and objects along their headings at constant speed until they touch.

    Objects count while they have not collided and are ahead; those beside the ego as well while
    it is not within one lane or its rear axle is in an intersection.

    Args:
      ego: `[T]` rear-axle states.
      move: `[T]` its box.
      objects: `[T, A]`, `type` `[A]`.
      valid: `[T]` bool, a prefix.
      in_lane: `[T]` bool, all corners in one lane or in connected ones.
      in_intersection: `[T]` bool, of the rear axle.
      contacts: first contacts.
      params: thresholds.
      config: projected times.

    Source: nuPlan `time_to_collision_within_bound`.
    """
    steps, num_objects = objects.valid.shape
    times = config.ttc_times
    num_times = len(times)
    cos = cos_to(ego, objects.x, objects.y)
    exposed = ~in_lane | in_intersection
    relevant = (cos > jnp.cos(params.ahead_angle)) | (
        exposed[:, None] & (cos >= jnp.cos(params.behind_angle))
    )
    index = jnp.arange(steps, dtype=jnp.int32)[:, None]
    moving = (move.speed > params.ttc_stopped_speed) & valid
    relevant &= objects.valid & (index < contacts.time_index) & moving[:, None]
    box, others = jax.tree.map(_column, move.box), _boxes(objects)
    own_speed, other_speed = move.speed[:, None], _speed(objects)
    relevant &= boxes_overlap(
        _swept(box, own_speed, config.ttc_horizon), _swept(others, other_speed, config.ttc_horizon)
    )

    # Few pairs come so far; each gets its first contact, and each sample the first of those.
    never = jnp.int32(num_times * num_objects)
    dtype = ego.x.dtype

    def project(pair, real, key):
        row, column = pair // num_objects, pair % num_objects
        mine = jax.tree.map(lambda v: jnp.broadcast_to(v, (steps, 1))[row], box)
        other = jax.tree.map(lambda v: v[row, column][:, None], others)
        ahead = jnp.asarray(times, dtype)
        touch = boxes_overlap(
            _moved(mine, own_speed[row] * ahead),
            _moved(other, other_speed[row, column][:, None] * ahead),
        )
        found = jnp.where(
            jnp.any(touch, axis=1) & real,
            jnp.argmax(touch, axis=1).astype(jnp.int32) * num_objects + column,
            never,
        )
        return key.at[row].min(found)

    key = jnp.full(steps, never, jnp.int32)
    if num_objects:
        key = visit_true(relevant.reshape(-1), _PAIRS, project, key)
    met = key < never
    position = jnp.where(met, key // max(num_objects, 1), 0)
    values = jnp.where(met, jnp.asarray(times, dtype)[position], jnp.inf)
    item = jnp.where(met, key % max(num_objects, 1), -1)

    at_fault = contacts.at_fault & (contacts.time_index == index)
    values = jnp.where(contacts.at_fault_now, 0, values)
    if num_objects:
        item = jnp.where(contacts.at_fault_now, jnp.argmax(at_fault, axis=1), item)
    minimum = jnp.min(values)
    return TimeToCollision(
        values=values,
        object=item.astype(jnp.int32),
        minimum=minimum,
        score=(minimum > params.least_ttc).astype(dtype),
    )


def _moved(box: Box, distance: jax.Array) -> Box:
    return box._replace(x=box.x + distance * box.cos, y=box.y + distance * box.sin)


def _swept(box: Box, speed: jax.Array, horizon: float) -> Box:
    """The area that a box covers on its way, a little enlarged against rounding."""
    reach = 0.5 * speed * horizon
    margin = 1e-3
    return _moved(box, reach)._replace(
        half_length=box.half_length + reach + margin, half_width=box.half_width + margin
    )
