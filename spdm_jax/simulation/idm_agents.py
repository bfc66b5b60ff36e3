"""Reactive traffic: nuPlan's IDM agents, one step of all of them in turn.

Agents follow lane baselines; each sees what lies in the corridor along its remaining path and
follows the nearest of it with the intelligent driver model. They move one after the other: later
ones see where earlier ones have gone.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import when
from spdm_jax.geometry import Box, wrap
from spdm_jax.simulation.agent_leader import (
    Lead,
    Obstacles,
    Outlook,
    find_lead,
    gather_obstacles,
    look_ahead,
)
from spdm_jax.simulation.agent_paths import append_lane, path_end, start_of_rest
from spdm_jax.simulation.agent_state import (
    Agent,
    AgentParams,
    AgentSizes,
    RoadFacts,
    Traffic,
    footprint,
    replayed_boxes,
)
from spdm_jax.simulation.history import Snapshot
from spdm_jax.simulation.script import Script, ego_reach, heeds_reach
from spdm_jax.types import Lanes, LightStatus, ScenarioMap

_IDM_EXPONENT = 4


def _extend(
    agent: Agent,
    drives: jax.Array,
    lanes: Lanes,
    facts: RoadFacts,
    lights: jax.Array,
    params: AgentParams,
) -> Agent:
    """Appends lanes to the path of an agent that drives while the path ahead is short.

    Source: nuPlan `IDMAgent.plan_route`.
    """

    def following(agent):
        options = lanes.successors[agent.route[-1]]
        status = lights[options]
        green, red = status == LightStatus.GREEN, status == LightStatus.RED
        is_open = (options >= 0) & jnp.where(lanes.has_traffic_light[options], green, ~red)
        best = jnp.argmin(jnp.where(is_open, facts.curvature[options], jnp.inf))
        return jnp.where(jnp.any(is_open), options[best], -1)

    def short(state):
        agent, lane = state
        ahead = path_end(agent.path) - agent.progress
        wanted = params.min_path_length + agent.target_speed * params.headway_time
        return drives & (lane >= 0) & (ahead < wanted)

    def append(state):
        agent, lane = state
        at = start_of_rest(agent.path, agent.progress)
        path, overflow = append_lane(agent.path, at, lanes, lane)
        agent = agent.replace(
            path=path,
            progress=jnp.zeros_like(agent.progress),
            route=jnp.concatenate([agent.route[1:], lane[None]]),
            overflow=agent.overflow | overflow,
        )
        return agent, following(agent)

    return jax.lax.while_loop(short, append, (agent, following(agent)))[0]


class _Motion(NamedTuple):
    """What changes while the agents move in turn.

    Attributes:
      agents: `Agent` `[K]`.
      obstacles: `gather_obstacles` of them and all else on the road.
    """

    agents: Agent
    obstacles: Obstacles


def idm_acceleration(
    speed: jax.Array,
    target: jax.Array,
    space: jax.Array,
    lead_speed: jax.Array,
    params: AgentParams,
) -> jax.Array:
    """Acceleration of the intelligent driver model, m/s^2.

    Source: nuPlan `IDMPolicy`; Treiber et al. 2000 (exponent 4).
    """
    a, b = params.accel_max, params.decel_max
    wanted = (
        params.min_gap
        + speed * params.headway_time
        + speed * (speed - lead_speed) / (2 * jnp.sqrt(a * b))
    )
    space = jnp.maximum(space, params.min_gap)
    return jnp.clip(a * (1 - (speed / target) ** _IDM_EXPONENT - (wanted / space) ** 2), -b, a)


def step_traffic(
    traffic: Traffic,
    scene_map: ScenarioMap,
    facts: RoadFacts,
    ego_box: Box,
    ego_heading: jax.Array,
    ego_speed: jax.Array,
    objects: Snapshot,
    lights: jax.Array,
    dt: jax.Array,
    params: AgentParams,
    sizes: AgentSizes,
    script: Script | None = None,
    iteration: jax.Array | None = None,
) -> Traffic:
    """Moves all reactive agents from iteration i to i + 1.

    Args:
      traffic: agents at i.
      scene_map: the map.
      facts: `road_facts` of it.
      ego_box: the ego at i (agents react to where it was).
      ego_heading: rad.
      ego_speed: magnitude of its velocity, m/s.
      objects: the log at i + 1, for replayed objects.
      lights: `[L]` status at i + 1.
      dt: s between the two.
      params: nuPlan's settings.
      sizes: static room.
      script: of an interPlan scenario.
      iteration: `[]` int32, i; needed with a script.

    Source: nuPlan `IDMAgentManager.propagate_agents`. Where nuPlan aborts because an agent's
    corridor misses the agent itself, the agent stays where it is for this step.
    """
    replayed, present, overflow = replayed_boxes(objects, sizes.replayed)
    agents, lanes = traffic.agents, scene_map.lanes
    num = agents.active.shape[0]
    near = jnp.hypot(agents.x - ego_box.x, agents.y - ego_box.y) <= params.radius
    agents = agents.replace(active=agents.active & near)
    drives, heeds = agents.active, None
    ego_speeds = jnp.broadcast_to(ego_speed, (num,))
    egos = jax.tree.map(lambda v: v[None], ego_box)
    if script is not None:
        assert iteration is not None
        row = jnp.maximum(agents.track, 0)
        drives &= ~script.stopped[row]
        ego_speeds = jnp.where(script.cautious[row], 0, ego_speeds)
        reach = ego_reach(ego_box, ego_speed)
        egos = jax.tree.map(lambda a, b: jnp.stack([a, b]), ego_box, reach)
        heeds = heeds_reach(script, agents, scene_map, ego_box, reach, iteration)
    num_egos = egos.x.shape[0]

    def advance(agent: Agent, lead: Lead, outlook: Outlook, ego_speed, now: _Motion):
        k = jnp.clip(lead.obstacle, 0, num - 1)
        is_agent = (lead.obstacle >= 0) & (lead.obstacle < num)
        is_ego = (lead.obstacle >= num) & (lead.obstacle < num + num_egos)
        lead_speed = jnp.where(is_agent, now.agents.speed[k], jnp.where(is_ego, ego_speed, 0))
        direction = jnp.where(is_agent, now.agents.heading[k], ego_heading)
        lead_speed = lead_speed * jnp.cos(wrap(direction - outlook.heading))
        # Where nothing is ahead, the end of the path is a wall.
        wall = path_end(agent.path) - agent.progress - 0.5 * agent.length
        space = jnp.where(lead.obstacle < 0, wall, lead.gap)
        limit = lanes.speed_limit[agent.route[-1]]
        target = jnp.where(limit > 0, limit, agent.target_speed)
        accel = idm_acceleration(agent.speed, target, space, lead_speed, params)
        progress = agent.progress + agent.speed * dt
        speed = jnp.maximum(agent.speed + accel * dt, 0)
        size = agent.length, agent.width
        place = footprint(agent.path, progress, speed, *size, params, sizes.footprint_points)
        return agent.replace(
            progress=progress,
            speed=speed,
            target_speed=target,
            moved=jnp.bool_(True),
            **place._asdict(),
        )

    def move(i, agent: Agent, now: _Motion) -> Agent:
        agent = _extend(agent, drives[i], lanes, facts, lights, params)
        outlook = look_ahead(agent, lanes, lights, facts.stop_edges.shape[0])
        # Under vmap this is computed for agents that stand as well: they need not search.
        exists = now.obstacles.exists & drives[i]
        if heeds is not None:
            exists = exists.at[num + 1].set(heeds[i] & drives[i])
        visible = now.obstacles._replace(exists=exists)
        lead = find_lead(i, 0.5 * agent.width, agent.moved, outlook, visible, facts)
        goes = advance(agent, lead, outlook, ego_speeds[i], now)
        stays = agent.replace(skipped=jnp.bool_(True))
        return jax.tree.map(partial(jnp.where, lead.sees_itself), goes, stays)

    def update(i, now: _Motion):
        agent = jax.tree.map(lambda v: v[i], now.agents)
        agent = when(drives[i], lambda agent: move(i, agent, now), agent)
        put = lambda values, new: values.at[i].set(new)
        shape = jax.tree.map(put, now.obstacles.shape, agent.shape)
        circle = put(now.obstacles.circle, agent.circle)
        return _Motion(
            agents=jax.tree.map(put, now.agents, agent),
            obstacles=now.obstacles._replace(shape=shape, circle=circle),
        )

    start = _Motion(agents, gather_obstacles(agents, egos, replayed, present, facts))
    agents = jax.lax.fori_loop(0, traffic.count, update, start).agents
    overflow |= traffic.overflow | jnp.any(agents.overflow & agents.active)
    return traffic.replace(agents=agents, overflow=overflow)
