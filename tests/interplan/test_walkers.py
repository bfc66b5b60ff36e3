"""What a planner that asks for reactions is told of pedestrians that wait for the ego."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import Thing
from spdm_jax.config import NUM_STATES
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.controller import Plan
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.simulation.loop import SimulationConfig, SimulationParams, simulate
from spdm_jax.simulation.script import AgentPolicy, Script
from spdm_jax.types import ObjectType

SAMPLES = 40
TRACKS = roads.PADDING.tracks[0]
SIZES = AgentSizes(agents=2, replayed=2, path_points=401, outline_blocks=1)
CONFIG = SimulationConfig(
    num_samples=SAMPLES, traffic="reactive", ego="log", record_plans=True, sizes=SIZES
)
START, STOP = (70.0, 4.0), (70.0, -6.0)
"""Where the pedestrian walks, relative to the ego's start, m."""


def asking_driver() -> Driver:
    """Its plans are the forecast of track 0 beside an ego that stands: x, y, and valid as heading.

    The ego keeps to its record, so that the plans move nothing.
    """

    def step_reacting(scene, given, time, state, react):
        states = jax.tree.map(lambda v: jnp.broadcast_to(v, (1, NUM_STATES)), given.ego)
        told = jax.tree.map(lambda v: v[0, 0], react(states))
        seconds = 0.2 * jnp.arange(told.x.shape[0]).astype(time.dtype)
        seen = told.valid.astype(time.dtype)
        plan = Plan(x=told.x, y=told.y, heading=seen, time=seconds, start=time)
        return Driven(plan, state, jnp.bool_(False))

    def step(scene, given, time, state):
        none = jnp.zeros(41, time.dtype)
        plan = Plan(x=none, y=none, heading=none, time=none, start=time)
        return Driven(plan, state, jnp.bool_(False))

    return Driver("asking", lambda scene: (), step, step_reacting)


@pytest.mark.slow
def test_a_forecast_leaves_pedestrians_where_they_are():
    walker = Thing(0.0, 0.0, type=int(ObjectType.PEDESTRIAN), until=-roads.NUM_STEPS)
    raw = dataclasses.replace(roads.road(things=[walker]), num_iterations=SAMPLES + 1)
    script = Script(
        policy=jnp.int32(AgentPolicy.ASSERTIVE),
        seed=jnp.uint32(0),
        stopped=jnp.zeros(TRACKS, bool),
        cautious=jnp.zeros(TRACKS, bool),
        track=jnp.array([0], jnp.int32),
        start=jnp.array([START]),
        stop=jnp.array([STOP]),
        course=jnp.array([[0.0, 0.0], [600.0, 0.0]]),
        end=jnp.asarray(599.0),
    )

    @jax.jit
    def play(scene, script):
        return simulate(scene, asking_driver(), SimulationParams(), CONFIG, script=script)

    run = jax.tree.map(np.asarray, play(roads.scene_of(raw), script))
    assert run.history.valid.all() and not run.failed
    objects, told = run.history.objects, run.plans
    there = objects.valid[:, 0]
    begins = int(np.argmax(there))
    assert 15 < begins < 25 and there[begins:].all()
    walked = objects.y[there, 0]
    assert np.all(np.diff(walked[1:]) < -0.05)
    # Nobody is told that a pedestrian is about to come, and it is told to stay once it is there.
    assert not told.heading[~there].any() and told.heading[there].all()
    np.testing.assert_allclose(told.x[there], START[0], atol=1e-9)
    np.testing.assert_allclose(told.y[there], walked[:, None].repeat(41, 1), atol=1e-9)
