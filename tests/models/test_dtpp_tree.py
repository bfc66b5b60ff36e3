"""DTPP's reference paths and tree: expansion, pruning and choice, with made-up scores."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.geometry import Box, box_at
from spdm_models.dtpp_paths import ReferencePaths, is_obstacle, reference_paths
from spdm_models.dtpp_tree import (
    Branches,
    TreeConfig,
    exact_prefix_sum,
    expand,
    first_stage,
    plan_tree,
    second_stage,
)
from spdm_models.lattice import Course, Polyline

CONFIG = TreeConfig()
ROWS = 1200
LIMIT = 13.0


def straight_courses(angles=(0.0, 0.2, -0.2), rows=(ROWS, ROWS, ROWS)) -> ReferencePaths:
    """Straight paths from the origin; rows beyond the real ones hold what must not matter."""
    s = 0.1 * np.arange(ROWS)
    turn = np.array(angles)[:, None]
    count = np.array(rows)
    real = np.arange(ROWS) < count[:, None]
    columns = (s * np.cos(turn), s * np.sin(turn), turn + 0 * s, 0 * turn + 0 * s)
    x, y, heading, curvature = (jnp.asarray(np.where(real, c, 0.3)) for c in columns)
    course = Course(x, y, heading, curvature, jnp.asarray(count, jnp.int32))
    return ReferencePaths(course, jnp.asarray(count > 0), jnp.zeros(()))


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, jnp.float64)


@partial(jax.jit, static_argnums=(4, 5))
def grow(start, courses, valid, limit, from_root, config):
    return expand(start, courses, valid, limit, from_root, config)


def prefer_speed(branches: Branches) -> jax.Array:
    """Branches that end near 8 m/s, on the path with the larger y."""
    end = branches.states[:, -1]
    return 0.1 * end[:, 1] - jnp.abs(end[:, 3] - 8.0)


@partial(jax.jit, static_argnums=1)
def search(given, config):
    paths, speed, acceleration, limit = given
    return plan_tree(paths, speed, acceleration, limit, prefer_speed, config)


@given(st.floats(0.0, 12.0), st.floats(-2.0, 2.0), st.booleans())
def test_kept_branches_are_apart_and_end_at_their_target(speed, acceleration, from_root):
    paths = straight_courses()
    start = jnp.asarray([0, 0, 0, speed, acceleration], jnp.float64)
    states, kept = grow(start, paths.course, paths.valid, scalar(LIMIT), from_root, CONFIG)
    states, kept = np.asarray(states), np.asarray(kept)
    steps, num = (30, 10) if from_root else (50, 5)
    assert states.shape == (3 * num, steps, 6)
    assert kept[0]
    end = states[kept, -1, :2]
    gap = np.hypot(*np.moveaxis(end[:, None] - end, -1, 0)) + 9 * np.eye(len(end))
    assert gap.min() >= 0.5
    # What is dropped ends close to something kept.
    for row in states[~kept]:
        assert np.hypot(*(end - row[-1, :2]).T).min() < 0.5
    np.testing.assert_allclose(states[:, -1, 4], 0, atol=1e-9)
    reached = states[:num, -1, 3]
    gain = (7.2, -12.0) if from_root else (5.0, -5.0)
    assert reached[-1] == pytest.approx(min(speed + gain[0], LIMIT))
    assert reached[0] == pytest.approx(max(speed + gain[1], 0))
    # Distance driven is the sum of the speeds, to the row of the path.
    driven = 0.1 * (speed + np.sum(states[:, :-1, 3], axis=1))
    along = np.hypot(*states[:, -1, :2].T)
    assert np.all((np.abs(driven - along) < 0.1 + 1e-6) | (driven < 0))


def test_a_profile_that_leaves_its_path_is_dropped():
    start = jnp.asarray([0, 0, 0, 10, 0], jnp.float64)
    paths = straight_courses(rows=(220, ROWS, ROWS))
    states, kept = grow(start, paths.course, paths.valid, scalar(LIMIT), True, CONFIG)
    first = np.asarray(kept)[:10]
    driven = 0.1 * (10 + np.sum(np.asarray(states)[:10, :-1, 3], axis=1))
    np.testing.assert_array_equal(first, driven < 22)
    assert 0 < first.sum() < 10


def test_backing_up_stays_at_the_start_of_the_path():
    start = jnp.asarray([0, 0, 0, 0, -1.5], jnp.float64)
    paths = straight_courses()
    given = paths.course, paths.valid, scalar(LIMIT), True
    states, _ = grow(start, *given, CONFIG)
    assert states[0, 5, 3] < 0
    assert states[0, 5, 0] == 0
    states, _ = grow(start, *given, TreeConfig(reference_wrap=True))
    assert states[0, 5, 0] == pytest.approx(119.9)


def test_the_best_sum_of_both_scores_wins():
    given = straight_courses(), scalar(6.0), scalar(0.3), scalar(LIMIT)
    plan = search(given, CONFIG)
    assert bool(plan.valid)
    first, second = np.asarray(plan.first_scores), np.asarray(plan.second_scores)
    real = np.asarray(plan.second.valid)
    assert np.all(np.isinf(second[~real])) and np.all(np.isfinite(second[real]))
    parents = np.asarray(plan.second.parent)[real]
    best = np.argsort(-first, kind="stable")[: CONFIG.num_parents]
    assert set(parents) == set(best)
    total = first[parents] + second[real]
    assert int(plan.best) == int(np.argmax(total))
    states = np.asarray(plan.second.states)
    np.testing.assert_array_equal(plan.x, states[int(plan.best), :, 0])
    # Branches of the second stage go on from their parent.
    for row, parent in zip(states[real], parents, strict=True):
        np.testing.assert_array_equal(row[:30], plan.first.states[parent])
    np.testing.assert_array_less(np.abs(np.diff(states[real, :, 0], axis=1)), 0.1 * LIMIT + 0.11)
    assert plan.heading[-1] == pytest.approx(0.2)
    assert states[int(plan.best), -1, 3] == pytest.approx(8, abs=1.5)


def test_paths_that_are_not_valid_change_nothing():
    rest = scalar(6.0), scalar(0.3), scalar(LIMIT)
    one = straight_courses()
    other = straight_courses((0.0, 0.2, 0.1))
    hidden = jnp.asarray([True, True, False])
    plans = [search((p.replace(valid=hidden), *rest), CONFIG) for p in (one, other)]
    jax.tree.map(np.testing.assert_array_equal, *plans)
    assert not np.allclose(plans[0].first_scores, search((one, *rest), CONFIG).first_scores)


def test_without_a_path_of_eight_seconds_there_is_no_plan():
    paths = straight_courses(rows=(0, 0, 0))
    plan = search((paths, scalar(6.0), scalar(0.3), scalar(LIMIT)), CONFIG)
    assert not bool(plan.valid)
    assert np.all(np.asarray([plan.x, plan.y, plan.heading]) == 0)
    # Three seconds fit, eight do not: at this speed 5 m are driven at least while stopping.
    paths = straight_courses(rows=(230, 230, 230))
    plan = search((paths, scalar(9.0), scalar(0.0), scalar(LIMIT)), CONFIG)
    assert bool(plan.first.valid.any())
    assert float(jnp.max(plan.second.states[..., 0])) < 23.0


def test_too_many_branches_are_cut_evenly_or_by_a_key():
    # Wide apart, so that every leaf has all its children.
    paths = straight_courses((0.0, 0.8, -0.8))
    given = paths, scalar(8.0), scalar(0.0), scalar(LIMIT), CONFIG
    first = jax.jit(first_stage, static_argnums=4)(*given)
    scores = jnp.where(first.valid, 1.0, -jnp.inf)
    few = TreeConfig(num_branches=12)
    cut = jax.jit(second_stage, static_argnums=4)
    kept, dropped = cut(paths, first, scores, scalar(LIMIT), few)
    assert bool(kept.valid.all())
    assert int(dropped) > 0
    counts = np.bincount(np.asarray(kept.parent))
    counts = counts[counts > 0]
    assert len(counts) == few.num_parents and counts.max() - counts.min() <= 1
    keys = (jax.random.key(0), jax.random.key(1))
    drawn = [cut(paths, first, scores, scalar(LIMIT), few, key)[0] for key in keys]
    assert all(bool(d.valid.all()) for d in drawn)
    assert not np.array_equal(drawn[0].states, drawn[1].states)


def test_more_combinations_than_branches_are_refused():
    config = TreeConfig(num_branches=20)
    with pytest.raises(ValueError, match=r"3 x first_speeds 10 = 30 exceeds num_branches 20"):
        first_stage(straight_courses(), scalar(5.0), scalar(0.0), scalar(LIMIT), config)


def test_config_is_hashable():
    assert hash(TreeConfig()) == hash(TreeConfig())


def test_sums_of_float32_are_rounded_once():
    values = np.random.default_rng(0).uniform(0, 1.5, (40, 50)).astype(np.float32)
    exact = np.cumsum(values.astype(np.float64), axis=1).astype(np.float32)
    np.testing.assert_array_equal(exact_prefix_sum(jnp.asarray(values)), exact)


lines_to_paths = jax.jit(reference_paths, static_argnums=5)


def two_lanes(padded: float = 0.0) -> tuple[Polyline, jax.Array]:
    """Lanes at y = 0 and 3.5 m, and a row that is none."""
    x = np.broadcast_to(0.25 * np.arange(300), (3, 300)).copy()
    y = np.zeros((3, 300))
    y[1], y[2] = 3.5, padded
    lines = Polyline(
        jnp.asarray(x), jnp.asarray(y), jnp.asarray(0 * y), jnp.asarray([300, 300, 250], jnp.int32)
    )
    return lines, jnp.asarray([True, True, False])


def obstacle(x: float, y: float) -> Box:
    return box_at(*(jnp.full(1, v, jnp.float64) for v in (x, y, 0.0, 2.0, 1.0)))


def test_an_obstacle_pushes_the_paths_to_the_other_lane():
    ego = tuple(scalar(v) for v in (10.0, 0.2, 0.0))
    there = jnp.asarray([True])
    free = lines_to_paths(*two_lanes(), ego, obstacle(25, 0), ~there, 3)
    blocked = lines_to_paths(*two_lanes(), ego, obstacle(25, 0), there, 3)
    assert free.valid.all() and blocked.valid.all()
    np.testing.assert_allclose(free.course.y[:, 600], -0.2, atol=1e-6)
    np.testing.assert_allclose(blocked.course.y[:, 600], 3.3, atol=1e-6)
    np.testing.assert_allclose(blocked.cost[0] - free.cost[0], 10)
    assert np.all(np.isinf(blocked.cost[2]))
    # The ego frame: paths start at the origin.
    np.testing.assert_allclose(blocked.course.x[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(blocked.course.y[:, 0], 0, atol=1e-9)


def test_padded_lanes_and_absent_obstacles_change_no_path():
    ego = tuple(scalar(v) for v in (10.0, 0.2, 0.0))
    nobody = jnp.asarray([False])
    one = lines_to_paths(*two_lanes(0.0), ego, obstacle(25, 0), nobody, 3)
    other = lines_to_paths(*two_lanes(0.7), ego, obstacle(18, 1), nobody, 3)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_moving_vehicles_are_no_obstacles():
    blocks = is_obstacle(
        jnp.asarray([True, True, False, False]),
        jnp.asarray([False, False, True, False]),
        jnp.asarray([0.05, 2.0, 0.0, 0.0]),
    )
    np.testing.assert_array_equal(blocks, [True, False, True, False])
