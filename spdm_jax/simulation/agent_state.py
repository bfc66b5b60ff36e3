"""State of reactive traffic: agents, their footprints, and what they ask of the map."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import true_indices
from spdm_jax.config import Scalar
from spdm_jax.geometry import Box
from spdm_jax.simulation.agent_paths import (
    AgentPath,
    path_between,
    path_end,
    path_pose,
    start_curvature,
)
from spdm_jax.simulation.history import Snapshot
from spdm_jax.simulation.shapes import (
    RUN,
    WIDTH,
    Blocks,
    outline_shape,
    shape_circle,
    vehicle_shape,
)
from spdm_jax.types import Array, ObjectType, ScenarioMap

ROUTE_MEMORY = 5
"""Lanes of its route that an agent remembers, the last one last."""


class AgentParams(struct.PyTreeNode, kw_only=True):
    """nuPlan's settings of reactive agents.

    Attributes:
      target_speed: where no speed limit is known, m/s.
      min_gap: m.
      headway_time: s.
      accel_max: m/s^2.
      decel_max: m/s^2.
      min_path_length: path kept ahead of an agent besides one headway, m.
      radius: agents farther from the ego's centre are removed for good, m.
    """

    target_speed: Scalar = 10.0
    min_gap: Scalar = 1.0
    headway_time: Scalar = 1.5
    accel_max: Scalar = 1.0
    decel_max: Scalar = 2.0
    min_path_length: Scalar = 20.0
    radius: Scalar = 100.0


@dataclass(frozen=True)
class AgentSizes:
    """Room for reactive traffic; too little of it is reported as overflow.

    Attributes:
      agents: reactive agents (the first ones in the order of the tracks).
      replayed: replayed objects at one step.
      path_points: points of one agent's path, a multiple of 4 plus 1.
      footprint_points: points of the path piece in a footprint, a multiple of 4 plus 1; more are
        thinned.
      outline_blocks: a twelfth of the edges of a stop polygon.
    """

    agents: int = 128
    replayed: int = 128
    path_points: int = 257
    footprint_points: int = 33
    outline_blocks: int = 2

    def __post_init__(self):
        for name in ("path_points", "footprint_points"):
            if getattr(self, name) % RUN != 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be 1 more than 4 k")
        if self.outline_blocks > self.shape_blocks:
            raise ValueError(
                f"outline_blocks is {self.outline_blocks}; footprint_points allows "
                f"{self.shape_blocks}"
            )

    @property
    def shape_blocks(self) -> int:
        """Blocks of an agent's footprint: its strip and its box."""
        return self.footprint_points // RUN + 1


class Agent(struct.PyTreeNode, kw_only=True):
    """One reactive agent (or all of them, with a leading axis `[K]`).

    Attributes:
      track: `[]` int32 row in the scenario's tracks, -1 for an empty slot.
      active: `[]` bool, False once it has left the radius.
      length, width: m.
      path: what it drives along.
      progress: arc length on it, m; may run past its end.
      speed: m/s.
      target_speed: m/s.
      route: `[ROUTE_MEMORY]` int32 lanes, -1 padded at the front.
      x, y, heading: pose (box centre).
      shape: its footprint; the last block is its box.
      circle: `[3]` x, y, radius around the footprint.
      moved: `[]` bool, False until its first step.
      skipped: `[]` bool, its corridor once missed the agent itself and it did not move.
      overflow: `[]` bool, its path did not fit.
    """

    track: Array
    active: Array
    length: Array
    width: Array
    path: AgentPath
    progress: Array
    speed: Array
    target_speed: Array
    route: Array
    x: Array
    y: Array
    heading: Array
    shape: Blocks
    circle: Array
    moved: Array
    skipped: Array
    overflow: Array


class Traffic(struct.PyTreeNode, kw_only=True):
    """Reactive traffic between steps.

    Attributes:
      agents: `Agent` `[K]`, in the order of their updates.
      count: `[]` int32, slots in use (the first ones).
      overflow: `[]` bool, there was not enough room somewhere; results are not to be used.
    """

    agents: Agent
    count: Array
    overflow: Array


