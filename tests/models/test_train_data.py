"""Training samples: what they hold, which start times give one, how they are stored."""

import dataclasses

import jax
import numpy as np
import pytest

from small_road import NUM_ITERATIONS, PADDING, scene_of
from spdm_jax import api
from spdm_models.scene_features import pick_neighbors, recorded_history, scene_features
from spdm_models.train_data import (
    STARTS_PER_CALL,
    SampleMaker,
    concatenate,
    count,
    from_leaves,
    leaves_of,
    take,
)
from training_roads import NEIGHBORS, raw_roads, road_samples, small_task

TASK = small_task("gameformer")


@pytest.fixture(scope="module")
def made():
    return road_samples(TASK, stride=2)


def test_every_scenario_gives_a_sample_per_stride(made):
    samples, rows = made
    starts = NUM_ITERATIONS // 2
    # More than one call's worth of start times.
    assert starts > STARTS_PER_CALL
    np.testing.assert_array_equal(np.bincount(rows), np.full(8, starts))
    assert count(samples) == 8 * starts
    assert samples.ego.shape == (80, 80, 3) and samples.neighbors.shape == (80, NEIGHBORS, 80, 3)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(samples))


def test_a_sample_is_what_the_network_would_see_then(made):
    samples, rows = made
    scene, iteration = scene_of(raw_roads()[3]), 6
    history = recorded_history(scene, iteration)
    config = TASK.sample.features
    neighbors = pick_neighbors(history, config)
    lights = scene.lights[scene.num_history + iteration]
    expected = scene_features(scene.map, scene.route, lights, history, neighbors, config)
    ours = take(samples, np.flatnonzero(rows == 3)[iteration // 2 : iteration // 2 + 1]).features
    for name, value in vars(expected).items():
        np.testing.assert_allclose(getattr(ours, name)[0], value, atol=2e-4, err_msg=name)
    # Training keeps who is behind the ego.
    first = take(samples, np.flatnonzero(rows == 0)[:1])
    assert first.features.neighbors_past[0, 0, -1, 0] < -6


def test_targets_are_what_happened_next(made):
    samples, rows = made
    time = 0.1 * np.arange(1, 81)
    one = take(samples, np.flatnonzero(rows == 2)[:1])
    np.testing.assert_allclose(one.ego[0, :, 0], 4 * time, atol=1e-3)
    now = one.features.neighbors_past[0, :2, -1]
    for driven, start in zip(one.neighbors[0, :2], now, strict=True):
        np.testing.assert_allclose(driven[:, 0], start[0] + start[3] * time, atol=1e-3)
    assert not one.neighbors[0, 2:].any()


def test_a_start_time_without_the_whole_future_gives_none():
    batch = api.from_raw(raw_roads()[:2], padding=PADDING).batch
    valid = np.array(batch.ego_valid)
    known = int(batch.num_history[1]) + 10 + 80
    valid[1, known + 1 :] = False
    samples, rows = SampleMaker(TASK.sample, 2)(batch.replace(ego_valid=valid))
    np.testing.assert_array_equal(np.bincount(rows), [10, 6])
    assert count(samples) == 16
    valid[:, 50:] = False
    samples, _ = SampleMaker(TASK.sample, 2)(batch.replace(ego_valid=valid))
    assert count(samples) == 0


def test_samples_are_stored_and_read(made):
    samples, _ = made
    again = from_leaves(leaves_of(samples), "gameformer")
    assert jax.tree.structure(again) == jax.tree.structure(samples)
    jax.tree.map(np.testing.assert_array_equal, again, samples)
    assert "features.ego_past" in leaves_of(samples)
    twice = concatenate([take(samples, np.array([1])), take(samples, np.array([0]))])
    np.testing.assert_array_equal(twice.ego, samples.ego[[1, 0]])


def test_a_stride_is_a_number_of_steps():
    with pytest.raises(ValueError, match="the stride is 0 steps"):
        SampleMaker(TASK.sample, 0)


@pytest.mark.slow
def test_trees_and_centre_lines_are_part_of_samples():
    tree, rows = road_samples(small_task("dtpp"))
    assert len(rows) == 8 and tree.first.shape == tree.second.shape == (8, 30, 80, 6)
    ends = np.hypot(*(tree.second[:, :, -1, :2] - tree.ego[:, None, -1, :2]).transpose(2, 0, 1))
    real = tree.second.any(axis=(2, 3))
    assert np.all(ends[:, 0] < 4)
    assert np.all(ends[:, 0] <= np.where(real, ends, np.inf).min(axis=1) + 1e-5)
    lines, _ = road_samples(small_task("dipp"))
    assert lines.ego.shape == (8, 50, 3) and lines.features.map_lanes.shape[1:3] == (
        1 + NEIGHBORS,
        2,
    )
    np.testing.assert_allclose(lines.path[:, 200, :2], 0, atol=0.06)
    np.testing.assert_allclose(lines.info, 13.4, rtol=1e-5)
    both, _ = road_samples(small_task("gameformer-dipp"))
    np.testing.assert_allclose(both.path, lines.path, atol=1e-4)
    lost = api.from_raw(raw_roads()[:1], padding=PADDING).batch
    route = lost.route.replace(
        lane_on_route=np.zeros_like(lost.route.lane_on_route),
        slot_of_lane=np.full_like(lost.route.slot_of_lane, -1),
    )
    for name in ("dtpp", "dipp"):
        maker = SampleMaker(small_task(name).sample, 20)
        assert count(maker(dataclasses.replace(lost, route=route))[0]) == 0
