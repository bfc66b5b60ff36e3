"""nuPlan's simulation of one scenario as one scan: plan, control, move the traffic, record.

Everything here is one scenario; batches are `jax.vmap` or `jax.lax.map` of `simulate`.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.agents.observation import Observation
from spdm_jax.config import TrackerParams, VehicleParams
from spdm_jax.geometry import ego_box
from spdm_jax.planner import StepInput, observe
from spdm_jax.simulation.agent_state import (
    AgentParams,
    AgentSizes,
    RoadFacts,
    Traffic,
    road_facts,
    traffic_snapshot,
)
from spdm_jax.simulation.controller import PLAN_SECONDS, Plan, perfect_step, track_step
from spdm_jax.simulation.drivers import Driver
from spdm_jax.simulation.history import History, Snapshot
from spdm_jax.simulation.idm_agents import step_traffic
from spdm_jax.simulation.placement import place_agents
from spdm_jax.simulation.reactions import Future, reactions, steps_ahead
from spdm_jax.simulation.script import Script, Walkers, past_goal, walkers_at, with_walkers
from spdm_jax.types import Array, EgoState, Scenario

TrafficMode = Literal["replay", "reactive"]
EgoMode = Literal["two_stage", "perfect", "log"]


@dataclass(frozen=True)
class SimulationConfig:
    """Static settings of a run.

    Attributes:
      num_samples: T, samples of the history; a scenario of N iterations fills N - 1 of them.
      traffic: "replay" moves all objects as recorded (non-reactive), "reactive" lets the vehicles
        drive by IDM.
      ego: "two_stage" tracks the plan, "perfect" puts the ego on it, "log" keeps the ego on its
        recorded poses (open loop).
      replan_every: steps between two calls of the planner.
      record_plans: whether the plan of each sample is kept.
      plan_seconds: length of the planner's plans, s.
      sizes: room for reactive traffic.
    """

    num_samples: int = 149
    traffic: TrafficMode = "replay"
    ego: EgoMode = "two_stage"
    replan_every: int = 1
    record_plans: bool = False
    plan_seconds: float = PLAN_SECONDS
    sizes: AgentSizes = field(default_factory=AgentSizes)

    def __post_init__(self):
        for name, value, allowed in (
            ("traffic", self.traffic, ("replay", "reactive")),
            ("ego", self.ego, ("two_stage", "perfect", "log")),
        ):
            if value not in allowed:
                raise ValueError(f"{name} is {value!r}; it must be one of {allowed}")
        for name, value in (
            ("num_samples", self.num_samples),
            ("replan_every", self.replan_every),
        ):
            if value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1")


class SimulationParams(struct.PyTreeNode, kw_only=True):
    """Traced settings of a run; nuPlan's by default."""

    vehicle: VehicleParams = struct.field(default_factory=VehicleParams)
    tracker: TrackerParams = struct.field(default_factory=TrackerParams)
    agents: AgentParams = struct.field(default_factory=AgentParams)


class Run(struct.PyTreeNode, kw_only=True):
    """A finished run.

    Attributes:
      history: what the metrics read.
      plans: `Plan` `[T, M]`, or None where they were not recorded.
      failed: `[]` bool, the planner returned a number that is not finite; the run ended there.
      skipped_agents: `[]` int32, agents that once could not move (see `step_traffic`).
      overflow: `[]` bool, a fixed buffer was too small; results are not to be used.
    """

    history: History
    plans: Plan | None
    failed: Array
    skipped_agents: Array
    overflow: Array


_OBJECT_FIELDS = tuple(Snapshot.__dataclass_fields__)
"""What observations say of objects."""


class _Carry(NamedTuple):
    ego: EgoState
    traffic: Traffic | None
    state: object
    plan: Plan
    failed: jax.Array
    overflow: jax.Array
    arrived: jax.Array
    walkers: Walkers | None


class _Sample(NamedTuple):
    """What one step leaves in the record."""

    ego: EgoState
    objects: Snapshot
    lights: jax.Array
    time: jax.Array
    valid: jax.Array
    plan: Plan | None