class RoadFacts(struct.PyTreeNode, kw_only=True):
    """What agents ask of the map, prepared once.

    Attributes:
      curvature: `[L]` curvature at each baseline's start, 1/m.
      stops: outlines `[Q]` of the stop polygons.
      stop_edges: `[Q, E, 4]` their edges x0, y0, x1, y1; unused ones are all 0.
      stop_circle: `[Q, 3]` x, y, radius around each.
      overflow: `[]` bool, a stop polygon has more edges than fit.
    """

    curvature: Array
    stops: Blocks
    stop_edges: Array
    stop_circle: Array
    overflow: Array


def road_facts(scene_map: ScenarioMap, sizes: AgentSizes) -> RoadFacts:
    """Prepares the map for reactive traffic."""
    polygons = scene_map.stop_lines
    blocks = sizes.outline_blocks

    def outline(start, count):
        offset = jnp.arange(blocks * WIDTH)
        valid = offset < count
        index = jnp.where(valid, start + offset, 0)
        edges = jnp.concatenate([polygons.xy[index], polygons.next_xy[index]], axis=1)
        edges = jnp.where(valid[:, None], edges, 0)
        shape = outline_shape(edges, valid, blocks)
        return shape, edges, shape_circle(shape)

    stops, edges, circle = jax.vmap(outline)(polygons.start, polygons.count)
    return RoadFacts(
        curvature=start_curvature(scene_map.lanes),
        stops=stops,
        stop_edges=edges,
        stop_circle=circle,
        overflow=jnp.any(polygons.count > blocks * WIDTH),
    )


def is_replayed(object_type: jax.Array) -> jax.Array:
    """Types that follow the log in reactive mode: neither vehicles nor (as published) bicycles."""
    return (object_type != ObjectType.VEHICLE) & (object_type != ObjectType.BICYCLE)


class Footprint(NamedTuple):
    """Where one agent is and what it occupies."""

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    shape: Blocks
    circle: jax.Array


def footprint(
    path: AgentPath,
    progress: jax.Array,
    speed: jax.Array,
    length: jax.Array,
    width: jax.Array,
    params: AgentParams,
    num_points: int,
) -> Footprint:
    """Pose and elongated footprint of an agent that has moved.

    The footprint is the box united with the corridor from half a length behind to half a length and
    one headway ahead.

    Source: nuPlan `IDMAgent.projected_footprint`.
    """
    end = path_end(path)
    clamp = lambda s: jnp.clip(s, 0, end)
    x, y, heading = path_pose(path, clamp(progress))
    half = 0.5 * length
    reach = half + speed * params.headway_time
    strip = path_between(path, clamp(progress - half), clamp(progress + reach), num_points)
    body = Box(x, y, jnp.cos(heading), jnp.sin(heading), half, 0.5 * width)
    shape = vehicle_shape(*strip, 0.5 * width, body)
    return Footprint(x, y, heading, shape, shape_circle(shape))


def replayed_boxes(objects: Snapshot, size: int) -> tuple[Box, jax.Array, jax.Array]:
    """Boxes `[size]` of the replayed objects of one step, which are real, and overflow."""
    wanted = objects.valid & is_replayed(objects.type)
    row, real = true_indices(wanted, size)
    heading = objects.heading[row]
    box = Box(
        objects.x[row],
        objects.y[row],
        jnp.cos(heading),
        jnp.sin(heading),
        0.5 * objects.length[row],
        0.5 * objects.width[row],
    )
    return box, real, jnp.sum(wanted) > size


def traffic_snapshot(traffic: Traffic, objects: Snapshot) -> Snapshot:
    """Objects as a planner and the metrics see them: agents where they drove, the rest as logged.

    Args:
      traffic: agents at an iteration.
      objects: the log at that iteration, rows as in the scenario's tracks.
    """
    agents = traffic.agents
    num = objects.type.shape[0]
    row = jnp.where(agents.active, agents.track, num)
    put = lambda values, new: values.at[row].set(new, mode="drop")
    return objects.replace(
        x=put(objects.x, agents.x),
        y=put(objects.y, agents.y),
        heading=put(objects.heading, agents.heading),
        vx=put(objects.vx, agents.speed * jnp.cos(agents.heading)),
        vy=put(objects.vy, agents.speed * jnp.sin(agents.heading)),
        length=put(objects.length, agents.length),
        width=put(objects.width, agents.width),
        valid=put(objects.valid & is_replayed(objects.type), True),
    )
