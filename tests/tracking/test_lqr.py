"""Tracker and bicycle: the closed form against a plain loop written from the description."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_jax.config import DT, TrackerParams, VehicleParams
from spdm_jax.tracking.lqr import bicycle_step, reference_profiles, track
from spdm_jax.types import EgoState

FIELDS = tuple(EgoState.__dataclass_fields__)
VEHICLE, PARAMS = VehicleParams(), TrackerParams()
WHEEL_BASE = 3.089

_track = jax.jit(track, static_argnames="tracker")
_step = jax.jit(bicycle_step)
_profiles = jax.jit(partial(reference_profiles, tracker="reference"))


def state_of(array: np.ndarray, dtype=jnp.float64) -> EgoState:
    return EgoState(**{name: jnp.asarray(array[..., i], dtype) for i, name in enumerate(FIELDS)})


def array_of(state: EgoState) -> np.ndarray:
    return np.stack([np.asarray(getattr(state, name)) for name in FIELDS], -1)


def wrap(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def random_case(seed: int, num: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Reference poses `[P, 41, 3]` and initial states `[P, 11]`; some stand, some creep."""
    rng = np.random.default_rng(seed)
    v0 = rng.uniform(0, 15, num)
    v0[:6] = [0, 0, 0.01, 0.15, 0.3, -0.1]
    speed = np.maximum(v0[:, None] + rng.uniform(-2, 2, (num, 1)) * DT * np.arange(41), 0)
    speed[0] = 0
    heading = rng.uniform(-4, 4, (num, 1)) + np.cumsum(
        DT * speed * rng.uniform(-0.08, 0.08, (num, 1)), axis=1
    )
    x = np.cumsum(DT * speed * np.cos(heading), axis=1)
    y = np.cumsum(DT * speed * np.sin(heading), axis=1)
    state = np.zeros((num, 11))
    state[:, 0] = x[:, 0] + rng.normal(0, 0.5, num)
    state[:, 1] = y[:, 0] + rng.normal(0, 0.5, num)
    state[:, 2] = wrap(heading[:, 0] + rng.normal(0, 0.1, num))
    state[:, 3] = v0
    state[:, 5] = rng.uniform(-2, 2, num)
    state[:, 7] = rng.uniform(-0.3, 0.3, num)
    return np.stack([x, y, heading], -1), state


def command(state: np.ndarray, k: int, pose, speed, curvature) -> tuple[float, float]:
    """Ten explicit steps for one vehicle, as the controller is described."""
    r = min(k + 10, 39)
    v, v_ref = state[3], speed[r]
    if v_ref <= 0.2 and v <= 0.2:
        return -0.5 * (v - v_ref), 0.0
    accel = -10 * (v - v_ref) / 11
    window = [*curvature[k:r], *[curvature[r]] * (10 - (r - k))]
    xr, yr, hr = pose[k]
    a, b, g = np.eye(3), np.zeros(3), np.zeros(3)
    for i in range(10):
        v_i = v + DT * i * accel
        step = np.eye(3)
        step[0, 1], step[1, 2] = DT * v_i, DT * v_i / WHEEL_BASE
        a, b = step @ a, step @ b + [0, 0, DT]
        g = step @ g + [0, -DT * v_i * window[i], 0]
    start = np.array(
        [
            -(state[0] - xr) * np.sin(hr) + (state[1] - yr) * np.cos(hr),
            wrap(state[2] - hr),
            state[7],
        ]
    )
    z = a @ start + g
    z[1:] = wrap(z[1:])
    q = np.diag([1.0, 10.0, 0.0])
    return accel, float(-(b @ q @ z) / (b @ q @ b + 1.0))


def bicycle(state: np.ndarray, accel: float, rate: float, wheel_base: float) -> np.ndarray:
    """One step of the kinematic bicycle with first-order lags."""
    x, y, heading, v, _, a, _, delta, _, yaw_rate, _ = state
    a = a + 0.1 / 0.3 * (accel - a)
    ideal = delta + 0.1 / 0.15 * (0.1 * rate)
    actual = (ideal - delta) / 0.1
    turned = (heading + 0.1 * v * np.tan(delta) / wheel_base + np.pi) % (2 * np.pi) - np.pi
    speed = v + 0.1 * a
    steering = np.clip(ideal, -np.pi / 3, np.pi / 3)
    new_rate = speed * np.tan(steering) / wheel_base
    return np.array(
        [
            x + 0.1 * v * np.cos(heading),
            y + 0.1 * v * np.sin(heading),
            turned,
            speed,
            0,
            a,
            0,
            steering,
            actual,
            new_rate,
            (new_rate - yaw_rate) / 0.1,
        ]
    )


