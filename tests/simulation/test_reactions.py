"""Reactive forecasts: the simulation's own agents beside each proposal."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import EGO_X, Thing
from spdm_jax.config import NUM_STATES, PlannerConfig, VehicleParams, pdm_closed
from spdm_jax.geometry import make_path
from spdm_jax.scoring.areas import AreaMasks
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.simulation.agent_state import AgentParams, AgentSizes, road_facts
from spdm_jax.simulation.drivers import constant_velocity_driver, planner_driver
from spdm_jax.simulation.loop import SimulationConfig, SimulationParams, logged_objects, simulate
from spdm_jax.simulation.placement import place_agents
from spdm_jax.simulation.reactions import Future, reactions, steps_ahead
from spdm_jax.types import AgentForecast, ObjectType

pytestmark = pytest.mark.slow  # compiles several simulations

SAMPLES = 60
SIZES = AgentSizes(agents=4, replayed=4, path_points=401, outline_blocks=1)
THINGS = [
    Thing(EGO_X - 40.0, -3.5, speed=8.0),  # has to brake for the ego
    Thing(EGO_X + 30.0, 0.0, speed=5.0),
    Thing(EGO_X + 60.0, 6.0, speed=1.0, type=int(ObjectType.PEDESTRIAN)),
]


def test_the_forecast_is_what_the_simulation_does():
    raw = roads.road(speed=5.0, things=THINGS)
    scene = roads.scene_of(dataclasses.replace(raw, num_iterations=SAMPLES + 1))
    config = SimulationConfig(num_samples=SAMPLES, traffic="reactive", sizes=SIZES)
    vehicle, params = VehicleParams(), AgentParams()

    @jax.jit
    def both(scene):
        run = simulate(scene, constant_velocity_driver(), SimulationParams(), config).history
        begin = scene.num_history
        ego = jax.tree.map(lambda v: v[begin], scene.ego)
        facts = road_facts(scene.map, SIZES)
        objects = logged_objects(scene, begin)
        traffic = place_agents(scene.map, facts, objects, ego, vehicle, params, SIZES)
        ahead = begin + jnp.arange(steps_ahead(NUM_STATES) + 1)
        recorded = jax.vmap(lambda at: logged_objects(scene, at))(ahead)
        future = Future(recorded.replace(type=scene.tracks.type), scene.lights[ahead])
        # One drive as simulated, one that stands.
        stand = jax.tree.map(lambda v: jnp.broadcast_to(v, NUM_STATES), ego.replace(vx=0 * ego.vx))
        drives = jax.tree.map(lambda a, b: jnp.stack([a[:NUM_STATES], b]), run.ego, stand)
        now = jnp.int32(0)
        return run, reactions(
            drives, traffic, scene.map, facts, future, now, vehicle, params, SIZES
        )

    run, forecast = jax.tree.map(np.asarray, both(scene))
    assert forecast.x.shape[0] == 2 and forecast.x.shape[2] == 41
    asked = np.arange(0, steps_ahead(NUM_STATES) + 1, 2)
    for name in ("x", "y", "heading"):
        ours = getattr(forecast, name)[0, :3, : len(asked)].T
        np.testing.assert_allclose(ours, getattr(run.objects, name)[asked, :3], atol=1e-6)
    assert forecast.valid[0, :3].all()
    # Behind an ego that stands the follower gets less far; nobody else minds.
    assert forecast.x[1, 0, 25] < forecast.x[0, 0, 25] - 1.0
    np.testing.assert_allclose(forecast.x[1, 1:3], forecast.x[0, 1:3], atol=1e-9)


def test_scores_with_the_same_future_for_each_proposal():
    """Five drives and eight objects at random; poses given once or once per drive."""
    rng = np.random.default_rng(1)
    raw = roads.road()
    scene = roads.scene_of(raw)
    count, objects = 5, 8
    time = 0.1 * np.arange(NUM_STATES)
    speed = rng.uniform(2, 12, (count, 1))
    zero = np.zeros((count, NUM_STATES))
    ego = jax.tree.map(lambda v: jnp.asarray(zero), jax.tree.map(lambda v: v[0], scene.ego))
    ego = ego.replace(
        x=jnp.asarray(speed * time), y=jnp.asarray(zero + rng.uniform(-2, 2, (count, 1)))
    ).replace(vx=jnp.asarray(zero + speed))
    spread = lambda v: jnp.asarray(np.repeat(np.asarray(v)[:, None], 41, 1))
    forecast = AgentForecast(
        x=spread(rng.uniform(5, 60, objects)),
        y=spread(rng.uniform(-4, 4, objects)),
        heading=spread(rng.uniform(-1, 1, objects)),
        sample_valid=jnp.ones((objects, 41), bool),
        length=jnp.full(objects, 4.0),
        width=jnp.full(objects, 1.8),
        type=jnp.zeros(objects, jnp.int32),
        is_agent=jnp.ones(objects, bool),
        speed=jnp.full(objects, 3.0),
        current_heading=jnp.zeros(objects),
        track=jnp.arange(objects),
        valid=jnp.ones(objects, bool),
        ignored=jnp.arange(objects) == 2,
    )
    params = pdm_closed(15).params
    nothing = jnp.zeros(scene.map.grid.masks.shape[1], jnp.uint32)
    line = jnp.arange(40.0)
    path = make_path(2.0 * line, 0 * line, 0 * line, jnp.int32(40))

    @jax.jit
    def judge(forecast):
        world = World(scene.map.grid, AreaMasks(nothing, nothing, nothing), forecast, path)
        valid = jnp.ones(count, bool)
        return score_trajectories(ego, valid, world, params.vehicle, params.scoring)

    once = judge(forecast)
    own = {
        name: jnp.broadcast_to(getattr(forecast, name), (count, objects, 41))
        for name in ("x", "y", "heading", "sample_valid")
    }
    each = judge(forecast.replace(**own))
    assert len(np.unique(once.collision_time)) > 2
    jax.tree.map(np.testing.assert_array_equal, once, each)
    # Without objects beside one drive, that drive alone is free.
    own["sample_valid"] = own["sample_valid"].at[0].set(False)
    free = judge(forecast.replace(**own))
    assert np.isinf(free.collision_time[0]) and np.isfinite(once.collision_time[0])
    np.testing.assert_array_equal(free.collision_time[1:], once.collision_time[1:])


@pytest.mark.slow
def test_planner_with_reactive_forecast():
    spec = pdm_closed(15, config=PlannerConfig(max_path_points=512, forecast="reactive"))
    driver = planner_driver("PDM", spec.params, spec.config)
    config = SimulationConfig(num_samples=2, traffic="reactive", sizes=SIZES)
    run = jax.jit(partial(simulate, driver=driver, params=SimulationParams(), config=config))
    result = run(roads.scene_of(roads.road(things=THINGS)))
    assert not result.failed and not result.overflow
    assert np.isfinite(result.history.ego.x).all()
