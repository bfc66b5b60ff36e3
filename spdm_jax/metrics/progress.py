"""Progress of ego and expert along the lanes that the expert drove on."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum, true_indices
from spdm_jax.map_rows import arc_length_at, line_ends, polygon_contains
from spdm_jax.metrics.driving import last_before
from spdm_jax.metrics.params import MetricParams
from spdm_jax.metrics.routes import first_of
from spdm_jax.types import Array, Lanes, ScenarioMap


class Progress(struct.PyTreeNode, kw_only=True):
    """Progress along the expert's route.

    Attributes:
      values: `[T]` m per sample; 0 without a route.
      ego_total: `[]` m.
      expert_total: `[]` m.
      has_route: `[]` bool, the expert was on a lane at some sample.
      ratio: `[]` score, 0 ... 1.
      making_progress: `[]` 0 or 1.
    """

    values: Array
    ego_total: Array
    expert_total: Array
    has_route: Array
    ratio: Array
    making_progress: Array


class Chain(NamedTuple):
    """The expert's route as one lane per roadblock, C = number of expert samples.

    Attributes:
      lane: `[C]` int32 row of the lane whose baseline measures, 0 beyond `size`.
      size: `[]` int32.
    """

    lane: jax.Array
    size: jax.Array


def expert_chain(lanes: Lanes, route: jax.Array) -> Chain:
    """Reduces a driven route `[N, L]` to one lane per roadblock.

    Source: nuPlan `get_route_simplified`, `get_route_baseline_roadblock_linkedlist`.
    """

    def step(state, members):
        kept, block = state
        new = jnp.any(members) & ~jnp.any(kept & members)
        kept = jnp.where(new, members, kept)
        own = lanes.roadblock[first_of(members)]
        link = new & (own != block)
        return (kept, jnp.where(link, own, block)), link

    nothing = jnp.zeros(lanes.valid.shape, bool)
    _, links = jax.lax.scan(step, (nothing, jnp.int32(-2)), route)
    sample, real = true_indices(links, links.shape[0])
    lane = jnp.where(real, first_of(route)[sample], 0)
    return Chain(lane, jnp.sum(links, dtype=jnp.int32))


def _inside_chain(scene_map: ScenarioMap, chain: Chain, x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether points `[P]` are in the roadblock of each link, `[C, P]` bool."""
    block = jnp.maximum(scene_map.lanes.roadblock[chain.lane], 0)

    def visit(link, inside):
        found = polygon_contains(scene_map.roadblocks.polygon, block[link], x, y)
        return inside.at[link].set(found)

    nowhere = jnp.zeros((chain.lane.shape[0], *x.shape), bool)
    return jax.lax.fori_loop(0, chain.size, visit, nowhere)


class _Walk(NamedTuple):
    """Where points are on a chain, `[P]`.

    Attributes:
      link: int32 link after each point.
      found: bool, the point was placed (in its link's roadblock, or the first point).
    """

    link: jax.Array
    found: jax.Array


def _walk(inside: jax.Array) -> _Walk:
    """Follows points `[P]` forward along the chain's roadblocks, `inside` `[C, P]`."""
    index = jnp.arange(inside.shape[0])

    def step(link, here):
        ahead = here & (index > link)
        following = jnp.where(jnp.any(ahead), jnp.argmax(ahead), link).astype(jnp.int32)
        now = jnp.where(here[link], link, following)
        return now, (now, here[link] | jnp.any(ahead))

    _, (link, found) = jax.lax.scan(step, jnp.int32(0), inside[:, 1:].T)
    return _Walk(
        jnp.concatenate([jnp.zeros(1, jnp.int32), link]),
        jnp.concatenate([jnp.ones(1, bool), found]),
    )


def progress_along(
    scene_map: ScenarioMap, chain: Chain, x: jax.Array, y: jax.Array, valid: jax.Array
) -> jax.Array:
    """Progress of points along a chain, m per sample.

    Args:
      scene_map: the world.
      chain: expert's route.
      x: `[..., P]` m.
      y: `[..., P]` m.
      valid: `[..., P]` bool.

    Returns:
      `[..., P]`. Within a roadblock: differences of arc length on its baseline. Into a later one:
      the rest of the old baseline, plus the arc length on the new one from where the old one ends,
      plus the stretches of baselines skipped between. A point in no roadblock from the current one
      on stands still.

    Source: nuPlan `PerFrameProgressAlongRouteComputer`.
    """
    lines, lane = scene_map.lanes.centerline, chain.lane
    # Of each link: its stretch between the end of the link before and the start of the one after.
    first, last = line_ends(lines, lane)
    before = jnp.concatenate([last[:1], last[:-1]])
    after = jnp.concatenate([first[1:], first[-1:]])
    ends = jnp.stack([before, after])
    entry, exit_ = arc_length_at(lines, lane[None], ends[..., 0], ends[..., 1])
    skipped_before = jnp.concatenate([jnp.zeros_like(entry[:1]), prefix_sum(exit_ - entry)])

    def one(x, y, valid):
        walk = _walk(_inside_chain(scene_map, chain, x, y))
        found = walk.found & valid
        previous = jnp.maximum(last_before(found), 0)
        old, new = walk.link[previous], walk.link
        _, old_end = line_ends(lines, lane[old])
        # On the baseline of each point's link: the point, and where the baseline before it ends.
        place, start = arc_length_at(
            lines, lane[new][None], jnp.stack([x, old_end[:, 0]]), jnp.stack([y, old_end[:, 1]])
        )
        rest = scene_map.lanes.length[lane[old]] - place[previous]
        skipped = skipped_before[new] - skipped_before[old + 1]
        step = jnp.where(new == old, place - place[previous], rest + place - start + skipped)
        return jnp.where(found, step, 0).at[0].set(0)

    return jax.vmap(one)(x, y, valid)


def progress(
    scene_map: ScenarioMap,
    chain: Chain,
    x: jax.Array,
    y: jax.Array,
    valid: jax.Array,
    params: MetricParams,
) -> Progress:
    """Compares the ego's progress with the expert's.

    Both standing still counts as full progress, and so does an expert without a route.

    Args:
      scene_map: the world.
      chain: expert's route.
      x: `[2, P]` box centres of ego and expert, m.
      y: `[2, P]` m.
      valid: `[2, P]` bool, prefixes.
      params: thresholds.

    Source: nuPlan `ego_progress_along_expert_route`, `ego_is_making_progress`.
    """
    values = progress_along(scene_map, chain, x, y, valid)
    has_route = chain.size > 0
    values = jnp.where(has_route, values, 0)
    ego, expert = jnp.sum(values, axis=1)
    least = jnp.asarray(params.progress_threshold, ego.dtype)
    ratio = jnp.minimum(jnp.maximum(ego, least) / jnp.maximum(expert, least), 1)
    ratio = jnp.where(ego < -least, 0, ratio)
    ratio = jnp.where(has_route, ratio, 1)
    known = jnp.any(valid[0])
    return Progress(
        values=values[0],
        ego_total=ego,
        expert_total=expert,
        has_route=has_route,
        ratio=jnp.where(known, ratio, jnp.nan),
        making_progress=jnp.where(
            known, (ratio >= params.min_progress_ratio).astype(ratio.dtype), jnp.nan
        ),
    )
