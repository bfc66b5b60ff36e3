"""Driving direction and speed limits along the lanes of a run."""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum
from spdm_jax.map_rows import arc_length_at
from spdm_jax.metrics.motion import Motion
from spdm_jax.metrics.params import MetricParams
from spdm_jax.metrics.routes import first_of
from spdm_jax.metrics.series import seconds
from spdm_jax.types import Array, Lanes


def last_before(flags: jax.Array) -> jax.Array:
    """Index of the last True before each entry of `[T]` flags, -1 if there is none."""
    index = jnp.where(flags, jnp.arange(flags.shape[0], dtype=jnp.int32), -1)
    return jnp.concatenate([jnp.full(1, -1, jnp.int32), jax.lax.cummax(index)[:-1]])


class DrivingDirection(struct.PyTreeNode, kw_only=True):
    """Driving-direction compliance of one run.

    Attributes:
      values: `[T]` m driven along the lane's direction within the last second.
      minimum: `[]` m, minus the amount of the smallest of them.
      score: `[]` 0, 0.5 or 1.
    """

    values: Array
    minimum: Array
    score: Array


def driving_direction(
    lanes: Lanes,
    move: Motion,
    route: jax.Array,
    time: jax.Array,
    valid: jax.Array,
    params: MetricParams,
) -> DrivingDirection:
    """Judges driving against the traffic.

    The arc length of the centre on its lane's baseline, differenced from sample to sample. It
    counts nothing at the sample that enters a lane and at the next one (the run's first lane: at
    the first sample alone), off all lanes, and at an arc length of exactly 0, as in the reference.

    Args:
      lanes: of the map.
      move: `[T]` the ego's box.
      route: `[T, L]` bool, lanes of the centre.
      time: `[T]` s.
      valid: `[T]` bool, a prefix.
      params: window and thresholds.

    Source: nuPlan `driving_direction_compliance`.
    """
    on_lane = jnp.any(route, axis=-1)
    lane = first_of(route)
    before = last_before(on_lane)
    known = before >= 0
    index = jnp.arange(valid.shape[0], dtype=jnp.int32)
    same = on_lane & ((index == 0) | (known & (lane == lane[before])))
    place = arc_length_at(lanes.centerline, lane, move.box.x, move.box.y)
    counts = same & known & same[before] & (place != 0)
    progress = jnp.where(counts, place - place[before], 0)

    # Whole microseconds keep the number of samples in the window free of rounding.
    duration, _ = seconds(time, valid)
    count = jnp.sum(valid, dtype=jnp.int32)
    micros = jnp.round(duration * 1e6)
    window = jnp.asarray(params.direction_horizon, time.dtype) * 1e6 * (count - 1)
    span = jnp.floor(window / jnp.where(micros > 0, micros, 1)).astype(jnp.int32)
    total = prefix_sum(progress)
    start = index - span - 1
    values = total - jnp.where(start >= 0, total[jnp.maximum(start, 0)], 0)
    values = jnp.where(valid, values, 0)
    against = jnp.abs(jnp.min(jnp.where(valid, values, jnp.inf)))
    score = jnp.where(
        against < params.direction_compliant,
        1.0,
        jnp.where(against < params.direction_violation, 0.5, 0.0),
    )
    known = count > 1
    dtype = move.box.x.dtype
    return DrivingDirection(
        values=values,
        minimum=jnp.where(known, -against, jnp.nan),
        score=jnp.where(known, score, jnp.nan).astype(dtype),
    )


class SpeedLimit(struct.PyTreeNode, kw_only=True):
    """Speed-limit compliance of one run.

    Attributes:
      limit: `[T]` m/s, inf where there is none or it is not known.
      over: `[T]` m/s above the limit.
      number: `[]` violations, each a run of samples.
      highest, lowest: `[]` m/s, extremes over violations of their maxima; NaN without violations.
      mean: `[]` m/s, means of the violations weighted by their durations; NaN where all last 0 s.
      score: `[]` 0 ... 1.
    """

    limit: Array
    over: Array
    number: Array
    highest: Array
    lowest: Array
    mean: Array
    score: Array


