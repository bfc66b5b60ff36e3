"""DTPP on scenes: candidate lanes, reference paths, training trees."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import EGO_X, LANE_WIDTH, LIMIT, Thing, lane_end, observe, parked, road, scene_of
from spdm_jax.simulation.loop import SimulationConfig, SimulationParams, simulate
from spdm_jax.types import ObjectType
from spdm_models import dtpp
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_driver import DTPPDriverConfig, dtpp_driver
from spdm_models.dtpp_planner import (
    TRAINING_LIMIT,
    UNKNOWN_LIMIT,
    DTPPPlannerConfig,
    scene_paths,
    training_tree,
)
from spdm_models.dtpp_tree import TreeConfig
from spdm_models.route_lines import RouteLineConfig, route_lines
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.scene_features import FeatureConfig

LINES = RouteLineConfig(num_lines=4, num_points=401, max_path_points=512)
CONFIG = DTPPPlannerConfig(network=DTPPConfig(), tree=TreeConfig(num_branches=30), lines=LINES)


@jax.jit
def lines_of(scene):
    return route_lines(scene.map, scene.route, observe(scene, 0).ego, LINES)


@jax.jit
def paths_of(scene):
    given = observe(scene, 0)
    return scene_paths(scene.map, scene.route, given.ego, given.observation, CONFIG)


def test_every_lane_beside_the_ego_is_a_candidate():
    scene = scene_of(road(ego_y=-3.0))
    found, ego = lines_of(scene), observe(scene, 0).ego
    assert not bool(found.overflow)
    np.testing.assert_array_equal(found.valid, [True, True, False, False])
    lines = found.line
    np.testing.assert_allclose(np.sort(lines.y[:2, 0]) - ego.y, [-0.5, 3.0], atol=1e-5)
    np.testing.assert_allclose(lines.x[:2, 0], ego.x, atol=1e-5)
    np.testing.assert_allclose(np.diff(lines.x[:2, :400]), 0.25, atol=1e-5)
    np.testing.assert_allclose(lines.heading[:2], 0, atol=1e-5)
    np.testing.assert_array_equal(lines.count[:2], LINES.num_points)


def test_short_lanes_are_left_out_where_there_is_a_longer_one():
    found = lines_of(scene_of(lane_end(length=80.0)))
    assert int(found.valid.sum()) == 2
    assert int(found.line.count.min()) == 1 + 80 * 4
    scene = scene_of(lane_end(length=40.0))
    found, ego = lines_of(scene), observe(scene, 0).ego
    assert int(found.valid.sum()) == 1
    to_the_left = found.line.y[jnp.argmax(found.valid), 0] - ego.y
    assert float(to_the_left) == pytest.approx(LANE_WIDTH)


def test_far_from_the_route_there_is_no_candidate():
    found = lines_of(scene_of(road(ego_y=12.0)))
    assert not bool(found.valid.any())
    assert np.all(np.asarray(found.lane) == -1)
    paths = paths_of(scene_of(road(ego_y=12.0)))
    assert not bool(paths.paths.valid.any())


def test_paths_follow_the_own_lane_unless_something_stands_in_it():
    free = paths_of(scene_of(road()))
    np.testing.assert_allclose(free.paths.course.y[0, 500], 0, atol=1e-3)
    assert float(free.limit) == pytest.approx(LIMIT)
    for thing, blocked in (
        (parked(12.0), True),
        (Thing(EGO_X + 18, -LANE_WIDTH, type=int(ObjectType.TRAFFIC_CONE), length=0.4), True),
        (Thing(EGO_X + 18, -LANE_WIDTH, speed=2.0), False),
        (Thing(EGO_X + 18, -LANE_WIDTH, type=int(ObjectType.PEDESTRIAN), length=0.5), False),
    ):
        found = paths_of(scene_of(road(things=[thing])))
        expected = LANE_WIDTH if blocked else 0
        np.testing.assert_allclose(found.paths.course.y[0, 500], expected, atol=1e-3)
    unlimited = paths_of(scene_of(road(limit=None)))
    assert float(unlimited.limit) == UNKNOWN_LIMIT < TRAINING_LIMIT


@partial(jax.jit, static_argnums=2)
def tree_of(scene, expert, config):
    given = observe(scene, 0)
    found = scene_paths(scene.map, scene.route, given.ego, given.observation, config)
    speed, acceleration = given.ego.vx, given.ego.ax
    return training_tree(found.paths, speed, acceleration, found.limit, expert, config)


def test_training_trees_are_sorted_by_their_distance_to_the_expert():
    scene = scene_of(road())
    time = 0.1 * np.arange(1, 81)
    steady = jnp.asarray(np.stack([10 * time, 0 * time, 0 * time], -1))
    found = jax.tree.map(np.asarray, tree_of(scene, steady, CONFIG))
    assert bool(found.useful)
    assert found.first.shape == found.second.shape == (30, 80, 6)
    assert np.all(found.first[:, 30:] == 0)
    for branches, last, error in (
        (found.first, 29, found.first_error),
        (found.second, 79, found.second_error),
    ):
        real = np.any(branches != 0, axis=(1, 2))
        away = np.hypot(*(branches[real, last, :2] - np.asarray(steady)[last, :2]).T)
        assert np.all(np.diff(away) >= -1e-9)
        assert away[0] == pytest.approx(float(error))
    assert found.first_error < 1.5 and found.second_error < 4
    # Nobody drives backwards in these trees.
    away = tree_of(scene, -steady, CONFIG)
    assert not bool(away.useful)


DRIVER = DTPPDriverConfig(
    planner=DTPPPlannerConfig(
        network=DTPPConfig(EncoderConfig(width=16, heads=2, layers=1)), lines=LINES
    ),
    features=FeatureConfig(lanes=4, crosswalks=1, route_lanes=2),
)


@jax.jit
def drive(scene, params):
    driver = dtpp_driver(params, DRIVER)
    settings = SimulationConfig(num_samples=3, record_plans=True)
    return simulate(scene, driver, SimulationParams(), settings)


@pytest.mark.slow
def test_an_untrained_network_drives_along_the_road():
    params = dtpp.init(DRIVER.planner.network, jax.random.key(1))
    run = drive(scene_of(road(things=[Thing(90.0, -LANE_WIDTH, speed=8.0)]), jnp.float32), params)
    assert not bool(run.failed) and not bool(run.overflow)
    plans = jax.tree.map(np.asarray, run.plans)
    assert plans.x.shape == (3, 81)
    np.testing.assert_allclose(plans.x[:, 0], run.history.ego.x[:3], atol=1e-5)
    assert np.all(np.diff(plans.x, axis=1) > -1e-3)
    assert np.all(np.abs(plans.y - plans.y[0, 0]) < 1.1 * LANE_WIDTH)
    # Off the route there is no path, and the plan is to stand.
    lost = drive(scene_of(road(ego_y=15.0), jnp.float32), params)
    plans = jax.tree.map(np.asarray, lost.plans)
    assert not bool(lost.failed)
    np.testing.assert_allclose(plans.x, np.broadcast_to(plans.x[:, :1], (3, 81)), atol=1e-5)
