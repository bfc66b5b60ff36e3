"""Odd scenarios end in a record that can be used: no NaN, no overflow, no failure."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import EGO_X, Thing
from spdm_jax import api, functional
from spdm_jax.io.raw import RawScenario
from spdm_jax.metrics import SCORED, ClosedLoopMetrics, Expert, closed_loop
from spdm_jax.padding import PaddingConfig
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.drivers import Driver, constant_velocity_driver
from spdm_jax.simulation.idm_driver import idm_driver
from spdm_jax.simulation.loop import (
    Run,
    SimulationConfig,
    SimulationParams,
    TrafficMode,
    simulate,
)
from spdm_jax.types import ObjectType, Scenario

pytestmark = pytest.mark.slow  # compiles several simulations

SAMPLES = 80
SIZES = AgentSizes(agents=8, replayed=8, path_points=401, outline_blocks=1)
STRAIGHT, IDM = constant_velocity_driver(), idm_driver(max_path_points=512)


@partial(jax.jit, static_argnames=("driver", "traffic"))
def _run(scene: Scenario, driver: Driver, traffic: TrafficMode) -> Run:
    config = SimulationConfig(num_samples=SAMPLES, traffic=traffic, sizes=SIZES)
    return simulate(scene, driver, SimulationParams(), config)


@jax.jit
def _judge(scene: Scenario, run: Run) -> ClosedLoopMetrics:
    index = scene.num_history + jnp.arange(SAMPLES + 1)
    expert = Expert(jax.tree.map(lambda v: v[index], scene.ego), jnp.ones(SAMPLES + 1, bool))
    return closed_loop(run.history, scene.map, expert)


def judged(
    raw: RawScenario, driver: Driver = IDM, traffic: TrafficMode = "reactive"
) -> tuple[Run, ClosedLoopMetrics]:
    raw = dataclasses.replace(raw, num_iterations=SAMPLES + 1)
    scene = roads.scene_of(raw)
    run = jax.tree.map(np.asarray, _run(scene, driver, traffic))
    metrics = jax.tree.map(np.asarray, _judge(scene, run))
    assert not run.overflow and not run.failed
    assert run.history.valid.all()
    assert np.isfinite(run.history.ego.x).all() and np.isfinite(run.history.ego.vx).all()
    objects = run.history.objects
    for values in (objects.x, objects.y, objects.heading, objects.vx, objects.vy):
        assert np.isfinite(values[objects.valid]).all()
    assert np.isfinite(metrics.scores).all() and np.isfinite(metrics.final)
    return run, metrics


def score_of(metrics: ClosedLoopMetrics, name: str) -> float:
    return float(metrics.scores[SCORED.index(name)])


def test_no_agents():
    run, metrics = judged(roads.road(speed=8.0))
    assert not run.history.objects.valid.any()
    assert metrics.final > 0.9


def test_an_agent_that_starts_in_the_ego_does_not_drive():
    raw = roads.road(speed=8.0, things=[Thing(EGO_X + 3.0, -3.5, speed=8.0)])
    run, metrics = judged(raw)
    assert not run.history.objects.valid.any()
    assert score_of(metrics, "no_ego_at_fault_collisions") == 1


def test_a_recorded_object_that_starts_in_the_ego():
    raw = roads.road(speed=8.0, things=[Thing(EGO_X + 3.0, -3.5)])
    _, metrics = judged(raw, traffic="replay")
    assert score_of(metrics, "no_ego_at_fault_collisions") == 0
    assert metrics.final == 0


def test_agents_that_start_in_each_other():
    things = [Thing(100.0, 0.0, speed=5.0), Thing(102.0, 0.5, speed=5.0)]
    cone = Thing(130.0, 0.0, type=int(ObjectType.TRAFFIC_CONE), length=0.5, width=0.5)
    run, _ = judged(roads.road(speed=8.0, things=[*things, cone, Thing(131.0, 0.0)]))
    np.testing.assert_array_equal(run.history.objects.valid[-1, :4], [True, False, True, False])


def test_an_ego_that_leaves_the_map():
    raw = roads.road(speed=10.0, ego_heading=1.0, things=[Thing(100.0, 0.0, speed=5.0)])
    run, metrics = judged(raw, STRAIGHT)
    assert run.history.ego.y[-1] > 50.0
    assert score_of(metrics, "drivable_area_compliance") == 0
    assert metrics.final == 0


def test_a_route_that_ends_early():
    raw = roads.road(speed=8.0, ego_x=150.0)
    run, _ = judged(dataclasses.replace(raw, route_roadblocks=["b0"]))
    ego = run.history.ego
    assert np.all(ego.x + 150.0 < 200.0)
    assert ego.vx[-1] < 2.0


def test_lights_that_never_turn_green():
    things = [Thing(150.0, 0.0, speed=8.0)]
    run, metrics = judged(roads.road(speed=8.0, ego_x=150.0, red=(0, 1), things=things))
    assert np.all(run.history.ego.x + 150.0 + roads.FRONT < 200.0)
    assert run.history.ego.vx[-1] < 2.0
    objects = run.history.objects
    assert objects.valid[:, 0].all() and np.all(objects.x[:, 0] + 150.0 + 2.3 < 200.0)
    assert score_of(metrics, "no_ego_at_fault_collisions") == 1


def test_irregular_time_stamps():
    things = [Thing(100.0, 0.0, speed=5.0), Thing(EGO_X - 40.0, -3.5, speed=4.0)]
    raw = roads.road(speed=8.0, things=things)
    jitter = np.random.default_rng(3).integers(-30_000, 30_000, len(raw.time_us))
    raw = dataclasses.replace(raw, time_us=raw.time_us + jitter)
    run, _ = judged(raw, STRAIGHT)
    history = run.history
    step = np.diff(history.time)
    assert step.std() > 0.01
    np.testing.assert_allclose(np.diff(history.ego.x), history.ego.vx[:-1] * step, atol=1e-9)
    objects = history.objects
    moved, driven = np.diff(objects.x[:, :2], axis=0), objects.vx[:-1, :2] * step[:, None]
    np.testing.assert_allclose(moved, driven, atol=1e-9)


@pytest.mark.slow
def test_three_hundred_agents():
    lanes = range(8)
    spots = [(20.0 + 11.0 * i, -3.5 * k) for k in lanes for i in range(38)]
    things = [Thing(x, y, speed=5.0) for x, y in spots if abs(x - EGO_X) > 12 or y != -3.5][:300]
    blocks = (tuple(lanes), tuple(lanes))
    raw = roads.road(speed=5.0, blocks=blocks, things=things)
    raw = dataclasses.replace(raw, num_iterations=SAMPLES + 1)
    batch = functional.to_device(api.from_raw([raw], padding=PaddingConfig()).batch, jnp.float32)
    scene = jax.tree.map(lambda v: v[0], batch)
    sizes = AgentSizes(agents=304, path_points=401)
    config = SimulationConfig(num_samples=20, traffic="reactive", sizes=sizes)
    run = jax.jit(lambda s: simulate(s, STRAIGHT, SimulationParams(), config))(scene)
    assert not run.overflow and not run.failed
    valid = np.asarray(run.history.objects.valid)
    assert valid[0].sum() == 300
    x = np.asarray(run.history.objects.x)
    assert np.isfinite(x[valid]).all()
    # Nobody runs into anybody: order along each lane is kept.
    for lane in lanes:
        row = [i for i, thing in enumerate(things) if thing.y == -3.5 * lane]
        stations = x[-1, row][valid[-1, row]]
        assert np.all(np.diff(stations) > 4.6)