def logged_objects(scene: Scenario, at: jax.Array | int) -> Snapshot:
    """The recorded objects of one step of the time axis, `[A]`."""
    recorded = observe(scene, at - scene.num_history).observation
    return Snapshot(**{name: getattr(recorded, name) for name in _OBJECT_FIELDS})


def _given(ego: EgoState, objects: Snapshot, lights: jax.Array, at: jax.Array) -> StepInput:
    seen = {name: getattr(objects, name) for name in _OBJECT_FIELDS}
    return StepInput(ego=ego, observation=Observation(**seen, lights=lights, step=at))


def _finite(plan: Plan) -> jax.Array:
    return jnp.all(jnp.isfinite(plan.x) & jnp.isfinite(plan.y) & jnp.isfinite(plan.heading))


def _choose(flag: jax.Array, new, old):
    return jax.tree.map(lambda a, b: jnp.where(flag, a, b), new, old)


def simulate(
    scene: Scenario,
    driver: Driver,
    params: SimulationParams,
    config: SimulationConfig,
    facts: RoadFacts | None = None,
    script: Script | None = None,
) -> Run:
    """Runs one scenario from its iteration 0 to its end.

    The clock ends the run before the last state is reached, so N iterations leave N - 1 samples.
    Agents react to the ego where it was, under the lights and replayed objects of the next step.

    Args:
      scene: one scenario on the device, floats of one dtype.
      driver: the planner; make it inside `jit` where its own settings are traced.
      params: traced settings.
      config: static settings.
      facts: `road_facts` of the map where several runs share it.
      script: of an interPlan scenario, `origin` and dtype as the scene's. Its pedestrians see the
        ego where it was, as agents do; past its goal the run ends without another sample. To a
        planner that asks how traffic reacts, pedestrians that wait or walk stand where they are.

    Source: nuPlan `Simulation`, `SimulationRunner`, `IDMAgents`, `LogPlaybackController`.
    """
    dtype = scene.ego.x.dtype
    params = jax.tree.map(lambda value: jnp.asarray(value, dtype), params)
    reactive = config.traffic == "reactive"
    last = scene.time.shape[0] - 1
    at_step = lambda i: jnp.minimum(scene.num_history + i, last).astype(jnp.int32)
    logged_ego = lambda at: jax.tree.map(lambda values: values[at], scene.ego)
    begin = at_step(0)
    ego = logged_ego(begin)
    if reactive and facts is None:
        facts = road_facts(scene.map, config.sizes)

    def control(ego, plan, at, following):
        time, after = scene.time[at].astype(dtype), scene.time[following].astype(dtype)
        if config.ego == "log":
            return logged_ego(following)
        if config.ego == "perfect":
            return perfect_step(ego, plan, time, after)
        seconds = config.plan_seconds
        return track_step(ego, plan, time, after, params.vehicle, params.tracker, seconds)

    def objects_at(at, walkers):
        objects = logged_objects(scene, at)
        return objects if script is None else with_walkers(objects, script, walkers)

    def walk(began, ego, i):
        assert script is not None
        box = ego_box(ego, params.vehicle)
        at = jnp.asarray(i, jnp.int32)
        return walkers_at(script, began, scene.map, box.x, box.y, at, scene.num_iterations)

    def move_traffic(traffic, ego, objects, i):
        assert facts is not None
        at, following = at_step(i), at_step(i + 1)
        return step_traffic(
            traffic,
            scene.map,
            facts,
            ego_box(ego, params.vehicle),
            ego.heading,
            jnp.hypot(ego.vx, ego.vy),
            objects,
            scene.lights[following],
            (scene.time[following] - scene.time[at]).astype(dtype),
            params.agents,
            config.sizes,
            script,
            i,
        )

    def react_to(traffic, walkers, i, states: EgoState) -> ForecastPoses:
        assert facts is not None
        ahead = jnp.arange(steps_ahead(states.x.shape[1]) + 1)
        recorded = jax.vmap(lambda k: objects_at(at_step(i + k), walkers))(ahead)
        future = Future(
            objects=recorded.replace(type=scene.tracks.type),
            lights=scene.lights[at_step(i + ahead)],
        )
        vehicle, agents, sizes = params.vehicle, params.agents, config.sizes
        return reactions(
            states, traffic, scene.map, facts, future, i, vehicle, agents, sizes, script
        )

    def seen(traffic, at, walkers):
        objects = objects_at(at, walkers)
        return traffic_snapshot(traffic, objects) if reactive else objects

    def step(carry: _Carry, i):
        at, following = at_step(i), at_step(i + 1)
        objects, lights = seen(carry.traffic, at, carry.walkers), scene.lights[at]
        given = _given(carry.ego, objects, lights, at)
        time = scene.time[at].astype(dtype)

        def think():
            if not reactive or driver.step_reacting is None:
                return driver.step(scene, given, time, carry.state)
            react = partial(react_to, carry.traffic, carry.walkers, i)
            return driver.step_reacting(scene, given, time, carry.state, react)

        if config.replan_every == 1:
            plan, state, overflow = think()
        else:
            plan, state, overflow = jax.lax.cond(
                i % config.replan_every == 0,
                lambda: tuple(think()),
                lambda: (carry.plan, carry.state, jnp.bool_(False)),
            )
        arrived = carry.arrived
        if script is not None:
            box = ego_box(carry.ego, params.vehicle)
            arrived |= past_goal(script, box.x, box.y)
        running = (i < scene.num_iterations - 1) & ~arrived
        failed = carry.failed | (running & ~_finite(plan))
        record = _Sample(
            ego=carry.ego,
            objects=objects.replace(type=None),
            lights=lights,
            time=scene.time[at],
            valid=running & ~failed,
            plan=plan if config.record_plans else None,
        )

        goes_on = (i + 1 < scene.num_iterations - 1) & ~failed & ~arrived
        ego = _choose(goes_on, control(carry.ego, plan, at, following), carry.ego)
        traffic, walkers = carry.traffic, carry.walkers
        if walkers is not None:
            walkers = _choose(goes_on, walk(walkers.began, carry.ego, i + 1), walkers)
        if reactive:
            objects = objects_at(following, walkers)
            traffic = jax.lax.cond(
                goes_on,
                lambda: move_traffic(carry.traffic, carry.ego, objects, i),
                lambda: carry.traffic,
            )
        overflow = carry.overflow | (running & overflow)
        return _Carry(ego, traffic, state, plan, failed, overflow, arrived, walkers), record

    traffic = walkers = None
    if script is not None:
        walkers = walk(jnp.full(script.track.shape, -1, jnp.int32), ego, jnp.int32(0))
    objects = objects_at(begin, walkers)
    if reactive:
        assert facts is not None
        traffic = place_agents(
            scene.map, facts, objects, ego, params.vehicle, params.agents, config.sizes, script
        )
    state = driver.init(scene)
    first = _given(ego, objects, scene.lights[begin], begin)
    shape = jax.eval_shape(driver.step, scene, first, scene.time[begin].astype(dtype), state)
    plan = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape.plan)
    no = jnp.bool_(False)
    start = _Carry(ego, traffic, state, plan, no, no, no, walkers)
    end, record = jax.lax.scan(step, start, jnp.arange(config.num_samples))
    skipped, overflow = jnp.int32(0), end.overflow
    if end.traffic is not None:
        skipped = jnp.sum(end.traffic.agents.skipped, dtype=jnp.int32)
        overflow |= end.traffic.overflow
    return Run(
        history=History(
            time=record.time,
            ego=record.ego,
            valid=record.valid,
            objects=record.objects.replace(type=scene.tracks.type),
            lights=record.lights,
        ),
        plans=record.plan,
        failed=end.failed,
        skipped_agents=skipped,
        overflow=overflow,
    )
