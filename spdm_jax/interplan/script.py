"""What a simulation of an interPlan scenario does at each step besides nuPlan's: pure functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.geometry import point_segment_sq
from spdm_jax.interplan.config import Policy
from spdm_jax.interplan.extras import InterplanExtras
from spdm_jax.interplan.modify import WALK_ITERATIONS
from spdm_jax.metrics.motion import areas_at
from spdm_jax.metrics.routes import first_of
from spdm_jax.metrics.shapes import arc_length_at, line_ends
from spdm_jax.types import Array, ScenarioInfo, ScenarioMap

TRIGGER_DISTANCE = 50.0
"""A waiting pedestrian appears when the ego is so near along its lane, m."""
_LANE_END = 0.1
"""A pedestrian so near to a lane's end is beyond it, m."""
POLICIES = tuple(Policy)
"""Policies in the order of `Script.policy`."""


class Script(struct.PyTreeNode, kw_only=True):
    """One scenario's extras in its local frame.

    Attributes:
      policy: `[]` int32, index into `POLICIES`.
      stopped: `[A]` bool, tracks that never move and stay off their lane's baseline.
      cautious: `[A]` bool, tracks that treat the ego as standing.
      track: `[P]` int32 track row of each pedestrian that waits for the ego, -1 padded.
      start: `[P, 2]` m.
      stop: `[P, 2]` m.
      course: `[M, 2]` m, the last point repeated.
      end: `[]` m on the course.
    """

    policy: Array
    stopped: Array
    cautious: Array
    track: Array
    start: Array
    stop: Array
    course: Array
    end: Array


def script_of(
    extras: InterplanExtras,
    info: ScenarioInfo,
    origin: np.ndarray,
    *,
    num_tracks: int,
    num_pedestrians: int,
    num_points: int,
) -> Script:
    """Lays a scenario's extras out as arrays of fixed size (host, float64).

    Args:
      extras: of the scenario.
      info: its description, for the rows of tracks.
      origin: `[2]` map coordinates of the local frame's origin.
      num_tracks: A of the padded scenario.
      num_pedestrians: P.
      num_points: M.

    Raises:
      ValueError: something does not fit, or a track is not in the scenario.
    """
    waiting = [who for who in extras.pedestrians if who.begins_at is None]
    for name, count, room in (
        ("tracks", len(info.track_ids), num_tracks),
        ("pedestrians", len(waiting), num_pedestrians),
        ("points of the course", len(extras.course), num_points),
    ):
        if count > room:
            raise ValueError(f"scenario {extras.name}: {count} {name} do not fit into {room}")
    row_of = {track: row for row, track in enumerate(info.track_ids)}

    def flags(tracks: tuple[str, ...]) -> np.ndarray:
        flagged = np.zeros(num_tracks, bool)
        flagged[[row_of[track] for track in tracks]] = True
        return flagged

    def local(points: list[tuple[float, float]], room: int) -> np.ndarray:
        found = np.array(points, float).reshape(-1, 2) - origin
        return np.pad(
            found, ((0, room - len(found)), (0, 0)), mode="edge" if len(found) else "constant"
        )

    named = {who.track for who in waiting} | {*extras.stopped, *extras.cautious}
    if missing := named - set(row_of):
        raise ValueError(f"scenario {extras.name} has no track {sorted(missing)}")
    track = np.full(num_pedestrians, -1, np.int32)
    track[: len(waiting)] = [row_of[who.track] for who in waiting]
    return Script(
        policy=np.array(POLICIES.index(extras.policy), np.int32),
        stopped=flags(extras.stopped),
        cautious=flags(extras.cautious),
        track=track,
        start=local([who.start for who in waiting], num_pedestrians),
        stop=local([who.end for who in waiting], num_pedestrians),
        course=local(list(extras.course), num_points),
        end=np.array(extras.end),
    )


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
    lane = first_of(members)
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
