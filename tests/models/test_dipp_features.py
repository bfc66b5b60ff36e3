"""DIPP's inputs from a scene: a straight road with known numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import EGO_X, LANE_WIDTH, LIMIT, Thing, road, scene_of
from spdm_jax.config import VehicleParams
from spdm_jax.types import LightStatus, ObjectType
from spdm_models.dipp_features import DIPPFeatureConfig, dipp_features
from spdm_models.scene_encoder import SceneFeatures
from spdm_models.scene_features import FeatureConfig, pick_neighbors, recorded_history
from spdm_models.scene_features import scene_features as base_features

CONFIG = DIPPFeatureConfig(neighbors=3, lanes=3, crosswalks=1, points=80, sequence=4)
BASE = FeatureConfig(neighbors=3, lanes=2, crosswalks=1, route_lanes=1, rearmost=None)
THINGS = (
    Thing(EGO_X + 20, -LANE_WIDTH, speed=4.0),
    Thing(EGO_X + 5, 0.0, type=int(ObjectType.PEDESTRIAN), length=0.6, width=0.6),
)


@jax.jit
def compute(scene, lights):
    now = scene.num_history
    history = recorded_history(scene)
    base = base_features(
        scene.map, scene.route, lights, history, pick_neighbors(history, BASE), BASE
    )
    ego = jax.tree.map(lambda v: v[now], scene.ego)
    return dipp_features(scene.map, lights, ego, base, VehicleParams(), CONFIG)


@pytest.fixture(scope="module")
def scene():
    return scene_of(road(cuts=(100.0, 460.0), things=THINGS, ego_y=-LANE_WIDTH + 0.5))


def features_of(scene, red=None):
    lights = scene.lights[int(scene.num_history)]
    if red is not None:
        lights = lights.at[red].set(int(LightStatus.RED))
    return jax.tree.map(np.asarray, compute(scene, lights))


def test_actors(scene):
    ours = features_of(scene)
    assert ours.ego.shape == (20, 8) and ours.neighbors.shape == (3, 20, 9)
    np.testing.assert_allclose(ours.ego[-1], [0, 0, 0, 10, 0, 5.176, 2.297, 1.777])
    np.testing.assert_allclose(ours.ego[-2, 0], -1)
    # Nearest first; the third is missing.
    walker, car, missing = ours.neighbors
    np.testing.assert_allclose(walker[-1], [5, 3, 0, 0, 0, 0.6, 0.6, 1.75, 2], atol=1e-9)
    np.testing.assert_allclose(car[-1], [20, -0.5, 0, 4, 0, 4.6, 1.9, 1.6, 1], atol=1e-9)
    np.testing.assert_allclose(car[-2, 0], 19.6, atol=1e-9)
    assert not missing.any()


def test_lanes_of_each_actor_start_beside_it_and_run_on(scene):
    lanes = features_of(scene).map_lanes
    assert lanes.shape == (4, 3, 80, 17)
    assert not lanes[3].any()
    own = lanes[0, 0]
    # The road's points lie up to 2 m apart.
    assert abs(own[0, 0]) < 1 and own[0, 0] != 0
    np.testing.assert_allclose(own[:, 1], -0.5, atol=1e-6)
    np.testing.assert_allclose(own[-1, 0], 150, atol=2)
    np.testing.assert_allclose(own[:, 4] - own[:, 7], LANE_WIDTH, atol=1e-6)
    np.testing.assert_allclose(own[:, 9], LIMIT)
    # Lane 1 has a lane on its left only: broken line there, solid on the right.
    assert set(own[:, 11]) == {1} and set(own[:, 12]) == {2}
    # 40 m ahead 6 m of connector.
    inside = (own[:, 0] > 40.5) & (own[:, 0] < 45.5)
    assert np.all(own[inside, 15] == 1) and not own[own[:, 0] < 39, 15].any()
    car = lanes[2, 0]
    assert abs(car[0, 0] - 20) < 1
    walker = lanes[1, 0]
    np.testing.assert_allclose(walker[0, :2], [5, 3], atol=1)


def test_lights_and_stop_points(scene):
    lanes = scene.map.lanes
    red = int(np.argmax(np.asarray(lanes.is_connector) & (np.asarray(lanes.left_neighbor) >= 0)))
    own = features_of(scene, red=red).map_lanes[0, 0]
    marked = own[:, 13] == 4
    assert marked.any() and np.array_equal(marked, own[:, 15] == 1)
    before = np.flatnonzero(own[:, 14])
    assert len(before) == 1 and before[0] + 1 == np.argmax(marked)
    assert not features_of(scene).map_lanes[..., 13:15].any()


def test_roads_without_crosswalks_have_none_and_values_are_finite(scene):
    ours = features_of(scene)
    assert not ours.map_crosswalks.any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(ours))


def test_short_inputs_are_an_error(scene):
    shapes = {
        "ego_past": (5, 7),
        "neighbors_past": (3, 5, 11),
        "lanes": (2, 50, 7),
        "crosswalks": (1, 30, 3),
        "route_lanes": (1, 50, 3),
    }
    few = SceneFeatures(**{name: jnp.zeros(shape) for name, shape in shapes.items()})
    ego = jax.tree.map(lambda v: v[0], scene.ego)
    with pytest.raises(ValueError, match=r"base\.ego_past has 5 rows"):
        dipp_features(scene.map, scene.lights[0], ego, few, VehicleParams(), CONFIG)
