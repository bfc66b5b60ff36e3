"""Driving direction by nuPlan's rule, against plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.config import ScoringParams
from spdm_jax.scoring.driving import METRIC_WINDOW, driving_direction

PARAMS = ScoringParams()
NUM = 41

_direction = jax.jit(driving_direction, static_argnames="window")


def judge(speed: np.ndarray, oncoming: np.ndarray, window: int | None = METRIC_WINDOW) -> float:
    x = np.concatenate([[0.0], np.cumsum(0.1 * speed[1:])])[None]
    score = _direction(jnp.asarray(x), jnp.zeros_like(x), oncoming[None], PARAMS, window=window)
    return float(score[0])


@given(st.integers(0, 10_000))
def test_window_is_the_largest_sum(seed: int):
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0, rng.choice([2.5, 8.0]), NUM)
    oncoming = np.repeat(rng.random(9), 5)[:NUM] < 0.6
    oncoming[0] = False
    step = np.where(oncoming, 0.1 * speed, 0)
    most = max(step[max(i - METRIC_WINDOW + 1, 0) : i + 1].sum() for i in range(1, NUM))
    if min(abs(most - 2), abs(most - 6)) > 1e-9:
        assert judge(speed, oncoming) == (1 if most < 2 else 0.5 if most < 6 else 0)


def test_slow_driving_against_traffic_costs_nothing_by_the_metric_alone():
    slow, everywhere = np.full(NUM, 1.7), np.ones(NUM, bool)
    assert judge(slow, everywhere) == 1
    assert judge(slow, everywhere, window=None) == 0  # 6.8 m at a stretch
    assert judge(np.full(NUM, 1.9), everywhere) == 0.5
    assert judge(np.full(NUM, 5.6), everywhere) == 0


@pytest.mark.parametrize("final, expected", [(1.7, 1.0), (2.0, 0.5), (6.0, 0.0)])
def test_who_is_there_may_not_gain_speed(final: float, expected: float):
    """Three steps are too few to reach 2 m, but more steps lie behind the first state."""
    speed = np.where(np.arange(NUM) < 2, 1.6, final)
    assert judge(speed, np.arange(NUM) < 5) == expected
    assert judge(speed, (np.arange(NUM) > 0) & (np.arange(NUM) < 5)) == 1
    # Slowing down does not cost anything by itself.
    assert judge(np.linspace(1.9, 1.5, NUM), np.arange(NUM) < 5) == 1
