"""Planners as the simulation runs them: a state to carry and one step that returns a plan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax import planner
from spdm_jax.agents.forecast import React
from spdm_jax.config import DT, NUM_TRAJECTORY_STATES, PlannerConfig, PlannerParams
from spdm_jax.planner import StepInput
from spdm_jax.simulation.controller import Plan
from spdm_jax.types import Scenario


class Driven(NamedTuple):
    """What one planning step returns.

    Attributes:
      plan: trajectory from the current pose on.
      state: for the next step.
      overflow: `[]` bool, a fixed buffer of the planner was too small.
    """

    plan: Plan
    state: Any
    overflow: jax.Array


class Driver(NamedTuple):
    """A planner: pure functions, compared by identity.

    Attributes:
      name: for tables.
      init: from the scenario to the state before the first step.
      step: from scenario, input, time (s) and state to `Driven`.
      step_reacting: the same with how traffic would react besides (last); used instead of `step`
        in reactive traffic where it is given.
    """

    name: str
    init: Callable[[Scenario], Any]
    step: Callable[[Scenario, StepInput, jax.Array, Any], Driven]
    step_reacting: Callable[[Scenario, StepInput, jax.Array, Any, React], Driven] | None = None


def _regular(values: dict[str, jax.Array], time: jax.Array) -> Plan:
    x = values["x"]
    return Plan(**values, time=jnp.arange(x.shape[0]).astype(x.dtype) * DT, start=time)


def planner_driver(name: str, params: PlannerParams, config: PlannerConfig) -> Driver:
    """PDM-Closed or SPDM; stage-1 paths and what was met stay in the state."""

    def init(scene):
        return planner.init(scene, params, config)

    def step(scene, given, time, state, react=None):
        result, state = planner.step(scene, given, state, params, config, react)
        chosen = result.trajectory
        values = {"x": chosen.x, "y": chosen.y, "heading": chosen.heading}
        return Driven(_regular(values, time), state, result.overflow)

    return Driver(name, init, step, step if config.forecast == "reactive" else None)


def constant_velocity_driver() -> Driver:
    """Straight on at the current speed."""

    def step(scene, given, time, state):
        ego = given.ego
        way = jnp.arange(NUM_TRAJECTORY_STATES).astype(ego.x.dtype) * (DT * ego.vx)
        values = {
            "x": ego.x + way * jnp.cos(ego.heading),
            "y": ego.y + way * jnp.sin(ego.heading),
            "heading": jnp.broadcast_to(ego.heading, way.shape),
        }
        return Driven(_regular(values, time), state, jnp.bool_(False))

    return Driver("constant velocity", lambda scene: (), step)


def log_replay_driver() -> Driver:
    """The recorded future as the plan; where the record ends the ego is planned to stand."""

    def step(scene, given, time, state):
        at = given.observation.step
        index = at + jnp.arange(NUM_TRAJECTORY_STATES)
        last = jnp.max(jnp.where(scene.ego_valid, jnp.arange(scene.ego_valid.shape[0]), -1))
        source = jnp.minimum(index, last)
        beyond = (index - source).astype(scene.time.dtype) * DT
        pick = lambda values: values[source]
        plan = Plan(
            x=pick(scene.ego.x),
            y=pick(scene.ego.y),
            heading=pick(scene.ego.heading),
            time=(pick(scene.time) + beyond - scene.time[at]).astype(scene.ego.x.dtype),
            start=time,
        )
        return Driven(plan, state, jnp.bool_(False))

    return Driver("log replay", lambda scene: (), step)


def scripted_driver(plans: Plan) -> Driver:
    """Plays given plans `[T, M]`, one per iteration."""

    def step(scene, given, time, state):
        i = given.observation.step - scene.num_history
        return Driven(jax.tree.map(lambda v: v[i], plans), state, jnp.bool_(False))

    return Driver("scripted", lambda scene: (), step)
