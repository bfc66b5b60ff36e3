"""What a reactive agent follows: the nearest obstacle in the corridor along its path."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import when
from spdm_jax.geometry import Box, crosses_upward_ray
from spdm_jax.simulation.agent_paths import path_from, path_pose, start_of_rest
from spdm_jax.simulation.agent_state import Agent, RoadFacts
from spdm_jax.simulation.shapes import (
    RUN,
    Blocks,
    Circles,
    circle_gap,
    one_box,
    run_circles,
    shape_circle,
    shapes_distance,
    strip_meets,
)
from spdm_jax.types import Lanes, LightStatus

_COARSE = 4
"""Runs of a corridor that are compared with obstacles as one circle first."""


class Outlook(NamedTuple):
    """One agent's way ahead during one step (all agents: a leading axis).

    Attributes:
      x, y: `[M]` vertices of the corridor's axis.
      runs: circles around its runs.
      coarse: circles around groups of runs.
      heading: at the corridor's start, rad.
      stops: `[Q]` bool, stop polygons of the route's red connectors.
    """

    x: jax.Array
    y: jax.Array
    runs: Circles
    coarse: Circles
    heading: jax.Array
    stops: jax.Array


class Obstacles(NamedTuple):
    """Everything on the road, one after the other.

    Agents `[K]`, the ego's boxes `[E]`, replayed objects `[R]` and stop polygons `[Q]`; together N.

    Attributes:
      shape: `Blocks` `[N]`.
      circle: `[N, 3]`.
      exists: `[N]` bool.
    """

    shape: Blocks
    circle: jax.Array
    exists: jax.Array


class Lead(NamedTuple):
    """Nearest obstacle in an agent's corridor.

    Attributes:
      obstacle: `[]` int32 row of the obstacles, -1 for none.
      gap: m between the footprints.
      sees_itself: `[]` bool, the corridor meets the agent's own footprint.
    """

    obstacle: jax.Array
    gap: jax.Array
    sees_itself: jax.Array


def look_ahead(agent: Agent, lanes: Lanes, lights: jax.Array, num_stops: int) -> Outlook:
    """Prepares an agent's corridor; no other agent has a part in it."""
    start = start_of_rest(agent.path, agent.progress)
    x, y = path_from(agent.path, start)
    half_width = 0.5 * agent.width
    runs = run_circles(x, y, half_width)
    spare = -(x.shape[0] - 1) % (RUN * _COARSE)
    longer = lambda v: jnp.concatenate([v, jnp.broadcast_to(v[-1], (spare,))])
    coarse = run_circles(longer(x), longer(y), half_width, RUN * _COARSE)
    red = (agent.route >= 0) & (lights[agent.route] == LightStatus.RED)
    stop = jnp.where(red, lanes.stop_line[agent.route], -1)
    stops = jnp.any(stop[:, None] == jnp.arange(num_stops), axis=0)
    _, _, heading = path_pose(agent.path, start)
    return Outlook(x, y, runs, coarse, heading, stops)


def gather_obstacles(
    agents: Agent, egos: Box, replayed: Box, present: jax.Array, facts: RoadFacts
) -> Obstacles:
    """Joins all obstacles into one table; the order decides among equal distances."""
    boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), egos, replayed)
    shapes = jax.vmap(one_box)(boxes)
    room = agents.shape.x.shape[1]

    def join(vehicle, box, stop):
        empty = False if vehicle.dtype == bool else -1

        def fill(v):
            widths = [(0, 0), (0, room - v.shape[1]), *[(0, 0)] * (v.ndim - 2)]
            return jnp.pad(v, widths, constant_values=empty)

        return jnp.concatenate([vehicle, fill(box), fill(stop)])

    return Obstacles(
        shape=jax.tree.map(join, agents.shape, shapes, facts.stops),
        circle=jnp.concatenate([agents.circle, jax.vmap(shape_circle)(shapes), facts.stop_circle]),
        exists=jnp.concatenate(
            [agents.active, jnp.ones(egos.x.shape, bool), present, facts.stop_circle[:, 2] >= 0]
        ),
    )


def _inside(edges: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    crossings = crosses_upward_ray(x, y, *edges.T)
    return jnp.sum(crossings.astype(jnp.int32)) % 2 == 1


def find_lead(
    i: jax.Array,
    half_width: jax.Array,
    moved: jax.Array,
    outlook: Outlook,
    obstacles: Obstacles,
    facts: RoadFacts,
) -> Lead:
    """Nearest of what shares a point with agent i's corridor, by distance of footprints.

    Obstacles are visited by a lower bound of their distance until none can be nearer.

    Args:
      i: the agent.
      half_width: of its corridor, m.
      moved: `[]` bool; an agent that has moved stands on its path and need not look for itself.
      outlook: its way ahead.
      obstacles: everything as it is now.
      facts: edges of the stop polygons.
    """
    total, num_stops = obstacles.exists.shape[0], facts.stop_edges.shape[0]
    index = jnp.arange(total)
    own = jax.tree.map(lambda v: v[i], obstacles.shape)
    ox, oy, reach = obstacles.circle.T
    asked = jnp.concatenate([jnp.ones(total - num_stops, bool), outlook.stops])
    wanted = obstacles.exists & asked & ((index != i) | ~moved)
    close = jnp.any(circle_gap(*outlook.coarse, ox, oy, reach) < 0, axis=0)
    bound = jnp.min(circle_gap(own.x, own.y, own.radius, ox, oy, reach), axis=0)
    bound = jnp.where(wanted & close, bound, jnp.inf)
    tiny = jnp.asarray(jnp.finfo(bound.dtype).tiny, bound.dtype)
    body_x, body_y = own.box.x[-1, 0], own.box.y[-1, 0]

    def more(state):
        bound, best, _, _ = state
        # Bounds have some slack, so whatever overlaps is visited: ties go to the first in order.
        return jnp.min(bound) < best

    def visit(state):
        bound, best, lead, sees_itself = state
        j = jnp.argmin(bound).astype(jnp.int32)
        shape = jax.tree.map(lambda v: v[j], obstacles.shape)
        stop = j - (total - num_stops)
        edges = facts.stop_edges[jnp.maximum(stop, 0)]
        within = lambda x, y: (stop >= 0) & _inside(edges, x, y)
        met = strip_meets(
            outlook.x, outlook.y, half_width, outlook.runs, shape, obstacles.circle[j]
        )
        met |= within(outlook.x[0], outlook.y[0])
        limit = jnp.maximum(best, tiny)

        wants = met & (j != i)

        def measure(limit):
            # A row that does not ask, under vmap, ends its search at once.
            nearer = shapes_distance(own, shape, jnp.where(wants, limit, 0))
            return jnp.where(within(body_x, body_y), 0, nearer)

        distance = when(wants, measure, limit)
        takes = (distance < limit) & ((distance < best) | (j < lead))
        return (
            bound.at[j].set(jnp.inf),
            jnp.where(takes, distance, best),
            jnp.where(takes, j, lead),
            sees_itself | (met & (j == i)),
        )

    far = jnp.asarray(jnp.inf, bound.dtype)
    start = (bound, far, jnp.int32(-1), moved)
    _, gap, lead, sees_itself = jax.lax.while_loop(more, visit, start)
    return Lead(lead, gap, sees_itself)
