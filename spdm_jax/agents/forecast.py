"""Forecasters: where the selected objects will be.

A forecaster is any function `(observation, selected, future) -> ForecastPoses`; `future` is what it
needs besides (nothing, the recorded tracks, or a model's output).
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from spdm_jax.agents.observation import Observation, SelectedObjects, is_agent
from spdm_jax.config import DT, FORECAST_DT, NUM_FORECAST
from spdm_jax.types import AgentForecast, Array, EgoState, Tracks


class ForecastPoses(NamedTuple):
    """Box-centre poses of selected objects, `[A, S]` each, every 0.2 s."""

    x: Array
    y: Array
    heading: Array
    valid: Array


React: TypeAlias = Callable[[EgoState], ForecastPoses]
"""How all tracks would move beside each of some drives of the ego.

From rear-axle states `[P, T]`, 0.1 s apart from now on, to poses `[P, A, S]`.
"""


def constant_velocity(observation: Observation, selected: SelectedObjects) -> ForecastPoses:
    """Moves agents along their box axis at their current speed; static objects stay.

    An agent whose velocity points against its heading moves backwards. Boxes are translated, never
    turned.

    Source: tuplan_garage `PDMObservation`: speed = |velocity| along the heading, or along heading +
    pi where the velocity direction is more than 90 degrees off.
    """
    track = selected.track
    heading = observation.heading[track]
    vx, vy = observation.vx[track], observation.vy[track]
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    speed = jnp.hypot(vx, vy) * jnp.where(vx * cos + vy * sin > 0, 1, -1)
    speed = jnp.where(is_agent(observation.type[track]), speed, 0)
    time = jnp.arange(NUM_FORECAST, dtype=heading.dtype) * FORECAST_DT
    return ForecastPoses(
        x=observation.x[track, None] + (speed * cos)[:, None] * time,
        y=observation.y[track, None] + (speed * sin)[:, None] * time,
        heading=jnp.broadcast_to(heading[:, None], (len(track), NUM_FORECAST)),
        valid=jnp.ones((len(track), NUM_FORECAST), bool),
    )


def perfect(observation: Observation, selected: SelectedObjects, tracks: Tracks) -> ForecastPoses:
    """Reads the agents' recorded future; an agent that leaves the record is gone from there on.

    The current sample is the observation itself, and static objects stay where they are.
    """
    track = selected.track
    steps = observation.step + 2 * jnp.arange(NUM_FORECAST)
    inside = steps < tracks.x.shape[1]
    column = jnp.minimum(steps, tracks.x.shape[1] - 1)
    here = constant_velocity(observation, selected)
    moves = is_agent(observation.type[track])[:, None] & (jnp.arange(NUM_FORECAST) > 0)

    def logged(name, now):
        values = getattr(tracks, name)[track[:, None], column[None, :]]
        return jnp.where(moves, values, now[:, :1])

    valid = tracks.valid[track[:, None], column[None, :]] & inside
    return ForecastPoses(
        x=logged("x", here.x),
        y=logged("y", here.y),
        heading=logged("heading", here.heading),
        valid=jnp.where(moves, valid, True),
    )


def supplied(poses: ForecastPoses, selected: SelectedObjects) -> ForecastPoses:
    """Picks the selected rows of a forecast given for all tracks (`[A, S]` fields)."""
    return jax.tree.map(lambda values: values[selected.track], poses)


def steady_ego(ego: EgoState, num_states: int) -> EgoState:
    """The ego going straight on at its speed, `[1, num_states]`, 0.1 s apart."""
    way = jnp.arange(num_states, dtype=ego.x.dtype) * (DT * ego.vx)
    states = jax.tree.map(lambda v: jnp.broadcast_to(v, (1, num_states)), ego)
    return states.replace(
        x=(ego.x + way * jnp.cos(ego.heading))[None],
        y=(ego.y + way * jnp.sin(ego.heading))[None],
    )


def assemble(
    observation: Observation,
    selected: SelectedObjects,
    poses: ForecastPoses,
    ignored: jax.Array,
    *,
    hide_agents: bool,
) -> AgentForecast:
    """Joins selection and poses into what proposals and scoring read.

    Args:
      observation: the step.
      selected: its objects.
      poses: their future.
      ignored: `[A']` bool, in contact with the ego now.
      hide_agents: True drops vehicles, pedestrians and bicycles (prediction mode "none").
    """
    track = selected.track
    object_type = observation.type[track]
    agent = is_agent(object_type)
    valid = selected.valid & ~agent if hide_agents else selected.valid
    speed = jnp.hypot(observation.vx[track], observation.vy[track])
    return AgentForecast(
        x=poses.x,
        y=poses.y,
        heading=poses.heading,
        sample_valid=poses.valid,
        length=observation.length[track],
        width=observation.width[track],
        type=object_type,
        is_agent=agent,
        speed=jnp.where(agent, speed, 0),
        current_heading=observation.heading[track],
        track=track,
        valid=valid,
        ignored=ignored & valid,
    )
