"""Inputs of GameFormer and DTPP from scenes whose numbers are known."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from small_road import EGO_X, LANE_WIDTH, NUM_HISTORY, Thing, moved, observe, road, scene_of
from spdm_jax.io.raw import RawArea
from spdm_jax.types import ObjectType
from spdm_models.scene_features import (
    FeatureConfig,
    next_history,
    pick_neighbors,
    recorded_futures,
    recorded_history,
    scene_features,
)

STEPS = 5
NEAR = FeatureConfig(neighbors=4, lanes=6, crosswalks=2, route_lanes=3)
ALL = dataclasses.replace(NEAR, rearmost=None)
PEDESTRIAN, BICYCLE = int(ObjectType.PEDESTRIAN), int(ObjectType.BICYCLE)
Y = -LANE_WIDTH
THINGS = (
    Thing(EGO_X + 40, Y, speed=8.0, id="far"),
    Thing(EGO_X + 10, Y + 4, speed=1.5, heading=1.2, type=PEDESTRIAN, length=0.6, width=0.5),
    Thing(EGO_X + 12, Y, type=int(ObjectType.TRAFFIC_CONE), id="cone"),
    Thing(EGO_X - 15, Y, speed=10.0, id="behind"),
    Thing(EGO_X + 20, Y - 2, speed=3.0, type=BICYCLE, until=2, id="leaves"),
)


def crossing_road(**kwargs):
    raw = road(things=THINGS, speed=10.0, red=(1,), cuts=(90.0, 460.0), **kwargs)
    zebra = shapely.box(EGO_X + 8, Y - 3, EGO_X + 12, Y + 5)
    raw.map.crosswalks.append(RawArea("zebra", zebra))
    return raw


@partial(jax.jit, static_argnums=(1, 2))
def build(scene, config, iteration=0):
    history = recorded_history(scene, iteration, STEPS)
    neighbors = pick_neighbors(history, config)
    lights = scene.lights[scene.num_history + iteration]
    features = scene_features(scene.map, scene.route, lights, history, neighbors, config)
    futures = recorded_futures(scene, neighbors, iteration, 3, 80)
    return features, neighbors, futures


@pytest.fixture(scope="module")
def scene():
    return scene_of(crossing_road())


@pytest.fixture(scope="module")
def built(scene):
    return jax.tree.map(np.asarray, build(scene, NEAR))


def test_shapes_are_those_the_network_asks_for(built):
    features = built[0]
    features.validate()
    assert features.ego_past.shape == (STEPS, 7)
    assert features.neighbors_past.shape == (4, STEPS, 11)
    assert features.lanes.shape == (6, 50, 7)


def test_ego_history_is_relative_to_now(built):
    past = built[0].ego_past
    # Two steps are recorded before now; before them the ego stays where it was.
    np.testing.assert_allclose(past[:, 0], [-2, -2, -2, -1, 0], atol=1e-6)
    np.testing.assert_allclose(past[-1, :3], 0, atol=1e-6)
    np.testing.assert_allclose(past[:, 3], 10)
    assert NUM_HISTORY == 2


def test_neighbours_come_nearest_first_without_static_objects(built, scene):
    features, neighbors, _ = built
    np.testing.assert_array_equal(neighbors.valid, [True, True, True, False])
    now = features.neighbors_past[:, -1]
    np.testing.assert_allclose(now[:3, :2], [[10, 4], [20, -2], [40, 0]], atol=1e-5)
    np.testing.assert_allclose(now[:3, 8:], np.eye(3)[[1, 2, 0]])
    walk = 1.5 * np.array([np.cos(1.2), np.sin(1.2)])
    np.testing.assert_allclose(now[0, 2:8], [1.2, *walk, 0, 0.6, 0.5], atol=1e-5)
    assert np.all(features.neighbors_past[3] == 0)
    # Earlier than its first record a neighbour has the state that was seen first.
    first = features.neighbors_past[2, :, 0]
    np.testing.assert_allclose(first, [38.4, 38.4, 38.4, 39.2, 40], atol=1e-4)
    everyone = build(scene, ALL)
    np.testing.assert_allclose(everyone[0].neighbors_past[1, -1, :2], [-15, 0], atol=1e-5)
    assert bool(everyone[1].valid.all())


def test_yaw_rate_is_that_of_the_heading():
    raw = road(things=[Thing(EGO_X + 10, Y, speed=1.0, id="turns")])
    turns = 0.3 * 0.1 * np.arange(raw.tracks.pose.shape[1]) + 3.1
    raw.tracks.pose[0, :, 2] = np.arctan2(np.sin(turns), np.cos(turns))
    features, _, _ = build(scene_of(raw), NEAR, 8)
    np.testing.assert_allclose(features.neighbors_past[0, :, 5], 0.3, atol=1e-5)


def test_lanes_are_resampled_over_their_points(built, scene):
    features = built[0]
    centre = scene.map.lanes.centerline
    ego = observe(scene, 0).ego
    found = np.any(features.lanes != 0, axis=(1, 2))
    gaps = np.hypot(features.lanes[..., 0], features.lanes[..., 1]).min(axis=1)[found]
    assert np.all(gaps <= NEAR.radius + 1) and np.all(np.diff(gaps) > -1.0)
    ends = []
    for row in range(int(scene.map.lanes.valid.sum())):
        start, count = int(centre.start[row]), int(centre.count[row])
        points = np.asarray(centre.points)[start : start + count, :2]
        at = np.linspace(0, count - 1, 50)
        x, y = (np.interp(at, np.arange(count), points[:, i]) for i in (0, 1))
        ends.append(np.stack([x - ego.x, y - ego.y], -1))
    for lane in features.lanes[found]:
        assert any(np.allclose(lane[:, :2], line, atol=1e-5) for line in ends)
        np.testing.assert_allclose(lane[:, 2], 0, atol=1e-6)
        np.testing.assert_array_equal(lane[:, 3:].sum(axis=1), 1)
    red = features.lanes[:, 0, 5] == 1
    assert red.sum() == 1
    np.testing.assert_allclose(features.lanes[red][0, [0, -1], 0], [30, 36], atol=1e-5)


def test_crosswalks_are_closed_outlines(built):
    outlines = built[0].crosswalks
    assert np.all(outlines[1] == 0)
    xy = outlines[0, :, :2]
    np.testing.assert_allclose(xy[0], xy[-1], atol=1e-6)
    ring = shapely.box(8, -3, 12, 5).exterior
    assert max(ring.distance(shapely.Point(p)) for p in xy) < 1e-5
    assert {tuple(np.round(p)) for p in xy} >= {(8, -3), (12, 5)}


def test_features_do_not_depend_on_the_frame(built):
    turned = build(scene_of(moved(crossing_road(), 2.2, (300.0, -40.0))), NEAR)
    for name in ("ego_past", "neighbors_past", "lanes", "route_lanes"):
        ours, theirs = (np.array(getattr(f, name)) for f in (turned[0], built[0]))
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    for ours, theirs in zip(turned[2], built[2], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_recorded_futures(built):
    ego, others = built[2]
    time = 0.1 * np.arange(1, 81)
    np.testing.assert_allclose(ego[:, 0], 10 * time, atol=1e-4)
    np.testing.assert_allclose(others[2, :, 0], 40 + 8 * time, atol=1e-4)
    # The cyclist is recorded for a moment only.
    seen = np.any(others[1] != 0, axis=1)
    assert seen[0] and not seen[5:].any()


def test_a_rolling_history_is_the_recorded_one(scene):
    history = recorded_history(scene, 3, STEPS)
    step = jax.jit(next_history)
    for iteration in (4, 5):
        given = observe(scene, iteration)
        history = step(history, given.ego, given.observation)
    expected = recorded_history(scene, 5, STEPS)
    jax.tree.map(np.testing.assert_array_equal, history, expected)


def test_an_empty_world_has_empty_features():
    scene = scene_of(road())
    lonely = scene.replace(map=scene.map)
    far = jax.tree.map(lambda v: v, lonely.ego)
    far = far.replace(x=far.x + 900, y=far.y + 900)
    features, neighbors, _ = build(lonely.replace(ego=far), NEAR)
    assert not bool(jnp.any(neighbors.valid))
    for name in ("neighbors_past", "lanes", "crosswalks", "route_lanes"):
        assert np.all(np.asarray(getattr(features, name)) == 0), name
