"""What a simulation of an interPlan scenario does at each step besides nuPlan's."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.geometry import Box, box_at, boxes_overlap, point_segment_sq
from spdm_jax.map_rows import arc_length_at, line_ends
from spdm_jax.scoring.areas import areas_at
from spdm_jax.simulation.agent_state import Agent
from spdm_jax.simulation.history import Snapshot
from spdm_jax.types import Array, ScenarioMap

TRIGGER_DISTANCE = 50.0
"""A waiting pedestrian appears when the ego is so near along its lane, m."""
WALK_ITERATIONS = 150
"""A pedestrian walks for so many iterations more than it waited, at most for the whole scenario."""
REACH_SECONDS = 3.0
"""How far ahead agents see an ego that moves into their lane."""
_LANE_END = 0.1
"""A pedestrian so near to a lane's end is beyond it, m."""
_MIXED_SHARE = 0.5
"""Probability that a mixed agent ignores, for one step, an ego from its own roadblock."""


class AgentPolicy(IntEnum):
    """How agents treat an ego that is about to move into their lane."""

    ASSERTIVE = 0
    MIXED = 1
    CAUTIOUS = 2


class Script(struct.PyTreeNode, kw_only=True):
    """One scenario's script in its local frame.

    Attributes:
      policy: `[]` int32, `AgentPolicy` of all agents.
      seed: `[]` uint32, of whatever is drawn during a run.
      stopped: `[A]` bool, tracks that never move and stay off their lane's baseline.
      cautious: `[A]` bool, tracks that treat the ego as standing.
      track: `[P]` int32 track row of each pedestrian that waits for the ego, -1 padded.
      start: `[P, 2]` m.
      stop: `[P, 2]` m.
      course: `[M, 2]` m, the last point repeated.
      end: `[]` m on the course.
    """

    policy: Array
    seed: Array
    stopped: Array
    cautious: Array
    track: Array
    start: Array
    stop: Array
    course: Array
    end: Array