def test_tracking_equals_a_plain_loop():
    pose, start = random_case(0)
    arrays = [jnp.asarray(pose[..., i]) for i in range(3)]
    states, commands = _track(*arrays, state_of(start), VEHICLE, PARAMS, tracker="reference")
    speed, curvature = (np.asarray(v) for v in _profiles(*arrays))
    ours, sent = array_of(states), np.asarray(commands)
    stopping = 0
    for p in range(len(pose)):
        state = start[p]
        for k in range(40):
            accel, rate = command(state, k, pose[p], speed[p], curvature[p])
            stopping += rate == 0.0
            np.testing.assert_allclose(sent[p, k], [accel, rate], atol=1e-8)
            state = bicycle(state, accel, rate, WHEEL_BASE)
            expected = ours[p, k + 1].copy()
            expected[2] = state[2] + wrap(expected[2] - state[2])
            np.testing.assert_allclose(expected, state, atol=1e-8)
    assert 40 < stopping < 20 * 40  # both branches were taken


def test_initial_state_is_kept_and_shared():
    pose, start = random_case(1)
    arrays = [jnp.asarray(pose[..., i]) for i in range(3)]
    one = state_of(start[5])
    states, _ = _track(*arrays, one, VEHICLE, PARAMS, tracker="reference")
    np.testing.assert_array_equal(
        array_of(states)[:, 0], np.broadcast_to(start[5], (len(pose), 11))
    )


def test_trackers_differ():
    pose, start = random_case(2)
    arrays = [jnp.asarray(pose[..., i]) for i in range(3)]
    results = [
        array_of(_track(*arrays, state_of(start), VEHICLE, PARAMS, tracker=name)[0])
        for name in ("reference", "corrected")
    ]
    gap = np.abs(results[0][..., 3] - results[1][..., 3])
    assert 1e-3 < gap.max() < 1.0


def test_float32_follows_float64():
    pose, start = random_case(3)
    results = {}
    for dtype in (jnp.float32, jnp.float64):
        arrays = [jnp.asarray(pose[..., i], dtype) for i in range(3)]
        states, _ = _track(*arrays, state_of(start, dtype), VEHICLE, PARAMS, tracker="reference")
        assert states.x.dtype == dtype
        results[dtype] = array_of(states)
    low, high = results[jnp.float32], results[jnp.float64]
    np.testing.assert_allclose(low[..., :2], high[..., :2], atol=2e-3)
    np.testing.assert_allclose(wrap(low[..., 2] - high[..., 2]), 0, atol=1e-3)
    np.testing.assert_allclose(low[..., 3], high[..., 3], atol=2e-3)


@pytest.mark.parametrize("wheel_base", [3.089, 2.5])
def test_bicycle_step(wheel_base: float):
    rng = np.random.default_rng(4)
    states = rng.normal(size=(64, 11)) * [10, 10, 3, 5, 1, 2, 1, 0.4, 1, 0.5, 1]
    states[:8, 7] = np.pi / 3 - 1e-3  # against the steering stop
    accel, rate = rng.normal(size=(2, 64)) * [[3], [2]]
    rate[:8] = 1.0
    vehicle = VehicleParams(wheel_base=wheel_base)
    after = _step(state_of(states), jnp.asarray(accel), jnp.asarray(rate), vehicle, PARAMS)
    expected = np.stack(
        [bicycle(s, a, r, wheel_base) for s, a, r in zip(states, accel, rate, strict=False)]
    )
    np.testing.assert_allclose(array_of(after), expected, atol=1e-10)
    np.testing.assert_allclose(np.asarray(after.steering)[:8], np.pi / 3, atol=1e-12)
    assert np.all(np.asarray(after.steering_rate)[:8] > 0.6)  # the rate itself is not clipped


def test_tracker_keeps_its_own_wheel_base():
    pose, start = random_case(5)
    arrays = [jnp.asarray(pose[..., i]) for i in range(3)]
    _, usual = _track(*arrays, state_of(start), VEHICLE, PARAMS, tracker="reference")
    other = VehicleParams(wheel_base=2.0)
    _, commands = _track(*arrays, state_of(start), other, PARAMS, tracker="reference")
    # The first command sees the same state; the motion that follows differs.
    np.testing.assert_array_equal(np.asarray(commands)[:, 0], np.asarray(usual)[:, 0])
    assert np.abs(np.asarray(commands) - np.asarray(usual)).max() > 1e-3
