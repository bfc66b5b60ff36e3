"""Smoothing and statistics of padded series against SciPy and NumPy on the real samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from spdm_jax.metrics.series import _p90_rank, seconds, smooth, summarize

ROOM = 40
filter_ = jax.jit(smooth, static_argnums=(2, 3, 4))
summary = jax.jit(summarize)


def padded(values: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Values in a larger room, followed by numbers that must not matter."""
    room = np.full((*values.shape[:-1], ROOM), 7.5e3)
    room[..., : values.shape[-1]] = values
    return jnp.asarray(room), jnp.arange(ROOM) < values.shape[-1]


@pytest.mark.parametrize("window, order, derivative", [(8, 2, 0), (15, 2, 1), (5, 2, 1), (5, 3, 2)])
@pytest.mark.parametrize("length", [4, 5, 7, 8, 9, 14, 15, 16, 40])
def test_filters(window: int, order: int, derivative: int, length: int):
    values = np.random.default_rng(length).normal(size=(2, length))
    width = min(window, length)
    expected = np.asarray(savgol_filter(values, width, order, deriv=derivative, delta=0.13))
    ours = filter_(*padded(values), window, order, derivative, 0.13)
    np.testing.assert_allclose(ours[:, :length], expected, atol=2e-8)
    assert not np.asarray(ours[:, length:]).any()


@pytest.mark.parametrize("length, order", [(1, 2), (2, 2), (3, 3)])
def test_a_series_too_short_for_the_polynomial_is_not_a_number(length: int, order: int):
    values, valid = padded(np.ones((1, length)))
    assert np.isnan(np.asarray(filter_(values, valid, 5, order, 0, 1.0))[0, :length]).all()


@pytest.mark.parametrize("length", [1, 2, 9, 12, 20, 33, 40])
def test_statistics(length: int):
    values = np.random.default_rng(length).normal(size=(3, length))
    ours = summary(*padded(values))
    np.testing.assert_allclose(ours.maximum, values.max(1))
    np.testing.assert_allclose(ours.minimum, values.min(1))
    np.testing.assert_allclose(ours.mean, values.mean(1))
    expected = np.percentile(values, 90, axis=1, method="closest_observation")
    np.testing.assert_allclose(ours.p90, expected)


def test_ties_of_the_percentile_go_to_the_even_rank():
    # 0.9 n - 1.5 is a whole number for n = 5, 15, 25, 35: ranks 3, 12, 21, 30.
    assert _p90_rank(ROOM)[[5, 15, 25, 35]].tolist() == [4, 12, 22, 30]


def test_nothing_has_no_statistics():
    empty = summary(jnp.ones((1, ROOM)), jnp.zeros(ROOM, bool))
    assert all(np.isnan(np.asarray(v)).all() for v in empty)


def test_seconds():
    time = jnp.asarray([0.0, 0.1, 0.3, 0.6, 9.0])
    duration, step = seconds(time, jnp.arange(5) < 4)
    assert (float(duration), float(step)) == pytest.approx((0.6, 0.2))
    duration, step = seconds(time, jnp.arange(5) < 1)
    assert float(duration) == 0 and np.isnan(step)
