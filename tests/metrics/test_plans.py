"""Open-loop metrics on plans whose errors are known, and the scores' formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_jax.metrics import (
    OPEN_LOOP_SCORED,
    ExpertPoses,
    OpenLoopParams,
    comparison_indices,
    open_loop,
    open_loop_score,
    score,
    scores_by_type,
)
from spdm_jax.metrics.named import open_loop_series, open_loop_statistics
from spdm_jax.metrics.plans import MEASURES
from spdm_jax.simulation.controller import Plan

FRAMES, SPEED = 5, 9.0
evaluate = jax.jit(open_loop, static_argnames="config")


def expert(times: np.ndarray | None = None) -> ExpertPoses:
    """Drives along x."""
    time = np.arange(FRAMES + 8.0) if times is None else times
    zero = jnp.zeros(len(time))
    return ExpertPoses(jnp.asarray(SPEED * time), zero, zero, jnp.asarray(time))


def plans(*, length=8.0, poses=17, along=0.0, aside=0.0, turn=0.0) -> Plan:
    """One plan per frame that leaves the expert at constant rates (m/s and rad/s)."""
    time = np.linspace(0, length, poses)
    start = np.arange(float(FRAMES))
    rows = lambda v: jnp.asarray(np.broadcast_to(v, (FRAMES, poses)))
    return Plan(
        x=rows(SPEED * start[:, None] + (SPEED + along) * time),
        y=rows(aside * time),
        heading=rows(turn * time),
        time=rows(time),
        start=jnp.asarray(start),
    )


def by_name(metrics) -> dict[str, np.ndarray]:
    return dict(zip(MEASURES, np.asarray(metrics.by_horizon), strict=True))


def test_the_experts_own_plans():
    metrics = evaluate(plans(), expert())
    np.testing.assert_allclose(metrics.errors, 0, atol=1e-12)
    assert float(metrics.final) == pytest.approx(1)


def test_errors_that_grow_with_time():
    metrics = evaluate(plans(aside=0.5), expert())
    found = by_name(metrics)
    np.testing.assert_allclose(found["average_displacement"], [1.0, 1.5, 2.25])
    np.testing.assert_allclose(found["final_displacement"], [1.5, 2.5, 4.0])
    np.testing.assert_allclose(found["maximum_displacement"], [1.5, 2.5, 4.0])
    names = dict(zip(OPEN_LOOP_SCORED, np.asarray(metrics.scores), strict=True))
    mean = np.mean([1.0, 1.5, 2.25])
    key = "planner_expert_average_l2_error_within_bound"
    assert names[key] == pytest.approx(1 - mean / 8)
    given = open_loop_statistics(metrics)[key]
    assert given["planner_expert_ADE_horizon_5"] == pytest.approx(1.5)
    assert given["avg_planner_expert_ADE_over_all_horizons"] == pytest.approx(mean)
    np.testing.assert_allclose(open_loop_series(metrics)[key], np.full(FRAMES, mean))


def test_headings_and_the_box_centre():
    metrics = evaluate(plans(turn=0.1), expert())
    found = by_name(metrics)
    np.testing.assert_allclose(found["final_heading"], [0.3, 0.5, 0.8])
    # The rear axles agree, the box centres turn about them.
    chord = 2 * 1.461 * np.sin(0.1 * np.array([3, 5, 8]) / 2)
    np.testing.assert_allclose(found["final_displacement"], chord)


@pytest.mark.parametrize("along, score_", [(1.99, 1), (2.01, 0)])
def test_misses(along: float, score_: float):
    # 6 m after 3 s, 8 m after 5 s, 16 m after 8 s: the second is the sharpest.
    metrics = evaluate(plans(along=along * 0.8), expert())
    assert float(metrics.scores[0]) == score_
    assert np.asarray(metrics.miss_rate).tolist() == [0, 1 - score_, 0]


def test_a_plan_of_a_little_less_than_the_horizon_is_compared_at_its_end():
    found = by_name(evaluate(plans(length=7.5, poses=16, aside=0.5), expert()))
    np.testing.assert_allclose(found["final_displacement"], [1.5, 2.5, 3.75])


def test_a_plan_too_short_has_no_score():
    metrics = evaluate(plans(length=4.0, poses=9), expert())
    assert np.isfinite(np.asarray(metrics.by_horizon)[:, 0]).all()
    assert np.isnan(np.asarray(metrics.by_horizon)[:, 1:]).all()
    assert np.isnan(float(metrics.final))


def test_float32():
    narrow = lambda tree: jax.tree.map(lambda v: v.astype(jnp.float32), tree)
    metrics = evaluate(narrow(plans(aside=0.5)), narrow(expert()), OpenLoopParams())
    assert {v.dtype for v in jax.tree.leaves(metrics)} == {jnp.dtype(jnp.float32)}


def test_indices_of_150_and_151_iterations():
    samples, rows = comparison_indices(150, 149)
    assert samples.tolist() == list(range(0, 149, 10))
    assert rows.tolist() == list(range(0, 230, 10))
    _, rows = comparison_indices(151, 150)
    # The window's end stands there twice.
    assert rows.tolist() == [*range(0, 151, 10), *range(150, 221, 10)]


def test_a_repeated_state_shortens_the_last_horizon():
    twice = np.array([*range(FRAMES + 1), *range(FRAMES, FRAMES + 7)], float)
    found = np.asarray(evaluate(plans(aside=0.5), expert(twice)).errors)
    final = found[MEASURES.index("final_displacement")]
    np.testing.assert_allclose(final[2], [4.0 - 0.5] * FRAMES)


def test_the_closed_loop_score():
    ones = jnp.ones(8)
    assert float(score(ones)) == pytest.approx(1)
    for i in range(4):
        assert float(score(ones.at[i].set(0.5))) == pytest.approx(0.5)
    for i, weight in enumerate((5, 5, 4, 2)):
        assert float(score(ones.at[4 + i].set(0))) == pytest.approx(1 - weight / 16)
    assert np.isnan(float(score(ones.at[7].set(jnp.nan))))


def test_the_open_loop_score():
    ones = jnp.ones(5)
    assert float(open_loop_score(ones.at[0].set(0))) == 0
    for i, weight in enumerate((1, 1, 2, 2)):
        assert float(open_loop_score(ones.at[1 + i].set(0))) == pytest.approx(1 - weight / 6)


def test_scores_by_type():
    table = scores_by_type(np.array([1.0, 0.5, np.nan, 0.0]), ["a", "a", "b", "b"])
    assert table["a"] == (0.75, 2, 0)
    assert table["b"] == (0.0, 1, 1)
    assert table["all"] == (0.5, 3, 1)
    with pytest.raises(ValueError, match="3 types"):
        scores_by_type(np.ones(2), ["a"] * 3)