def _known_limits(lanes: Lanes) -> tuple[jax.Array, jax.Array]:
    """Limit of each lane or connector `[L]`, m/s, and whether it is known.

    A connector takes the highest limit of the lanes before and after it, not its own, as in the
    reference; one of those unknown leaves it unknown, none at all gives -inf.
    """
    links = jnp.concatenate([lanes.successors, lanes.predecessors], axis=1)
    there = links >= 0
    own = lanes.speed_limit > 0  # False for NaN
    linked = jnp.where(there, lanes.speed_limit[jnp.maximum(links, 0)], -jnp.inf)
    all_known = jnp.all(~there | (linked > 0), axis=1)
    limit = jnp.where(lanes.is_connector, jnp.max(linked, axis=1), lanes.speed_limit)
    known = jnp.where(lanes.is_connector, all_known, own)
    return jnp.where(known, limit, -jnp.inf), known


def speed_limit(
    lanes: Lanes,
    speed: jax.Array,
    route: jax.Array,
    time: jax.Array,
    valid: jax.Array,
    params: MetricParams,
) -> SpeedLimit:
    """Judges the rear axle's speed against the limits of the centre's lanes.

    Args:
      lanes: of the map.
      speed: `[T]` m/s.
      route: `[T, L]` bool, lanes of the centre.
      time: `[T]` s.
      valid: `[T]` bool, a prefix.
      params: scale of the score.

    Source: nuPlan `speed_limit_compliance`.
    """
    limits, known = _known_limits(lanes)
    highest = jnp.max(jnp.where(route, limits, -jnp.inf), axis=1)
    certain = (highest > 0) & jnp.all(~route | known, axis=1)
    limit = jnp.where(certain & valid, highest, jnp.inf)
    over = jnp.maximum(speed - limit, 0)
    duration, step = seconds(time, valid)
    scale = jnp.maximum(jnp.asarray(params.max_overspeed, speed.dtype), 1e-3)
    loss = jnp.sum(over) * step / (scale * jnp.where(duration > 0, duration, 1))
    violated = over > 0
    free = ~jnp.any(violated) | (duration <= 0)
    score = jnp.where(free, 1, jnp.maximum(1 - loss, 0))

    # Each violation at its last sample: maximum, mean and duration until the next free sample.
    begins = violated & ~jnp.concatenate([jnp.zeros(1, bool), violated[:-1]])
    ends = violated & ~jnp.concatenate([violated[1:], jnp.zeros(1, bool)])
    count = jnp.sum(valid, dtype=jnp.int32)

    def follow(state, now):
        most, total, number, start = state
        value, first, moment = now
        most = jnp.where(first, value, jnp.maximum(most, value))
        total = jnp.where(first, value, total + value)
        number = jnp.where(first, 1, number + 1)
        start = jnp.where(first, moment, start)
        return (most, total, number, start), (most, total / number, start)

    zero = jnp.zeros((), over.dtype)
    _, (most, mean, start) = jax.lax.scan(
        follow, (zero, zero, jnp.int32(0), time[0]), (over, begins, time)
    )
    after = jnp.minimum(jnp.arange(valid.shape[0]) + 1, jnp.maximum(count - 1, 0))
    lasting = jnp.where(ends, time[after] - start, 0)
    some = jnp.any(ends)
    whole = jnp.sum(lasting)
    return SpeedLimit(
        limit=limit,
        over=over,
        number=jnp.sum(ends, dtype=jnp.int32),
        highest=jnp.where(some, jnp.max(jnp.where(ends, most, -jnp.inf)), jnp.nan),
        lowest=jnp.where(some, jnp.min(jnp.where(ends, most, jnp.inf)), jnp.nan),
        mean=jnp.where(
            whole > 0,
            jnp.sum(jnp.where(ends, mean * lasting, 0)) / jnp.where(whole > 0, whole, 1),
            jnp.nan,
        ),
        score=score.astype(speed.dtype),
    )
