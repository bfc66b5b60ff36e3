"""Perfect prediction in reactive traffic: the agents rolled out beside each proposal."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.agents.observation import is_agent
from spdm_jax.config import DT, FORECAST_DT, NUM_FORECAST, VehicleParams
from spdm_jax.geometry import ego_box
from spdm_jax.simulation.agent_state import (
    AgentParams,
    AgentSizes,
    RoadFacts,
    Traffic,
    traffic_snapshot,
)
from spdm_jax.simulation.history import Snapshot
from spdm_jax.simulation.idm_agents import step_traffic
from spdm_jax.simulation.script import Script
from spdm_jax.types import EgoState, ScenarioMap

_STEPS = round(FORECAST_DT / DT)
"""Steps of traffic per sample of a forecast."""
_BEYOND = 10
"""Steps beyond the last state of a drive that scores still look at (time to collision)."""


class Future(NamedTuple):
    """What the recording holds for the next steps.

    Attributes:
      objects: `Snapshot` `[F, A]` (`type` `[A]`), the first one now.
      lights: `[F, L]`.
    """

    objects: Snapshot
    lights: jax.Array


def steps_ahead(num_states: int) -> int:
    """Steps of traffic that a drive of so many states asks for."""
    return min(num_states - 1 + _BEYOND, _STEPS * (NUM_FORECAST - 1))


def _ego_after(ego: EgoState, i: jax.Array) -> EgoState:
    """State `i` of a drive `[T]`; beyond its end it goes straight on."""
    last = ego.x.shape[0] - 1
    here = jax.tree.map(lambda v: v[jnp.minimum(i, last)], ego)
    way = jnp.maximum(i - last, 0) * DT * here.vx
    return here.replace(
        x=here.x + way * jnp.cos(here.heading), y=here.y + way * jnp.sin(here.heading)
    )


def reactions(
    ego: EgoState,
    traffic: Traffic,
    scene_map: ScenarioMap,
    facts: RoadFacts,
    future: Future,
    iteration: jax.Array,
    vehicle: VehicleParams,
    params: AgentParams,
    sizes: AgentSizes,
    script: Script | None = None,
) -> ForecastPoses:
    """How all tracks would move beside each of several drives of the ego.

    Vehicles react by the rules of the simulation itself, what is replayed moves as recorded, and
    static objects stay.

    Args:
      ego: `[P, T]` states, 0.1 s apart, the first one now.
      traffic: agents now.
      scene_map: the map.
      facts: `road_facts` of it.
      future: recorded objects and lights, `steps_ahead(T) + 1` steps.
      iteration: `[]` int32, now.
      vehicle: ego dimensions.
      params: nuPlan's settings.
      sizes: static room.
      script: of an interPlan scenario. Its pedestrians that wait for the ego, or have begun to
        walk, stay as `future` has them: the simulation gives them standing where they are now.

    Returns:
      Poses `[P, A, S]`, every 0.2 s; samples beyond what the drives ask for repeat the last one.
    """
    steps = steps_ahead(ego.x.shape[1]) // _STEPS * _STEPS
    at = lambda i: future.objects.replace(
        **{
            name: getattr(future.objects, name)[i]
            for name in Snapshot.__dataclass_fields__
            if name != "type"
        }
    )

    def beside(ego: EgoState) -> Snapshot:
        def advance(traffic, i):
            state = _ego_after(ego, i)
            traffic = step_traffic(
                traffic,
                scene_map,
                facts,
                ego_box(state, vehicle),
                state.heading,
                jnp.hypot(state.vx, state.vy),
                at(i + 1),
                future.lights[i + 1],
                jnp.asarray(DT, state.x.dtype),
                params,
                sizes,
                script,
                iteration + i,
            )
            return traffic, None

        def sample(traffic, k):
            traffic, _ = jax.lax.scan(advance, traffic, k * _STEPS + jnp.arange(_STEPS))
            return traffic, traffic_snapshot(traffic, at((k + 1) * _STEPS)).replace(type=None)

        return jax.lax.scan(sample, traffic, jnp.arange(steps // _STEPS))[1]

    later = jax.vmap(beside)(ego)
    now = traffic_snapshot(traffic, at(0))
    moves = is_agent(now.type)

    def join(first, rest):
        """`[A]` and `[P, K, A]` to `[P, A, S]`."""
        rest = jnp.moveaxis(jnp.where(moves, rest, first), 1, 2)
        first = jnp.broadcast_to(first[None, :, None], (*rest.shape[:2], 1))
        room = NUM_FORECAST - 1 - rest.shape[2]
        return jnp.pad(jnp.concatenate([first, rest], 2), ((0, 0), (0, 0), (0, room)), mode="edge")

    return ForecastPoses(
        x=join(now.x, later.x),
        y=join(now.y, later.y),
        heading=join(now.heading, later.heading),
        valid=join(now.valid, later.valid),
    )
