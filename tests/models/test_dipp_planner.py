"""Gauss-Newton on small problems, and DIPP's planner on a straight road."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_models.dipp_planner import (
    DIPPPlannerConfig,
    DIPPProblem,
    bicycle,
    frenet,
    residuals,
    solve,
)
from spdm_models.gauss_newton import GaussNewtonConfig, gauss_newton

STEPS = 12
CONFIG = DIPPPlannerConfig(horizon=STEPS, safety_steps=(0, 5, 11))
SOLVER = GaussNewtonConfig(iterations=15, step_size=0.5, result="best")
ROWS, LIMIT = 300, 8.0
WEIGHTS = (0.2, 0.2, 0.1, 0.3, 0.1, 1.0, 10.0, 10.0, 10.0)


def make_problem(
    speed=LIMIT, y=0.0, agent=(200.0, 0.0), valid=True, info=None, dtype: type = np.float64
) -> DIPPProblem:
    """A straight road along +x with one standing agent."""
    path = np.zeros((ROWS, 3))
    path[:, 0] = 0.1 * (np.arange(ROWS) - 200)
    cast = lambda v: np.asarray(v, dtype)
    return DIPPProblem(
        x=cast(0.0),
        y=cast(y),
        heading=cast(0.0),
        speed=cast(speed),
        length=cast(5.0),
        width=cast(2.0),
        agents_xy=cast(np.broadcast_to(agent, (1, STEPS, 2))),
        agent_length=cast([4.5]),
        agent_width=cast([2.0]),
        agent_valid=np.array([valid]),
        path=cast(path),
        path_info=cast(np.full(ROWS, LIMIT) if info is None else info),
        weights=cast(WEIGHTS),
    )


@jax.jit
def parts_of(controls, problem):
    return residuals(controls, problem, frenet(problem.agents_xy, problem.path), CONFIG)


@jax.jit
def solution_of(controls, problem):
    return solve(controls, problem, SOLVER, CONFIG)


def still() -> np.ndarray:
    return np.zeros((STEPS, 2))


def test_a_linear_problem_takes_one_step():
    random = np.random.default_rng(0)
    matrix, target = random.normal(size=(9, 4)), random.normal(size=9)
    config = GaussNewtonConfig(iterations=2, step_size=1.0)
    ours = gauss_newton(lambda v: jnp.asarray(matrix) @ v - target, jnp.zeros(4), config)
    expected, rest, *_ = np.linalg.lstsq(matrix, target)
    np.testing.assert_allclose(ours.values, expected, atol=1e-12)
    np.testing.assert_allclose(ours.objective, 0.5 * rest[0], rtol=1e-12)
    assert bool(ours.converged)


def test_a_variable_without_residual_stays():
    config = GaussNewtonConfig(iterations=1, step_size=1.0)
    ours = gauss_newton(lambda v: v[:2] - 3, jnp.array([0.0, 1.0, 7.0]), config)
    np.testing.assert_allclose(ours.values, [3, 3, 7])


def test_best_and_last_iterate_differ_where_the_objective_rises():
    # tanh is so flat out there that a step from 1.5 leads beyond -3.
    curve = lambda v: jnp.array([jnp.tanh(v[0]), 0.01 * v[0]])
    last, best = (
        gauss_newton(curve, jnp.array([1.5]), GaussNewtonConfig(1, 1.0, result=result))
        for result in ("last", "best")
    )
    assert last.objectives[1] > last.objectives[0]
    assert float(best.values[0]) == 1.5
    assert float(best.objective) == float(best.objectives[0])
    assert float(last.objective) == float(last.objectives[1])


def test_unrolled_steps_have_the_gradient_of_finite_differences():
    config = GaussNewtonConfig(iterations=2, step_size=0.4)

    def reached(weight):
        residual = lambda v: jnp.array([v[0] ** 2 - weight, weight * (v[1] - v[0]), v[1] - 1])
        return jnp.sum(gauss_newton(residual, jnp.array([1.0, 2.0]), config).values)

    up, down = (float(reached(jnp.asarray(1.3 + e))) for e in (1e-5, -1e-5))
    slope = float(jax.grad(reached)(jnp.asarray(1.3)))
    np.testing.assert_allclose(slope, (up - down) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize(("iterations", "step"), [(0, 0.5), (5, 0.0), (5, 1.5)])
def test_solver_settings_are_checked(iterations, step):
    with pytest.raises(ValueError, match=r"(iterations|step_size) is"):
        GaussNewtonConfig(iterations, step)


def test_driving_along_the_road_at_its_limit_costs_nothing():
    parts = parts_of(still(), make_problem())
    for value in jax.tree.leaves(parts):
        np.testing.assert_allclose(value, 0, atol=1e-12)


@given(
    speed=st.floats(0, 15),
    y=st.floats(-3, 3),
    angle=st.floats(-3, 3),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
    seed=st.integers(0, 100),
)
def test_residuals_do_not_depend_on_the_frame(speed, y, angle, shift, seed):
    controls = np.random.default_rng(seed).normal(size=(STEPS, 2)) * (1, 0.1)
    problem = make_problem(speed, y + 0.0137, agent=(9.0, 1.03))
    cos, sin = np.cos(angle), np.sin(angle)

    def move(xy):
        return np.stack(
            [cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], -1
        ) + np.array(shift)

    start = move(np.array([problem.x, problem.y]))
    moved = problem.replace(
        x=start[0],
        y=start[1],
        heading=problem.heading + angle,
        agents_xy=move(problem.agents_xy),
        path=np.concatenate([move(problem.path), problem.path[:, 2:] + angle], axis=1),
    )
    here, there = parts_of(controls, problem), parts_of(controls, moved)
    for name in ("speed", "red_light_violation", "safety"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=1e-8)
    # Headings wrap at one turn, and the nearest of two equally near points may change.
    turn = np.asarray(here.lane_theta - there.lane_theta)
    np.testing.assert_allclose(np.sin(turn), 0, atol=1e-8)
    distance = lambda parts: np.hypot(*np.asarray(parts.lane_xy).reshape(2, -1))
    np.testing.assert_allclose(distance(here), distance(there), atol=1e-6)


def test_a_missing_agent_or_one_behind_costs_nothing():
    for problem in (
        make_problem(agent=(9.0, 0.0), valid=False),
        make_problem(agent=(-5.0, 0.0)),
        make_problem(agent=(9.0, 4.0)),
    ):
        assert np.all(np.asarray(parts_of(still(), problem).safety) == 0)
    ahead = parts_of(still(), make_problem(agent=(9.0, 0.0))).safety
    # Half lengths and 5 m to keep: 9.75 m; the ego is 0.8 m along after one step.
    np.testing.assert_allclose(ahead[0], 9.75 - 8.2)


def test_red_lights_stop_before_them_and_not_where_the_ego_stands():
    info = np.full(ROWS, LIMIT)
    info[230:] = 0
    parts = parts_of(still(), make_problem(info=info))
    # The light is 3 m ahead, so every metre counts.
    np.testing.assert_allclose(parts.red_light_violation, LIMIT * 0.1 * np.arange(1, STEPS + 1))
    info[200:] = 0
    parts = parts_of(still(), make_problem(info=info))
    np.testing.assert_allclose(parts.red_light_violation, 0)


def test_solves_lower_the_cost_and_a_batch_is_a_loop():
    problems = [
        make_problem(speed=4.0, y=0.5),
        make_problem(agent=(9.0, 0.1)),
        make_problem(speed=0.0),
    ]
    alone = [solution_of(still(), problem) for problem in problems]
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *problems)
    batch = jax.vmap(solution_of, (None, 0))(still(), stacked)
    for i, one in enumerate(alone):
        assert float(one.objective) < 0.9 * float(one.objectives[0])
        np.testing.assert_allclose(batch.values[i], one.values, atol=1e-9)
    slowed = np.asarray(alone[1].values).reshape(-1, 2)[:, 0]
    assert slowed.sum() < 0


def test_float32_stays_float32():
    problem = make_problem(speed=4.0, y=0.5, dtype=np.float32)
    ours = jax.eval_shape(solution_of, still().astype(np.float32), problem)
    assert {v.dtype for v in jax.tree.leaves(ours)} == {np.dtype(np.float32), np.dtype(bool)}


def drive(controls, speed: float):
    zero = jnp.zeros(())
    return bicycle(jnp.asarray(controls), zero, zero, zero, jnp.asarray(speed))


def test_bicycle_clips_speed_after_the_whole_sum():
    motion = drive(np.array([[-5.0, 0.0]] * 2 + [[5.0, 0.0]] * 2), 0.6)
    np.testing.assert_allclose(motion.speed, [0.1, 0, 0.1, 0.6], atol=1e-12)
    np.testing.assert_allclose(motion.x, np.cumsum([0.01, 0, 0.01, 0.06]), atol=1e-12)


def test_steering_is_clipped_and_its_gradient_passes_at_the_bound():
    turn = lambda steering: drive(jnp.array([[0.0, steering]]), 3.089).heading[0]
    np.testing.assert_allclose([turn(0.6), turn(0.9)], [0.06, 0.06])
    np.testing.assert_allclose([jax.grad(turn)(0.6), jax.grad(turn)(0.9)], [0.1, 0])


def test_errors_name_both_sides():
    with pytest.raises(ValueError, match="horizon of 8"):
        DIPPPlannerConfig(horizon=8)
    with pytest.raises(ValueError, match="horizon is 12"):
        solve(jnp.zeros((5, 2)), make_problem(), SOLVER, CONFIG)
