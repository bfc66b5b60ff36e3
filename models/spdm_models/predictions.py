"""What a learned planner takes for the neighbours' future: its own predictions, the truth, nothing.

Source: the SPDM paper, section "Perfect, learned and no predictions".
"""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import ForecastPoses, React
from spdm_jax.config import DT, FORECAST_DT
from spdm_jax.geometry import wrap
from spdm_jax.planner import StepInput
from spdm_jax.types import EgoState, Scenario

from .plan_frame import in_scene
from .scene_features import Neighbors, local_pose

Prediction = Literal["learned", "perfect", "none"]
"""learned: the network's own. perfect: the recorded future, or in reactive traffic how the agents
would react. none: zeros, the ego's own place."""
Futures = Callable[[jax.Array], jax.Array]
"""From plans of the ego `[N, T, 3]` (ego frame, first at 0.1 s) to the poses of A neighbours beside
each, `[N, A, T, 3]`."""
_PER_SAMPLE = round(FORECAST_DT / DT)
"""Steps of a plan per sample of a forecast."""


def logged_futures(
    scene: Scenario, given: StepInput, neighbors: Neighbors, count: int, steps: int
) -> jax.Array:
    """Recorded futures of the neighbours, first at 0.1 s.

    Chosen: who leaves the record goes on as it last moved.

    Args:
      scene: one scenario.
      given: ego and objects of this step.
      neighbors: of `pick_neighbors`.
      count: A, neighbours to look at.
      steps: T.

    Returns:
      `[A, T, 3]` x, y, heading in the ego frame; zero for missing neighbours.
    """
    tracks, last = scene.tracks, scene.tracks.x.shape[1] - 1
    at = given.observation.step + jnp.arange(steps + 1)
    rows, index = neighbors.track[:count, None], jnp.minimum(at, last)
    values = [getattr(tracks, name)[rows, index] for name in ("x", "y", "heading")]
    known = tracks.valid[rows, index] & (at <= last)
    x, y, heading = values
    poses = jnp.stack(_carried_on(x, y, heading, known), axis=-1)[:, 1:]
    return _in_ego_frame(poses, given.ego, neighbors.valid[:count])


def reacting_futures(
    react: React, ego: EgoState, plans: jax.Array, neighbors: Neighbors, count: int
) -> jax.Array:
    """How the neighbours would move beside each of some plans of the ego.

    Args:
      react: of the simulation.
      ego: current state, scalars.
      plans: `[N, T, 3]` x, y, heading in the ego frame, first at 0.1 s; T is even.
      neighbors: of `pick_neighbors`.
      count: A, neighbours to look at.

    Returns:
      `[N, A, T, 3]` as `logged_futures`.
    """
    steps = plans.shape[1]
    beside = react(drive_states(ego, plans))
    samples = slice(0, steps // _PER_SAMPLE + 1)
    rows: ForecastPoses = jax.tree.map(lambda v: v[:, neighbors.track[:count], samples], beside)
    x, y, heading = _carried_on(rows.x, rows.y, rows.heading, rows.valid)
    heading = heading[..., :1] + jnp.cumsum(wrap(jnp.diff(heading, prepend=heading[..., :1])), -1)
    poses = jnp.stack([x, y, heading], axis=-1)
    at = jnp.arange(1, steps + 1)
    low = jnp.minimum(at // _PER_SAMPLE, poses.shape[-2] - 2)
    share = (at - _PER_SAMPLE * low).astype(plans.dtype) / _PER_SAMPLE
    here, there = poses[..., low, :], poses[..., low + 1, :]
    return _in_ego_frame(here + share[:, None] * (there - here), ego, neighbors.valid[:count])


def futures_of(
    prediction: Prediction,
    scene: Scenario,
    given: StepInput,
    neighbors: Neighbors,
    count: int,
    steps: int,
    react: React | None = None,
) -> Futures | None:
    """Returns what takes the place of a network's predictions; None keeps them.

    Args:
      prediction: which kind.
      scene: one scenario.
      given: ego and objects of this step.
      neighbors: of `pick_neighbors`.
      count: A, neighbours that the network predicts.
      steps: T, longest plan that is asked about.
      react: how traffic would react, in traffic that does.
    """
    if prediction == "learned":
        return None
    if prediction == "perfect" and react is not None:
        return lambda plans: reacting_futures(react, given.ego, plans, neighbors, count)
    fixed = jnp.zeros((count, steps, 3), given.ego.x.dtype)
    if prediction == "perfect":
        fixed = logged_futures(scene, given, neighbors, count, steps)
    return lambda plans: jnp.broadcast_to(
        fixed[:, : plans.shape[1]], (plans.shape[0], count, plans.shape[1], 3)
    )


def drive_states(ego: EgoState, plans: jax.Array) -> EgoState:
    """States `[N, T + 1]` along plans `[N, T, 3]` of the ego frame, the current one first.

    Speeds follow from the steps; what else a state holds stays as it is now.
    """
    x, y, heading = in_scene(plans, ego)
    states = jax.tree.map(lambda v: jnp.broadcast_to(v, x.shape), ego)
    speed = jnp.hypot(jnp.diff(x), jnp.diff(y)) / DT
    return states.replace(
        x=x,
        y=y,
        heading=heading,
        vx=states.vx.at[:, 1:].set(speed),
        vy=states.vy.at[:, 1:].set(0),
    )


def _carried_on(x, y, heading, known) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fills samples `[..., S]` that are not known with the motion between the last two known ones.

    The first sample, now, is known of everyone who is looked at.
    """
    index = jnp.arange(x.shape[-1])
    latest = jax.lax.cummax(jnp.where(known, index, 0), axis=x.ndim - 1)
    earlier = jnp.where(latest > 0, latest - 1, 0)
    take = lambda values, at: jnp.take_along_axis(values, at, axis=-1)
    moved = take(known, earlier) & (latest > 0)
    beyond = (index - latest).astype(x.dtype)

    def filled(values):
        step = jnp.where(moved, take(values, latest) - take(values, earlier), 0)
        return take(values, latest) + beyond * step

    return filled(x), filled(y), take(heading, latest)


def _in_ego_frame(poses: jax.Array, ego: EgoState, valid: jax.Array) -> jax.Array:
    """Moves poses `[..., A, T, 3]` into the ego frame; zero where not `valid` `[A]`."""
    x, y, heading = jnp.moveaxis(poses, -1, 0)
    local = jnp.stack(local_pose(x, y, heading, ego), axis=-1)
    return jnp.where(valid[:, None, None], local, 0)
