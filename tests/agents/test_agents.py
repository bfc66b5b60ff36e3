"""What the planner sees, and where it believes the objects will be."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.agents.forecast import (
    ForecastPoses,
    assemble,
    constant_velocity,
    perfect,
    supplied,
)
from spdm_jax.agents.observation import Observation, SelectedObjects, select_objects
from spdm_jax.config import PlannerConfig
from spdm_jax.types import ObjectType, Tracks

NUM = 40
CONFIG = PlannerConfig(max_vehicles=5, max_pedestrians=3, max_bicycles=2, max_static=4)
EVERYONE = SelectedObjects(track=jnp.arange(NUM, dtype=jnp.int32), valid=jnp.ones(NUM, bool))

_select = jax.jit(select_objects, static_argnames="config")
_constant = jax.jit(constant_velocity)
_perfect = jax.jit(perfect)


def random_observation(seed: int) -> Observation:
    rng = np.random.default_rng(seed)
    number = lambda low, high: jnp.asarray(rng.uniform(low, high, NUM))
    return Observation(
        x=number(-60, 60),
        y=number(-60, 60),
        heading=number(-3, 3),
        vx=number(-9, 9),
        vy=number(-9, 9),
        length=number(0.5, 5),
        width=number(0.5, 2),
        type=jnp.asarray(rng.integers(0, 7, NUM), jnp.int32),
        valid=jnp.asarray(rng.random(NUM) < 0.8),
        lights=jnp.zeros(3, jnp.int8),
        step=jnp.asarray(4, jnp.int32),
    )


@given(st.integers(0, 2**32 - 1), st.sampled_from([20.0, 50.0, 200.0]))
def test_nearest_objects_of_each_class_in_order(seed: int, radius: float):
    seen = random_observation(seed)
    excluded = np.random.default_rng(seed + 1).random(NUM) < 0.1
    found = _select(
        seen, jnp.asarray(3.0), jnp.asarray(-2.0), jnp.asarray(excluded), radius, CONFIG
    )
    distance = np.hypot(np.asarray(seen.x) - 3.0, np.asarray(seen.y) + 2.0)
    kind, valid = np.asarray(seen.type), np.asarray(seen.valid)
    expected: list[int] = []
    for kinds, cap in (((3, 4, 5, 6), 4), ((0,), 5), ((1,), 3), ((2,), 2)):
        rows = [
            i
            for i in np.argsort(distance, kind="stable")
            if kind[i] in kinds and valid[i] and not excluded[i] and distance[i] <= radius
        ]
        expected += rows[:cap]
    assert found.track.shape == (CONFIG.max_objects,)
    assert np.asarray(found.track)[np.asarray(found.valid)].tolist() == expected
    assert not np.asarray(found.valid)[len(expected) :].any()


@given(st.integers(0, 2**32 - 1))
def test_constant_velocity_moves_along_the_box_axis(seed: int):
    seen = random_observation(seed)
    poses = _constant(seen, EVERYONE)
    for i in range(NUM):
        h, v = float(seen.heading[i]), np.array([float(seen.vx[i]), float(seen.vy[i])])
        axis = np.array([np.cos(h), np.sin(h)])
        speed = np.linalg.norm(v) * (1 if v @ axis > 0 else -1)
        if seen.type[i] > ObjectType.BICYCLE:
            speed = 0.0
        way = speed * 0.2 * np.arange(41)
        np.testing.assert_allclose(poses.x[i], float(seen.x[i]) + way * axis[0], atol=1e-9)
        np.testing.assert_allclose(poses.y[i], float(seen.y[i]) + way * axis[1], atol=1e-9)
        np.testing.assert_array_equal(poses.heading[i], h)
    assert np.asarray(poses.valid).all()


def recording(seed: int, steps: int = 60) -> Tracks:
    rng = np.random.default_rng(seed)
    shape = (NUM, steps)
    number = lambda: jnp.asarray(rng.normal(0, 20, shape))
    return Tracks(
        **{name: number() for name in ("x", "y", "heading", "vx", "vy", "length", "width")},
        valid=jnp.asarray(rng.random(shape) < 0.7),
        type=jnp.asarray(rng.integers(0, 7, NUM), jnp.int32),
    )


def test_perfect_forecast_is_the_recording():
    tracks = recording(0)
    seen = random_observation(0).replace(type=tracks.type)
    poses = _perfect(seen, EVERYONE, tracks)
    agent = np.asarray(tracks.type) <= ObjectType.BICYCLE
    assert 0 < agent.sum() < NUM
    for sample in range(41):
        step = 4 + 2 * sample
        here = sample == 0 or ~agent
        for name in ("x", "y", "heading"):
            now = np.asarray(getattr(seen, name))
            then = np.asarray(getattr(tracks, name))[:, min(step, 59)]
            ours = np.asarray(getattr(poses, name))[:, sample]
            np.testing.assert_array_equal(ours, np.where(here, now, then))
        recorded = step < 60 and np.asarray(tracks.valid)[:, min(step, 59)]
        np.testing.assert_array_equal(np.asarray(poses.valid)[:, sample], here | recorded)


def test_supplied_forecast_is_picked_by_track():
    rows = jnp.arange(NUM, dtype=jnp.float64)[:, None] * jnp.ones(41)
    poses = ForecastPoses(rows, rows + 0.5, -rows, rows < 30)
    chosen = SelectedObjects(
        track=jnp.asarray([7, 33, 2], jnp.int32), valid=jnp.asarray([True, True, False])
    )
    picked = supplied(poses, chosen)
    np.testing.assert_array_equal(picked.x[:, 3], [7, 33, 2])
    np.testing.assert_array_equal(picked.y[:, 3], [7.5, 33.5, 2.5])
    np.testing.assert_array_equal(picked.valid[:, 0], [True, False, True])


@pytest.mark.parametrize("hide", [False, True])
def test_hidden_agents_are_gone_and_static_objects_stay(hide: bool):
    seen = random_observation(3)
    poses = _constant(seen, EVERYONE)
    touching = jnp.arange(NUM) % 2 == 0
    forecast = jax.jit(partial(assemble, hide_agents=hide))(seen, EVERYONE, poses, touching)
    agent = np.asarray(seen.type) <= ObjectType.BICYCLE
    np.testing.assert_array_equal(forecast.is_agent, agent)
    np.testing.assert_array_equal(forecast.valid, ~agent if hide else np.ones(NUM, bool))
    np.testing.assert_array_equal(
        forecast.ignored, np.asarray(touching) & np.asarray(forecast.valid)
    )
    speed = np.hypot(np.asarray(seen.vx), np.asarray(seen.vy))
    np.testing.assert_allclose(forecast.speed, np.where(agent, speed, 0))
