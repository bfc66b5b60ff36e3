"""The intelligent driver model and its rollout on small, transparent roads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.config import IDMParams
from spdm_jax.proposals.idm import Leader, idm_step

_step = jax.jit(idm_step)


@given(st.integers(0, 2**32 - 1))
def test_step_follows_the_equation(seed: int):
    rng = np.random.default_rng(seed)
    x, v, target = rng.uniform(0, 50, 40), rng.uniform(-0.3, 20, 40), rng.uniform(1, 15, 40)
    lead = x + rng.uniform(-5, 60, 40), rng.uniform(-5, 20, 40), rng.uniform(0, 3, 40)
    params = IDMParams(
        min_gap=rng.uniform(0.5, 3, 40),
        headway_time=rng.uniform(0.5, 2, 40),
        accel_max=rng.uniform(0.5, 2, 40),
        decel_max=rng.uniform(1, 4, 40),
    )
    after = _step(jnp.asarray(x), jnp.asarray(v), Leader(*map(jnp.asarray, lead)), target, params)
    s0, headway = np.asarray(params.min_gap), np.asarray(params.headway_time)
    a, b = np.asarray(params.accel_max), np.asarray(params.decel_max)
    for i in range(40):
        wanted = s0[i] + v[i] * headway[i] + v[i] * (v[i] - lead[1][i]) / (2 * (a[i] * b[i]) ** 0.5)
        space = max(lead[0][i] - x[i] - lead[2][i], s0[i])
        accel = a[i] * (1 - (v[i] / target[i]) ** 10 - (wanted / space) ** 2)
        accel = min(max(accel, -b[i]), a[i])
        assert float(after[0][i]) == pytest.approx(x[i] + 0.1 * v[i])
        assert float(after[1][i]) == pytest.approx(v[i] + 0.1 * accel)


def test_free_road_settles_at_the_target_speed():
    x, v = jnp.zeros(3), jnp.asarray([0.0, 8.0, 12.0])
    leader = Leader(jnp.full(3, 1e6), jnp.zeros(3), jnp.zeros(3))
    for _ in range(400):
        x, v = _step(x, v, leader, jnp.full(3, 10.0), IDMParams())
    np.testing.assert_allclose(v, 10.0, atol=0.05)


def test_standing_leader_is_not_hit():
    x, v = jnp.zeros(1), jnp.full(1, 10.0)
    leader = Leader(jnp.full(1, 60.0), jnp.zeros(1), jnp.full(1, 2.0))
    for _ in range(400):
        x, v = _step(x, v, leader, jnp.full(1, 12.0), IDMParams())
    assert 55.0 < float(x[0]) < 58.0  # min_gap before its rear
    assert abs(float(v[0])) < 0.1