def past_goal(script: Script, x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether the ego's centre has passed the end of its course, which ends the run, `[]` bool.

    To be asked with the state before a step: that step is not taken any more.

    Source: interPlan `Simulation.goal_reached`.
    """
    px, py = script.course[:, 0], script.course[:, 1]
    length = jnp.hypot(jnp.diff(px), jnp.diff(py))
    square, share = point_segment_sq(x, y, px[:-1], py[:-1], px[1:], py[1:])
    # Repeated points are no segments: they would hide the way to the last real one.
    best = jnp.argmin(jnp.where(length > 0, square, jnp.inf))
    return (
        jnp.sum(jnp.where(jnp.arange(length.shape[0]) < best, length, 0))
        + share[best] * length[best]
        > script.end
    )


class Walkers(NamedTuple):
    """Pedestrians that wait for the ego, `[P]`.

    Attributes:
      began: int32 iteration at which each began to walk; 0 or less: not yet.
      x: m.
      y: m.
      heading: rad.
      present: bool, it is in the world.
    """

    began: jax.Array
    x: jax.Array
    y: jax.Array
    heading: jax.Array
    present: jax.Array


def walkers_at(
    script: Script,
    began: jax.Array,
    scene_map: ScenarioMap,
    x: jax.Array,
    y: jax.Array,
    iteration: jax.Array,
    num_iterations: jax.Array,
) -> Walkers:
    """Moves the pedestrians that wait for the ego to one iteration.

    A pedestrian near the ego at iteration 0 is there and is asked again at the next one.

    Args:
      script: of the scenario.
      began: `[P]` int32 from the iteration before; -1 at iteration 0.
      scene_map: the world.
      x: `[]` ego's box centre, m.
      y: `[]` m.
      iteration: `[]` int32.
      num_iterations: `[]` int32, N.

    Source: interPlan `AgentsModifier.get_pedestrians_at_iteration`; differs: in overlapping
    connectors the ego's is the first in the map, and off all lanes nobody begins.
    """
    lanes = scene_map.lanes
    areas = areas_at(scene_map, x, y)
    plain = areas.lanes & ~lanes.is_connector
    members = jnp.where(jnp.any(plain), plain, areas.lanes & areas.intersection)
    lane = jnp.argmax(members)
    line = lanes.centerline
    ego_at = arc_length_at(line, lane, x, y)
    px, py = script.start[:, 0], script.start[:, 1]
    at = arc_length_at(line, jnp.broadcast_to(lane, px.shape), px, py)
    _, last = line_ends(line, lane)
    beyond = jnp.abs(at - lanes.length[lane]) < _LANE_END
    at = at + jnp.where(beyond, jnp.hypot(px - last[0], py - last[1]), 0)
    near = (jnp.abs(at - ego_at) <= TRIGGER_DISTANCE) & jnp.any(members) & (script.track >= 0)
    waits = began <= 0
    began = jnp.where(waits & near, iteration, began)
    walking = jnp.minimum(began + WALK_ITERATIONS, num_iterations).astype(px.dtype)
    share = jnp.clip((iteration - began).astype(px.dtype) / walking, 0, 1)
    way = script.stop - script.start
    return Walkers(
        began=began,
        x=px + share * way[:, 0],
        y=py + share * way[:, 1],
        heading=jnp.arctan2(way[:, 1], way[:, 0]),
        present=(near | ~waits) & (script.track >= 0),
    )


def with_walkers(objects: Snapshot, script: Script, walkers: Walkers) -> Snapshot:
    """Objects of one step with the waiting pedestrians in their rows, which report no velocity."""
    row = jnp.where(script.track >= 0, script.track, objects.x.shape[0])
    put = lambda values, new: values.at[row].set(new, mode="drop")
    return objects.replace(
        x=put(objects.x, walkers.x),
        y=put(objects.y, walkers.y),
        heading=put(objects.heading, walkers.heading),
        vx=put(objects.vx, 0),
        vy=put(objects.vy, 0),
        valid=put(objects.valid, walkers.present),
    )


def ego_reach(ego: Box, speed: jax.Array) -> Box:
    """The ego's box joined with where it gets in `REACH_SECONDS` at constant velocity.

    The corridor runs along the heading, is as wide as the ego and has square caps.

    Args:
      ego: its box.
      speed: magnitude of its velocity, m/s.

    Source: interPlan's obstacle "ego_expanded".
    """
    front = jnp.maximum(ego.half_length, speed * REACH_SECONDS + ego.half_width)
    shift = 0.5 * (front - ego.half_length)
    return ego._replace(
        x=ego.x + shift * ego.cos,
        y=ego.y + shift * ego.sin,
        half_length=ego.half_length + shift,
    )


def heeds_reach(
    script: Script,
    agents: Agent,
    scene_map: ScenarioMap,
    ego: Box,
    reach: Box,
    iteration: jax.Array,
) -> jax.Array:
    """Which agents take the ego's reach for an obstacle during one step, `[K]` bool.

    Nobody does in the ego's lane. In its roadblock nobody does ahead of it; behind it that is a
    matter of policy. Elsewhere everybody does unless the reach already touches it.

    Args:
      script: policy and seed.
      agents: `[K]`.
      scene_map: the map.
      ego: its box.
      reach: `ego_reach` of it.
      iteration: `[]` int32; a mixed agent decides anew each time.

    Source: interPlan's obstacle "ego_expanded"; differs: where lanes overlap, one in common is
    enough.
    """
    lanes = scene_map.lanes
    of_agents = areas_at(scene_map, agents.x, agents.y).lanes
    of_ego = areas_at(scene_map, ego.x, ego.y).lanes
    blocks = scene_map.roadblocks.valid.shape[0]
    block = jnp.where(of_ego & (lanes.roadblock >= 0), lanes.roadblock, blocks)
    ego_blocks = jnp.zeros(blocks + 1, bool).at[block].set(True)[:blocks]
    shares = ego_blocks[lanes.roadblock] & (lanes.roadblock >= 0)
    same_lane = jnp.any(of_agents & of_ego, axis=1)
    same_block = jnp.any(of_agents & shares, axis=1)
    ahead = (agents.x - ego.x) * ego.cos + (agents.y - ego.y) * ego.sin > 0
    key = jax.random.fold_in(jax.random.key(script.seed), iteration)
    draw = jax.random.bernoulli(key, _MIXED_SHARE, ahead.shape)
    cautious = script.policy == AgentPolicy.CAUTIOUS
    minds = cautious | ((script.policy == AgentPolicy.MIXED) & ~draw)
    body = box_at(agents.x, agents.y, agents.heading, 0.5 * agents.length, 0.5 * agents.width)
    elsewhere = ~boxes_overlap(reach, body)
    return ~same_lane & jnp.where(same_block, ~ahead & minds, elsewhere)
