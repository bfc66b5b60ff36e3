"""The loop itself: samples, modes, replanning, failures, batches."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import Thing
from spdm_jax.simulation.drivers import (
    Driven,
    Driver,
    constant_velocity_driver,
    log_replay_driver,
    planner_driver,
)
from spdm_jax.simulation.idm_driver import idm_driver
from spdm_jax.simulation.loop import Run, SimulationConfig, SimulationParams, simulate

SAMPLES = 30


def scene(iterations: int = SAMPLES + 1, dtype=jnp.float64, **kwargs):
    raw = roads.road(things=[Thing(100.0, -3.5, speed=6.0)], **kwargs)
    return roads.scene_of(dataclasses.replace(raw, num_iterations=iterations), dtype)


def run(where, driver: Driver, **settings) -> Run:
    config = SimulationConfig(num_samples=SAMPLES, **settings)
    program = jax.jit(lambda s: simulate(s, driver, SimulationParams(), config))
    return jax.tree.map(np.asarray, program(where))


@pytest.fixture(scope="module")
def replayed() -> Run:
    return run(scene(21), constant_velocity_driver(), record_plans=True)


def test_a_scenario_leaves_one_sample_less_than_iterations(replayed: Run):
    np.testing.assert_array_equal(replayed.history.valid, np.arange(SAMPLES) < 20)
    np.testing.assert_allclose(replayed.history.time[:20], 0.1 * np.arange(20), atol=1e-9)
    x = replayed.history.ego.x
    np.testing.assert_array_equal(x[20:], x[19])
    assert not replayed.failed


def test_replay_moves_objects_as_recorded(replayed: Run):
    objects = replayed.history.objects
    np.testing.assert_allclose(np.diff(objects.x[:20, 0]), 0.6, atol=1e-9)
    np.testing.assert_array_equal(objects.valid[:20], objects.valid[:1].repeat(20, 0))
    assert objects.type.shape == objects.x.shape[1:]


def test_constant_velocity_goes_straight_on(replayed: Run):
    ego = replayed.history.ego
    np.testing.assert_allclose(ego.vx[:20], 10.0, atol=1e-6)
    np.testing.assert_allclose(np.diff(ego.x[:20]), 1.0, atol=1e-6)
    np.testing.assert_allclose(ego.y[:20], ego.y[0], atol=1e-9)


def test_plans_start_where_the_ego_is(replayed: Run):
    plans = replayed.plans
    assert plans is not None and plans.x.shape == (SAMPLES, 81)
    np.testing.assert_allclose(plans.x[:, 0], replayed.history.ego.x, atol=1e-12)


def test_old_plans_are_kept_between_replanning():
    plans = run(scene(), constant_velocity_driver(), record_plans=True, replan_every=4).plans
    assert plans is not None
    start = np.asarray(plans.start)
    np.testing.assert_allclose(start, 0.4 * (np.arange(SAMPLES) // 4), atol=1e-9)


@pytest.mark.parametrize("ego", ["log", "perfect"])
def test_the_log_is_repeated(ego):
    where = scene(speed=8.0)
    history = run(where, log_replay_driver(), ego=ego).history
    begin = int(where.num_history)
    np.testing.assert_allclose(history.ego.x, where.ego.x[begin : begin + SAMPLES], atol=1e-9)
    np.testing.assert_allclose(history.ego.vx, 8.0, atol=1e-9)


def _broken_from(step: int) -> Driver:
    """A planner whose numbers fail from some step on if the ego is fast."""
    good = constant_velocity_driver()

    def plan(scene, given, time, state) -> Driven:
        driven = good.step(scene, given, time, state)
        breaks = (given.observation.step - scene.num_history >= step) & (given.ego.vx > 9.0)
        x = jnp.where(breaks, jnp.nan, driven.plan.x)
        return driven._replace(plan=driven.plan.replace(x=x))

    return Driver("broken", good.init, plan)


def test_a_failing_planner_ends_its_own_scenario_only():
    slow, fast = scene(speed=5.0), scene(speed=10.0)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), slow, fast)
    config = SimulationConfig(num_samples=SAMPLES)
    one = partial(simulate, driver=_broken_from(7), params=SimulationParams(), config=config)
    result = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda s: one(s)))(both))
    np.testing.assert_array_equal(result.failed, [False, True])
    np.testing.assert_array_equal(result.history.valid.sum(axis=1), [SAMPLES, 7])
    assert np.isfinite(result.history.ego.x).all()
    alone = run(slow, _broken_from(7))
    np.testing.assert_allclose(result.history.ego.x[0], alone.history.ego.x, atol=1e-9)


def test_single_precision_stays_single():
    history = run(scene(dtype=jnp.float32), constant_velocity_driver()).history
    assert history.ego.x.dtype == jnp.float32
    np.testing.assert_allclose(np.diff(history.ego.x), 1.0, atol=1e-3)


@pytest.mark.slow
def test_idm_follows_and_stops_behind_the_leader():
    stops = [Thing(roads.EGO_X + 40.0, -3.5), Thing(roads.EGO_X + 20.0, 0.0)]
    raw = roads.road(things=stops, speed=8.0)
    where = roads.scene_of(dataclasses.replace(raw, num_iterations=81))
    config = SimulationConfig(num_samples=80)
    program = jax.jit(
        lambda s: simulate(s, idm_driver(max_path_points=512), SimulationParams(), config)
    )
    result = jax.tree.map(np.asarray, program(where))
    assert not result.failed and not result.overflow
    ego = result.history.ego
    gap = 40.0 - 2.3 - roads.FRONT - ego.x
    assert np.all(gap > 0.5) and gap[-1] < 10.0
    assert ego.vx[-1] < 2.5
    np.testing.assert_allclose(ego.y, ego.y[0], atol=1e-6)
    # The red connector bars the way like a standing object.
    red = roads.road(speed=8.0, red=(1,), ego_x=155.0)
    where = roads.scene_of(dataclasses.replace(red, num_iterations=81))
    ego = jax.tree.map(np.asarray, program(where)).history.ego
    assert np.all(155.0 + ego.x + roads.FRONT < 200.0)
    assert ego.vx[-1] < 2.5


@pytest.mark.slow
def test_pdm_closed_brakes_for_a_slow_leader():
    raw = roads.road(things=[Thing(roads.EGO_X + 22.0, -3.5, speed=3.0)])
    where = roads.scene_of(dataclasses.replace(raw, num_iterations=SAMPLES + 1))
    history = run(where, planner_driver("PDM", roads.PDM.params, roads.PDM.config)).history
    assert history.ego.vx[-1] < 7.0
    gap = history.objects.x[:, 0] - 2.3 - history.ego.x - roads.FRONT
    assert np.all(gap > 0)


@pytest.mark.parametrize(
    "settings", [{"traffic": "wild"}, {"ego": "teleport"}, {"num_samples": 0}, {"replan_every": 0}]
)
def test_bad_settings_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        SimulationConfig(**settings)
