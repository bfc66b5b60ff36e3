"""DIPP's planner behind GameFormer: fitted controls, the centre line of a scene, refined plans."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from small_road import LIMIT, road, scene_of
from spdm_jax.config import VehicleParams
from spdm_jax.types import LightStatus
from spdm_models.dipp_on_gameformer import (
    DIPPRefinerConfig,
    center_path,
    even_weights,
    fit_controls,
    refine_plan,
    with_headings,
)
from spdm_models.dipp_planner import WHEELBASE, DIPPPlannerConfig
from spdm_models.gameformer import rollout
from spdm_models.gauss_newton import GaussNewtonConfig

STEPS, AGENTS = 20, 2
CONFIG = DIPPRefinerConfig(
    problem=DIPPPlannerConfig(horizon=STEPS, safety_steps=(0, 9, 19)),
    solver=GaussNewtonConfig(iterations=15, step_size=0.4, result="best"),
    max_path_points=512,
)

_rollout = jax.jit(rollout)
_fit = jax.jit(fit_controls)
_center = jax.jit(partial(center_path, config=CONFIG))
_refine = jax.jit(partial(refine_plan, config=CONFIG, vehicle=VehicleParams()))


def ego_past(speed: float) -> jax.Array:
    return jnp.zeros((3, 7)).at[:, 3].set(speed)


@given(st.integers(0, 1000), st.floats(2, 20))
def test_fitted_controls_are_those_of_a_driven_plan(seed, speed):
    random = np.random.default_rng(seed)
    driven = np.stack([random.uniform(-1, 1, STEPS), random.uniform(-0.1, 0.1, STEPS)], -1)
    poses = _rollout(ego_past(speed)[-1], jnp.asarray(driven))
    ours = np.asarray(_fit(poses, jnp.asarray(speed)))
    np.testing.assert_allclose(ours[:, 0], driven[:, 0], atol=1e-8)
    fast = speed + 0.1 * np.cumsum(driven[:, 0]) > 0.5
    np.testing.assert_allclose(ours[fast, 1], WHEELBASE * driven[fast, 1], atol=1e-8)
    still = _fit(jnp.zeros((STEPS, 3)), jnp.zeros(()))
    assert not np.any(still)


def test_headings_follow_the_steps_and_stay_while_standing():
    xy = jnp.array([[0.0, 0.01], [1.0, 0.01], [1.0, 1.01], [1.01, 1.01]])
    poses = with_headings(xy)
    np.testing.assert_allclose(poses[:, 2], [0, 0, np.pi / 2, np.pi / 2])
    np.testing.assert_array_equal(poses[:, :2], xy)


@pytest.fixture(scope="module")
def scene():
    """The ego's lane is row 1 and starts 10 m behind it; its connectors are rows 3 and 7."""
    return scene_of(road(blocks=((0, 1), (0, 1)), cuts=(40.0, 70.0), ego_x=10.0, ego_y=-3.0))


def center_of(scene, red=()):
    now = int(scene.num_history)
    ego = jax.tree.map(lambda v: v[now], scene.ego)
    lights = scene.lights[now]
    for lane in red:
        lights = lights.at[lane].set(int(LightStatus.RED))
    return _center(scene.map, scene.route, jnp.asarray(1, jnp.int32), lights, ego)


def test_the_centre_line_of_a_scene(scene):
    center = center_of(scene, red=(3,))
    assert not bool(center.overflow)
    path, info = np.asarray(center.path), np.asarray(center.info)
    np.testing.assert_allclose(path[200], [0, -0.5, 0], atol=1e-9)
    # Straight on behind its start, held at its end 60 m ahead.
    np.testing.assert_allclose(path[:801, 0], 0.1 * (np.arange(801) - 200), atol=1e-4)
    np.testing.assert_allclose(path[801:, 0], 60, atol=1e-9)
    # The connector spans 30 m to 36 m ahead.
    assert set(np.flatnonzero(info == 0)) == set(range(500, 560))
    np.testing.assert_allclose(info[info > 0], LIMIT)
    assert np.all(np.asarray(center_of(scene).info) == LIMIT)


def refine(scene, agent_x, red=(), speed=8.0, present=True):
    futures = np.full((AGENTS, STEPS, 2), 0.0)
    futures[0] = (agent_x, -0.5)
    past = np.zeros((AGENTS, 3, 11))
    past[0, :, [0, 6, 7]] = np.array([agent_x, 4.6, 2.0])[:, None] * present
    plan = np.zeros((STEPS, 3))
    plan[:, 0] = 0.1 * speed * np.arange(1, STEPS + 1)
    center, weights = center_of(scene, red), even_weights(jnp.float64)
    return plan, _refine(plan, futures, ego_past(speed), past, center, weights)


def test_plans_move_to_the_centre_line_and_brake_for_agents_and_lights(scene):
    plan, free = refine(scene, agent_x=500.0)
    assert float(free.objective) < float(free.first_objective)
    # Half a metre to the right, and faster: the limit is 13.4 m/s.
    assert -0.6 < float(free.poses[-1, 1]) < -0.2
    assert float(free.poses[-1, 0]) > plan[-1, 0]
    _, behind_agent = refine(scene, agent_x=14.0)
    assert float(behind_agent.poses[-1, 0]) < float(free.poses[-1, 0]) - 1
    _, at_light = refine(scene, agent_x=500.0, red=(3,), speed=20.0)
    assert float(at_light.poses[-1, 0]) < 40 - 3
    _, missing = refine(scene, agent_x=14.0, present=False)
    np.testing.assert_allclose(missing.poses, free.poses, atol=1e-9)


def test_modes_are_refined_in_one_batch(scene):
    plan, one = refine(scene, agent_x=14.0)
    center, weights = center_of(scene), even_weights(jnp.float64)
    past = (
        jnp.zeros((AGENTS, 3, 11))
        .at[0, :, jnp.array([0, 6, 7])]
        .set(jnp.array([[14.0], [4.6], [2.0]]))
    )
    futures = jnp.zeros((AGENTS, STEPS, 2)).at[0].set(jnp.array([14.0, -0.5]))
    plans = jnp.stack([jnp.asarray(plan), 0.5 * plan])
    many = jax.vmap(_refine, (0, None, None, None, None, None))(
        plans, futures, ego_past(8.0), past, center, weights
    )
    np.testing.assert_allclose(many.poses[0], one.poses, atol=1e-6)
    assert many.controls.shape == (2, STEPS, 2)


def test_weights_before_training_are_shares_of_the_softmax():
    weights = np.asarray(even_weights())
    np.testing.assert_allclose(weights[:7] / (1, 1, 1, 1, 1, 10, 100), 1 / 9, rtol=1e-6)
    assert weights[7:].tolist() == [10, 10]
    assert hash(CONFIG) and DIPPRefinerConfig().problem.horizon == 80
