"""Stage 1: IDM proposals along the centreline and its parallels."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.agents.observation import RedLights, ego_inside
from spdm_jax.config import DT, IDMParams, VehicleParams
from spdm_jax.geometry import (
    Box,
    Path,
    box_distance,
    interpolate,
    project,
    segment_box_distance,
    wrap,
)
from spdm_jax.proposals.corridor import (
    corridor_axis,
    corridor_hits_lights,
    corridors_hit_boxes,
    object_boxes,
    project_where,
)
from spdm_jax.types import AgentForecast

IDM_EXPONENT = 10
WINDOW = 21
"""Forecast samples whose corridor contents are found together."""
PLAN_SECONDS = 8.0
"""Length of the driving corridor at the highest target speed, s (tuplan_garage)."""


class CorridorContents(NamedTuple):
    """What lies in each path's corridor: objects first, then red lights.

    Attributes:
      hit: `[L, S, A + R]` bool, inside at forecast sample s.
      progress: `[L, S, A + R]` arc length of the object's centroid on the path, m.
      rank: `[A + R]` or `[L, S, A + R]` int32, order in which equal distances are resolved.
    """

    hit: jax.Array
    progress: jax.Array
    rank: jax.Array


class Leader(NamedTuple):
    """What an IDM agent follows, `[...]` each.

    Attributes:
      progress: m along the path.
      speed: m/s.
      rear: rear length, m.
    """

    progress: jax.Array
    speed: jax.Array
    rear: jax.Array


class IDMRollout(NamedTuple):
    """Rolled-out policies of every path.

    Attributes:
      progress: `[L, K, T]` m along the own path.
      speed: `[L, K, T]` m/s; may become slightly negative, as in the reference.
      leader: `Leader` of `[L, K, T]`, used for the step to that index (0 at index 0).
      leader_index: `[L, K, T]` int32 object or light, -1 free road, -2 not evaluated.
    """

    progress: jax.Array
    speed: jax.Array
    leader: Leader
    leader_index: jax.Array


def idm_step(
    progress: jax.Array,
    speed: jax.Array,
    leader: Leader,
    target_speed: jax.Array,
    params: IDMParams,
) -> tuple[jax.Array, jax.Array]:
    """One explicit Euler step of the intelligent driver model.

    s* = s0 + v T + v (v - v_lead) / (2 sqrt(a b)), s = max(x_lead - x - rear, s0),
    acceleration = clip(a (1 - (v / v_target)^10 - (s* / s)^2), -b, a). Position moves with the old
    speed; the speed is not clipped at 0.

    Source: tuplan_garage `BatchIDMPolicy.propagate`; Treiber et al. 2000.
    """
    accel_max, decel_max, gap = params.accel_max, params.decel_max, params.min_gap
    wanted = (
        gap
        + speed * params.headway_time
        + speed * (speed - leader.speed) / (2 * jnp.sqrt(accel_max * decel_max))
    )
    space = jnp.maximum(leader.progress - progress - leader.rear, gap)
    accel = accel_max * (
        1 - (speed / target_speed) ** IDM_EXPONENT - (wanted / space) * (wanted / space)
    )
    accel = jnp.clip(accel, -decel_max, accel_max)
    return progress + DT * speed, speed + DT * accel


def corridor_contents(
    paths: Path,
    start: jax.Array,
    max_speed: jax.Array,
    forecast: AgentForecast,
    red: RedLights,
    vehicle: VehicleParams,
) -> CorridorContents:
    """Finds what lies in the corridor of each path.

    Args:
      paths: `[L, M]` paths.
      start: `[L]` ego arc length on each path, m.
      max_speed: highest target speed, m/s.
      forecast: objects.
      red: red lights.
      vehicle: ego dimensions (the corridor is as wide as the ego).

    Returns:
      `CorridorContents`; padded objects and lights are never hit.

    Source: tuplan_garage `PDMGenerator._initialize_proposals`, `_update_leading_agents`.
    """
    half_width = jnp.asarray(0.5 * vehicle.width, paths.x.dtype)
    reach = max_speed * PLAN_SECONDS
    axes = jax.vmap(lambda path, begin: corridor_axis(path, begin, begin + reach))(paths, start)
    present = (forecast.sample_valid & forecast.valid[:, None]).T
    boxes = jax.tree.map(_in_windows, object_boxes(forecast))

    # In short windows of time an object sweeps little of the road.
    hit = corridors_hit_boxes(axes, half_width, boxes, _in_windows(present))
    progress = project_where(paths, half_width, boxes, hit)
    shape = (start.shape[0], *present.shape)
    hit, progress = (
        jnp.moveaxis(v, 0, 1).reshape(shape[0], -1, shape[2])[:, : shape[1]]
        for v in (hit, progress)
    )

    num_lights = red.valid.shape[0]

    def lights():
        inside = jax.lax.map(lambda axis: corridor_hits_lights(axis, half_width, red), axes)
        at = jax.vmap(lambda path: project(path, red.centroid[:, 0], red.centroid[:, 1]))(paths)
        return inside, at

    def no_lights():
        empty = jnp.zeros((shape[0], num_lights), bool)
        return empty, empty.astype(paths.x.dtype)

    light, light_progress = jax.lax.cond(jnp.any(red.valid), lights, no_lights)

    def over_time(values):
        return jnp.broadcast_to(values[:, None], (*shape[:2], num_lights))

    return CorridorContents(
        hit=jnp.concatenate([hit, over_time(light)], axis=2),
        progress=jnp.concatenate([progress, over_time(light_progress)], axis=2),
        rank=jnp.arange(shape[2] + num_lights, dtype=jnp.int32),
    )


def _in_windows(values: jax.Array) -> jax.Array:
    """`[S, N]` samples in `[W, WINDOW, N]` windows, the last one filled with the last sample."""
    num = values.shape[0]
    index = np.minimum(np.arange(-(-num // WINDOW) * WINDOW), num - 1)
    return values[index].reshape(-1, WINDOW, values.shape[1])


class _Search(NamedTuple):
    """Everything a leader search reads that does not change along the rollout."""

    boxes: Box  # [S, A]
    heading: jax.Array  # [A] current heading of agents
    speed: jax.Array  # [A]
    contents: CorridorContents
    eligible: jax.Array  # [A + R]
    red: RedLights
    any_red: jax.Array


def _search(forecast: AgentForecast, red: RedLights, contents: CorridorContents) -> _Search:
    return _Search(
        boxes=object_boxes(forecast),
        heading=forecast.current_heading,
        speed=jnp.where(forecast.is_agent, forecast.speed, 0),
        contents=contents,
        eligible=jnp.concatenate([forecast.valid & ~forecast.ignored, red.valid & ~red.ignored]),
        red=red,
        any_red=jnp.any(red.valid & ~red.ignored),
    )


class _Found(struct.PyTreeNode):
    """Result of a leader search before the published quirks, `[...]` each."""

    index: jax.Array  # object or light, -1 free
    progress: jax.Array
    speed: jax.Array  # of an object; meaningless otherwise
    is_light: jax.Array


def _find_leader(
    search: _Search,
    sample: jax.Array,
    path: Path,
    hit: jax.Array,
    centroid: jax.Array,
    rank: jax.Array,
    progress: jax.Array,
    vehicle: VehicleParams,
) -> _Found:
    """Nearest object ahead for one proposal at one forecast sample.

    Ahead: centroid projected on the path beyond the proposal's own progress. Nearest: distance
    between polygons, from the ego box placed at the proposal's pose.

    Args:
      search: what the whole rollout shares.
      sample: forecast sample.
      path: the proposal's path.
      hit: `[A + R]` in the corridor at this sample.
      centroid: `[A + R]` their arc lengths.
      rank: `[A + R]` order among equal distances.
      progress: own arc length.
      vehicle: ego dimensions.
    """
    x, y, heading = interpolate(path, progress)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    reach = vehicle.rear_axle_to_center
    ego = Box(
        x + reach * cos,
        y + reach * sin,
        cos,
        sin,
        jnp.asarray(0.5 * vehicle.length, x.dtype),
        jnp.asarray(0.5 * vehicle.width, x.dtype),
    )
    candidate = hit & search.eligible & (centroid > progress)
    distance = box_distance(ego, jax.tree.map(lambda v: v[sample], search.boxes))
    num_lights = search.red.valid.shape[0]

    def to_lights():
        ax, ay, bx, by = search.red.edges.T
        edge = segment_box_distance(ax, ay, bx, by, ego)
        edge = jnp.where(search.red.edge_valid, edge, jnp.inf)
        nearest = jax.ops.segment_min(edge, search.red.slot, num_segments=num_lights)
        # An ego entirely inside the area touches no edge but its distance is 0.
        return jnp.where(ego_inside(search.red, ego), 0, nearest)

    far = jnp.full(num_lights, jnp.inf, x.dtype)
    lights = jax.lax.cond(search.any_red, to_lights, lambda: far)
    distance = jnp.where(candidate, jnp.concatenate([distance, lights]), jnp.inf)
    least = jnp.min(distance)
    found = least < jnp.inf
    # Objects side by side are equally far up to rounding: the given order decides, not the noise.
    tie = 1e-6 if x.dtype == jnp.float64 else 2e-5
    order = jnp.where(distance <= least + tie, rank, jnp.iinfo(jnp.int32).max)
    index = jnp.argmin(order)
    num_objects = search.heading.shape[0]
    is_light = found & (index >= num_objects)
    row = jnp.minimum(index, num_objects - 1)
    speed = search.speed[row] * jnp.cos(wrap(search.heading[row] - heading))
    return _Found(
        index=jnp.where(found, index, -1).astype(jnp.int32),
        progress=progress + least,
        speed=speed,
        is_light=is_light,
    )


def _with_leaks(found: _Found, path_length: jax.Array, vehicle: VehicleParams) -> Leader:
    """Turns searches `[L, K]` into leaders with the reference's shared memory.

    The reference fills one leader vector per path for all its policies in turn. A red light writes
    only the progress, an object not the rear length, a free road not the speed; what is not written
    is the value that the policy before left there (0 before the first).
    """
    free = found.index < 0
    writes_speed = ~free & ~found.is_light
    order = jnp.arange(free.shape[1])
    # [L, policy, policy before or the same]: few policies, so comparing them all is cheapest.
    before = order[None, :] <= order[:, None]
    last = jnp.max(jnp.where(before & writes_speed[:, None], order, -1), axis=2)
    speed = jnp.take_along_axis(found.speed, jnp.maximum(last, 0), axis=1)
    any_free = jnp.any(before & free[:, None], axis=2)
    return Leader(
        progress=jnp.where(free, path_length[:, None], found.progress),
        speed=jnp.where(last >= 0, speed, 0),
        rear=jnp.where(any_free, 0.5 * vehicle.length, 0).astype(speed.dtype),
    )


def rollout(
    paths: Path,
    start: jax.Array,
    speed: jax.Array,
    target_speed: jax.Array,
    forecast: AgentForecast,
    red: RedLights,
    contents: CorridorContents,
    vehicle: VehicleParams,
    params: IDMParams,
    num_states: int,
) -> IDMRollout:
    """Rolls out every policy on every path.

    Args:
      paths: `[L, M]` paths.
      start: `[L]` ego arc length, m.
      speed: ego speed, m/s.
      target_speed: `[K]` m/s.
      forecast: objects.
      red: red lights.
      contents: what lies in the corridors.
      vehicle: ego dimensions.
      params: IDM constants, scalars or `[K]`.
      num_states: T, odd.

    Returns:
      `IDMRollout` `[L, K, T]`.

    Source: tuplan_garage `PDMGenerator.generate_proposals`. The leader is searched at even steps
    only (map k // 2, own pose at k - 1); at step 1 the leader vector is still zero, so the first
    step always brakes.
    """
    num_paths, num_policies = start.shape[0], target_speed.shape[0]
    search = _search(forecast, red, contents)
    shape = (num_paths, num_policies)
    rank = jnp.broadcast_to(contents.rank, contents.hit.shape)

    def find(sample, progress):
        def one(path, hit, centroid, order, own):
            return _find_leader(search, sample, path, hit, centroid, order, own, vehicle)

        per_policy = jax.vmap(one, in_axes=(None, None, None, None, 0))
        found = jax.vmap(per_policy)(
            paths,
            contents.hit[:, sample],
            contents.progress[:, sample],
            rank[:, sample],
            progress,
        )
        return found

    zero = jnp.zeros(shape, start.dtype)
    x0 = jnp.broadcast_to(start[:, None], shape)
    v0 = jnp.broadcast_to(jnp.asarray(speed, start.dtype), shape)

    def pair_of_steps(carry, sample):
        x, v, leader = carry
        x1, v1 = idm_step(x, v, leader, target_speed, params)
        found = find(sample, x1)
        following = _with_leaks(found, paths.length, vehicle)
        x2, v2 = idm_step(x1, v1, following, target_speed, params)
        odd = jnp.full(shape, -2, jnp.int32)
        out = (
            (x1, v1, leader, odd),
            (x2, v2, following, found.index),
        )
        return (x2, v2, following), jax.tree.map(lambda a, b: jnp.stack([a, b]), *out)

    first = (x0, v0, Leader(zero, zero, zero))
    _, steps = jax.lax.scan(pair_of_steps, first, jnp.arange(1, num_states // 2 + 1))
    begin = (x0, v0, Leader(zero, zero, zero), jnp.full(shape, -2, jnp.int32))

    def join(initial, values):  # [T / 2, 2, L, K] -> [L, K, T]
        flat = values.reshape((-1, *shape))
        return jnp.moveaxis(jnp.concatenate([initial[None], flat]), 0, -1)

    x, v, leader, index = jax.tree.map(join, begin, steps)
    return IDMRollout(x, v, leader, index)


def extend(
    path: Path,
    progress: jax.Array,
    speed: jax.Array,
    leader: Leader,
    target_speed: jax.Array,
    hit: jax.Array,
    centroid: jax.Array,
    rank: jax.Array,
    forecast: AgentForecast,
    red: RedLights,
    vehicle: VehicleParams,
    params: IDMParams,
    first_step: int,
    num_states: int,
) -> tuple[jax.Array, jax.Array]:
    """Unrolls one proposal further by the same rules, alone.

    Args:
      path: its path `[M]`.
      progress: its arc length at `first_step - 1`, m.
      speed: its speed there, m/s.
      leader: its leader there (kept for one odd step).
      target_speed: its policy, m/s.
      hit: `[S, A + R]` contents of its corridor.
      centroid: `[S, A + R]`.
      rank: `[S, A + R]`.
      forecast: objects.
      red: red lights.
      vehicle: ego dimensions.
      params: IDM constants of its policy (scalars).
      first_step: odd index of the first new state.
      num_states: T of the whole trajectory.

    Returns:
      Arc lengths and speeds `[num_states - first_step]` at the new steps.

    Source: tuplan_garage `PDMGenerator.generate_trajectory`: every even step starts from a leader
    vector of zeros, so nothing leaks between policies.
    """
    search = _search(forecast, red, CorridorContents(hit[None], centroid[None], rank[None]))

    def pair_of_steps(carry, sample):
        x, v, ahead = carry
        x1, v1 = idm_step(x, v, ahead, target_speed, params)
        found = _find_leader(
            search, sample, path, hit[sample], centroid[sample], rank[sample], x1, vehicle
        )
        alone = jax.tree.map(lambda value: value[None, None], found)
        following = jax.tree.map(
            lambda value: value[0, 0], _with_leaks(alone, path.length[None], vehicle)
        )
        x2, v2 = idm_step(x1, v1, following, target_speed, params)
        return (x2, v2, following), (jnp.stack([x1, x2]), jnp.stack([v1, v2]))

    samples = jnp.arange((first_step + 1) // 2, num_states // 2 + 1)
    _, (x, v) = jax.lax.scan(pair_of_steps, (progress, speed, leader), samples)
    return x.reshape(-1), v.reshape(-1)


def at_policies(params: IDMParams, policy: jax.Array) -> IDMParams:
    """IDM constants of one policy (scalars stay as they are)."""
    return jax.tree.map(lambda v: v[policy] if jnp.ndim(v) else v, params)
