"""Connecting curve and speed profile of stage 2 against closed forms."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.config import SplineParams
from spdm_jax.geometry import make_path
from spdm_jax.proposals.spline import (
    CURVE_POINTS,
    RouteLanePaths,
    bezier,
    cubic_distance,
    cubic_speed,
    drive,
)
from spdm_jax.types import EgoState

NUM = 81
speeds = st.floats(0, 20)
accels = st.floats(-8, 3)

_bezier = jax.jit(bezier, static_argnames="num")
_distance = jax.jit(cubic_distance, static_argnames="num_states")
_drive = jax.jit(drive, static_argnames="num_states")


def distance(v0: float, a0: float, target: float, horizon: float) -> np.ndarray:
    values = (jnp.asarray(v, jnp.float64) for v in (v0, a0, target, horizon))
    return np.asarray(_distance(*values, num_states=NUM))


def speed_at(t: np.ndarray, v0: float, a0: float, target: float, horizon: float) -> np.ndarray:
    """The profile from its four conditions, by a linear solve; held beyond the horizon."""
    h = horizon
    conditions = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [1, h, h**2, h**3], [0, 1, 2 * h, 3 * h**2]])
    c = np.linalg.solve(conditions, [v0, a0, target, 0])
    return np.where(t <= h, np.polynomial.polynomial.polyval(np.minimum(t, h), c), target)


def exact_distance(v0: float, a0: float, target: float, horizon: float) -> np.ndarray:
    """Integral of max(v, 0) at 0, 0.1 ... 8 s: exact between the roots of the cubic."""
    h = horizon
    d = target - v0
    c = [v0, a0, 3 * d / h**2 - 2 * a0 / h, a0 / h**2 - 2 * d / h**3]
    roots = np.polynomial.polynomial.polyroots(c) if abs(c[3]) > 1e-9 else []
    real = [r.real for r in roots if abs(np.imag(r)) < 1e-7 and 0 < r.real < h]
    antiderivative = np.polynomial.polynomial.polyint(c)
    value = lambda t: np.polynomial.polynomial.polyval(t, antiderivative)
    out = []
    for t in 0.1 * np.arange(NUM):
        cuts = sorted([0.0, *[r for r in real if r < min(t, h)], min(t, h)])
        total = 0.0
        for a, b in itertools.pairwise(cuts):
            if np.polynomial.polynomial.polyval((a + b) / 2, c) > 0:
                total += value(b) - value(a)
        out.append(total + max(t - h, 0) * target)
    return np.array(out)


@given(speeds, accels, speeds, st.sampled_from([4.0, 8.0]))
def test_cubic_meets_its_four_conditions(v0: float, a0: float, target: float, horizon: float):
    given = (jnp.asarray(v, jnp.float64) for v in (v0, a0, target, horizon))
    c0, c1, c2, c3 = (float(c) for c in cubic_speed(*given))
    assert c0 == v0 and c1 == a0
    end = c0 + horizon * (c1 + horizon * (c2 + horizon * c3))
    assert end == pytest.approx(target, abs=1e-9)
    assert c1 + 2 * c2 * horizon + 3 * c3 * horizon**2 == pytest.approx(0, abs=1e-9)
    t = np.linspace(0, horizon, 30)
    ours = np.polynomial.polynomial.polyval(t, [c0, c1, c2, c3])
    np.testing.assert_allclose(ours, speed_at(t, v0, a0, target, horizon), atol=1e-9)


@given(speeds, accels, speeds, st.sampled_from([4.0, 8.0]))
def test_distance_is_the_integral_of_the_clipped_speed(
    v0: float, a0: float, target: float, horizon: float
):
    ours = distance(v0, a0, target, horizon)
    fine = speed_at(np.linspace(0, 8, 8001), v0, a0, target, horizon)
    expected = exact_distance(v0, a0, target, horizon)
    if fine.min() >= 0:
        np.testing.assert_allclose(ours, expected, atol=1e-9)
    else:
        # Intervals in which the clip begins or ends are integrated numerically.
        np.testing.assert_allclose(ours, expected, atol=1e-4)
    assert np.all(np.diff(ours) >= -1e-12)
    assert ours[0] == 0


def test_strong_braking_stops_and_starts_again():
    ours = distance(1.0, -6.0, 10.0, 8.0)
    speed = speed_at(0.1 * np.arange(NUM), 1.0, -6.0, 10.0, 8.0)
    assert speed.min() < -1  # unclipped, the ego would reverse
    halt = np.flatnonzero(speed < -1e-9)
    np.testing.assert_array_equal(np.diff(ours[halt]), 0)
    assert 0 < ours[halt[0]] < 0.5 and ours[-1] > ours[halt[-1]] + 10


def test_short_horizon_holds_the_target_speed():
    ours = distance(5.0, 0.5, 9.0, 4.0)
    np.testing.assert_allclose(np.diff(ours)[41:], 0.9, atol=1e-9)
    assert np.diff(ours)[20] < 0.9


def test_float32_stays_close():
    single = _distance(
        *(jnp.asarray(v, jnp.float32) for v in (1.0, -6.0, 10.0, 8.0)), num_states=NUM
    )
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, distance(1.0, -6.0, 10.0, 8.0), atol=1e-4)


poses = st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-3, 3))


@given(poses, poses)
def test_bezier_is_the_cubic_curve(start: tuple[float, ...], end: tuple[float, ...]):
    values = [tuple(jnp.asarray(v, jnp.float64) for v in pose) for pose in (start, end)]
    x, y, heading = (np.asarray(v) for v in _bezier(*values, num=CURVE_POINTS))
    third = np.hypot(end[0] - start[0], end[1] - start[1]) / 3
    direction = lambda pose: np.array([np.cos(pose[2]), np.sin(pose[2])])
    first, last = np.array(start[:2]), np.array(end[:2])
    control = [first, first + third * direction(start), last - third * direction(end), last]
    # De Casteljau's construction: repeated halves instead of the polynomial.
    for i, t in enumerate(np.linspace(0, 1, CURVE_POINTS)):
        points = control
        while len(points) > 2:
            points = [(1 - t) * a + t * b for a, b in itertools.pairwise(points)]
        at = (1 - t) * points[0] + t * points[1]
        np.testing.assert_allclose([x[i], y[i]], at, atol=1e-9)
        tangent = points[1] - points[0]
        if np.linalg.norm(tangent) > 1e-3:
            angle = np.arctan2(tangent[1], tangent[0])
            assert np.cos(heading[i] - angle) == pytest.approx(1, abs=1e-9)
    if third > 1e-2:
        assert np.cos(heading[0] - start[2]) == pytest.approx(1, abs=1e-9)
        assert np.cos(heading[-1] - end[2]) == pytest.approx(1, abs=1e-9)


def ego(speed: float, accel: float) -> EgoState:
    zero = jnp.asarray(0.0)
    fields = dict.fromkeys(EgoState.__dataclass_fields__, zero)
    return EgoState(**fields | {"vx": jnp.asarray(speed), "ax": jnp.asarray(accel)})


def test_profiles_are_read_off_the_path_and_end_with_it():
    x = jnp.linspace(0, 60, 31)
    path = make_path(x, 0 * x, 0 * x, jnp.asarray(31, jnp.int32))
    paths = RouteLanePaths(
        path=jax.tree.map(lambda v: jnp.stack([v, v]), path),
        valid=jnp.asarray([True, False]),
        lane=jnp.asarray([4, -1], jnp.int32),
        overflow=jnp.asarray(False),
    )
    target = jnp.asarray([2.0, 6.0, 13.0])
    px, py, heading, valid = _drive(paths, ego(5.0, -1.0), target, SplineParams(), num_states=NUM)
    for row, goal in enumerate(target.tolist()):
        np.testing.assert_allclose(px[0, row], np.clip(distance(5.0, -1.0, goal, 8.0), 1e-5, 60))
    np.testing.assert_array_equal(py, 0)
    np.testing.assert_array_equal(heading, 0)
    # 8 s towards 13 m/s are longer than 60 m; the second path does not exist.
    np.testing.assert_array_equal(valid, [[True, True, False], [False] * 3])
