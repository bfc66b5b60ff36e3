"""Reference profiles of the tracker: the fits against plain least squares, and standstill."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_jax.config import DT, Tracker
from spdm_jax.tracking.profiles import curvature_profile, speed_fit_matrix, speed_profile

STEPS = 40
TRACKERS: tuple[Tracker, ...] = ("reference", "corrected")

_speed = jax.jit(speed_profile, static_argnames="tracker")
_curvature = jax.jit(curvature_profile)


def drive(speed: np.ndarray, yaw_rate: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact poses `[P, 41]` of the discrete model that both fits assume."""
    heading = np.concatenate([np.zeros((len(speed), 1)), np.cumsum(DT * yaw_rate, 1)], 1)
    way = DT * speed
    x = np.concatenate([np.zeros((len(way), 1)), np.cumsum(way * np.cos(heading[:, :-1]), 1)], 1)
    y = np.concatenate([np.zeros((len(way), 1)), np.cumsum(way * np.sin(heading[:, :-1]), 1)], 1)
    return x, y, heading


def random_drives(seed: int, num: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    accel = rng.uniform(-2, 2, (num, 1)) * np.sin(np.linspace(0, rng.uniform(1, 8), STEPS))
    speed = np.maximum(rng.uniform(0, 15, (num, 1)) + np.cumsum(DT * accel, 1), 0)
    x, y, heading = drive(speed, speed * rng.uniform(-0.1, 0.1, (num, 1)))
    return x + rng.normal(0, 0.01, x.shape), y + rng.normal(0, 0.01, y.shape), heading


@pytest.mark.parametrize("tracker", TRACKERS)
def test_speed_fit_solves_the_normal_equations(tracker: Tracker):
    x, y, heading = random_drives(0)
    # Unknowns: v_0, a_0 ... a_38. Row i says DT v_i = displacement i along the heading.
    design = np.zeros((STEPS, STEPS))
    for i in range(STEPS):
        design[i, 0] = DT
        design[i, 1 : i + 1] = DT * DT
    jerk = np.zeros((STEPS - 2, STEPS))
    for i in range(STEPS - 2):
        jerk[i, i + 1] = -1.0
        if tracker == "corrected":
            jerk[i, i + 2] = 1.0
    if tracker == "reference":
        # The published code meant to put +1 beside every -1, and sets one corner only.
        jerk[-1, -1] = 1.0
    along = np.diff(x) * np.cos(heading[:, :-1]) + np.diff(y) * np.sin(heading[:, :-1])
    penalised = np.concatenate([design, 1e-2 * jerk])
    target = np.concatenate([along.T, np.zeros((STEPS - 2, len(x)))])
    solution = np.linalg.lstsq(penalised, target, rcond=None)[0]
    expected = (design @ solution / DT).T
    arrays = [jnp.asarray(v) for v in (x, y, heading)]
    np.testing.assert_allclose(_speed(*arrays, tracker=tracker), expected, atol=1e-8)
    single = _speed(*(v.astype(jnp.float32) for v in arrays), tracker=tracker)
    np.testing.assert_allclose(single, expected, atol=2e-3)


def test_corrected_fit_follows_a_smooth_start_better():
    # From rest to 8 m/s in 4 s with a smooth acceleration.
    t = np.arange(STEPS) / STEPS
    speed = 8.0 * (3 * t**2 - 2 * t**3)[None]
    arrays = [jnp.asarray(v) for v in drive(speed, np.zeros_like(speed))]
    error = {
        name: float(np.abs(np.asarray(_speed(*arrays, tracker=name)) - speed).max())
        for name in TRACKERS
    }
    assert error["corrected"] < 0.5 * error["reference"]
    assert error["reference"] > 1e-3
    assert not np.allclose(
        speed_fit_matrix(STEPS, "reference"), speed_fit_matrix(STEPS, "corrected"), atol=1e-3
    )


@pytest.mark.parametrize("tracker", TRACKERS)
def test_constant_speed_is_kept(tracker: Tracker):
    speed = np.full((1, STEPS), 8.0)
    arrays = [jnp.asarray(v) for v in drive(speed, np.zeros_like(speed))]
    np.testing.assert_allclose(_speed(*arrays, tracker=tracker), speed, atol=1e-6)


def test_curvature_fit_solves_the_normal_equations():
    rng = np.random.default_rng(1)
    speed = rng.uniform(0.5, 15, (20, STEPS))
    heading = np.cumsum(rng.normal(0, 0.05, (20, STEPS + 1)), axis=1) + 3.0
    ours = np.asarray(_curvature(jnp.asarray(heading), jnp.asarray(speed)))
    # Unknowns: k_0 and the curvature rates; k_i = k_0 + DT sum of rates.
    to_curvature = np.concatenate(
        [np.ones((STEPS, 1)), DT * np.tril(np.ones((STEPS, STEPS - 1)), -1)], 1
    )
    penalty = np.sqrt(np.diag([1e-10, *[1e-2] * (STEPS - 1)]))
    for row in range(len(speed)):
        design = DT * speed[row][:, None] * to_curvature
        turn = np.diff(heading[row])
        stacked = np.concatenate([design, penalty])
        target = np.concatenate([turn, np.zeros(STEPS)])
        solution = np.linalg.lstsq(stacked, target, rcond=None)[0]
        np.testing.assert_allclose(ours[row], to_curvature @ solution, atol=1e-9)


@pytest.mark.parametrize("speed", [0.0, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-4])
def test_curvature_of_slow_vehicles_is_small_and_precise_in_float32(speed: float, noise: float):
    rng = np.random.default_rng(7)
    heading = 3.1 + rng.uniform(-noise, noise, (16, STEPS + 1))
    fitted = np.full((16, STEPS), speed) * rng.uniform(0.5, 1.5, (16, 1))
    # What float32 cannot tell apart is no fault of the fit: both see the rounded headings.
    single = np.float32(heading), np.float32(fitted)
    low = np.asarray(_curvature(*(jnp.asarray(v) for v in single)))
    high = np.asarray(_curvature(*(jnp.asarray(v, jnp.float64) for v in single)))
    assert low.dtype == np.float32
    assert np.isfinite(low).all()
    assert np.abs(low).max() < 1.0
    np.testing.assert_allclose(low, high, atol=1e-4, rtol=1e-3)


def test_heading_steps_over_pi_are_small_turns():
    heading = np.linspace(3.0, 3.4, STEPS + 1)[None]
    wrapped = np.arctan2(np.sin(heading), np.cos(heading))
    speed = np.full((1, STEPS), 5.0)
    np.testing.assert_allclose(
        _curvature(jnp.asarray(wrapped), jnp.asarray(speed)),
        _curvature(jnp.asarray(heading), jnp.asarray(speed)),
        atol=1e-12,
    )
