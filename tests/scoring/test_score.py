"""The scorer against a plain walk through time, and what must hold for any input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

import plain_scorer as plain
from scorer_world import (
    DRIVABLE,
    INTERSECTIONS,
    NUM_OBJECTS,
    NUM_PROPOSALS,
    ON_ROUTE,
    PATH,
    forecast_of,
    grid_world,
    random_objects,
    random_states,
    state_of,
)
from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.scoring.collision import first_contacts
from spdm_jax.scoring.comfort import comfort_signals
from spdm_jax.scoring.score import score_trajectories
from spdm_jax.types import CollisionKind, SubScores

VEHICLE, PARAMS = VehicleParams(), ScoringParams()
seeds = st.integers(0, 2**32 - 1)


_score, _contacts = jax.jit(score_trajectories), jax.jit(first_contacts)


def score(states: np.ndarray, objects: dict, valid: np.ndarray | None = None) -> SubScores:
    mask = jnp.ones(len(states), bool) if valid is None else jnp.asarray(valid)
    result = _score(state_of(states), mask, grid_world(forecast_of(objects)), VEHICLE, PARAMS)
    return jax.tree.map(np.asarray, result)


def take(objects: dict, rows) -> dict:
    return {name: values[rows] for name, values in objects.items()}


@settings(max_examples=10)
@given(seeds)
def test_scorer_equals_a_plain_walk_through_time(seed: int):
    rng = np.random.default_rng(seed)
    states = random_states(rng)
    objects = random_objects(rng, states)
    ours = score(states, objects)
    scorer = plain.PlainScorer(objects, DRIVABLE, ON_ROUTE, INTERSECTIONS, shapely.LineString(PATH))
    rows = [scorer.score(row) for row in states]
    for p, row in enumerate(rows):
        areas = np.stack([ours.multiple_lanes, ours.non_drivable, ours.oncoming], -1)[p]
        np.testing.assert_array_equal(areas, row["areas"])
        for name in (
            "no_at_fault_collision",
            "time_to_collision",
            "drivable_area",
            "driving_direction",
        ):
            assert getattr(ours, name)[p] == row[name], (p, name)
        np.testing.assert_array_equal(ours.comfort_flags[p], row["comfort_flags"])
        assert ours.comfort[p] == row["comfort_flags"].all()
        assert ours.collision_time[p] == pytest.approx(0.1 * row["collision_index"])
        assert ours.ttc_time[p] == pytest.approx(0.1 * row["ttc_index"])
        culprits = row["collision_objects"] or {-1}
        assert int(ours.collision_object[p]) in culprits
        assert int(ours.collision_kind[p]) in (row["collision_kinds"] or {-1})
        assert int(ours.ttc_object[p]) in (row["ttc_objects"] or {-1})
        assert ours.progress_raw[p] == pytest.approx(row["progress_raw"], abs=1e-9)
    progress, total = plain.totals(rows)
    np.testing.assert_allclose(ours.progress, progress, atol=1e-9)
    np.testing.assert_allclose(ours.total, total, atol=1e-9)


def test_comfort_signals_are_windowed_fits():
    states = random_states(np.random.default_rng(9))
    ours = np.stack(list(comfort_signals(state_of(states)).values()), 1)
    expected = np.stack([plain.comfort_signals(row) for row in states])
    np.testing.assert_allclose(ours, expected, atol=2e-8)
    single = np.stack(list(comfort_signals(state_of(states, jnp.float32)).values()), 1)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, atol=2e-3)


def test_random_worlds_exercise_every_rule():
    seen: dict[str, set] = {}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        states = random_states(rng)
        result = score(states, random_objects(rng, states))
        for name in (
            "no_at_fault_collision",
            "time_to_collision",
            "drivable_area",
            "driving_direction",
            "comfort",
            "collision_kind",
        ):
            seen.setdefault(name, set()).update(getattr(result, name).tolist())
    assert seen["no_at_fault_collision"] == {0.0, 0.5, 1.0}
    assert seen["driving_direction"] == {0.0, 0.5, 1.0}
    for name in ("time_to_collision", "drivable_area", "comfort"):
        assert seen[name] == {0.0, 1.0}
    # A stopped ego and a contact from behind are never at fault.
    assert seen["collision_kind"] == {
        -1,
        CollisionKind.STOPPED_TRACK,
        CollisionKind.ACTIVE_FRONT,
        CollisionKind.ACTIVE_LATERAL,
    }


@pytest.mark.parametrize("copies", [8, 80])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_few_and_many_proposals_score_bit_for_bit_alike(copies: int, dtype):
    # 8 x 8 rows are compared at once, 80 x 8 in the arrangement for many proposals.
    rng = np.random.default_rng(11)
    states = random_states(rng)
    forecast = forecast_of(random_objects(rng, states), dtype)
    few = _contacts(state_of(states, dtype), forecast, VEHICLE, PARAMS)
    many = _contacts(state_of(np.tile(states, (copies, 1, 1)), dtype), forecast, VEHICLE, PARAMS)
    for one, all_ in zip(few, many, strict=True):
        np.testing.assert_array_equal(np.tile(one, (copies, 1)), all_)
    assert (np.asarray(few.time) < 41).any() and (np.asarray(few.ttc) < 164).any()


@given(seeds)
def test_scores_lie_in_their_ranges(seed: int):
    rng = np.random.default_rng(seed)
    states = random_states(rng)
    result = score(states, random_objects(rng, states))
    for name in ("total", "progress"):
        values = getattr(result, name)
        assert np.all((values >= 0) & (values <= 1))
    assert set(result.no_at_fault_collision) <= {0.0, 0.5, 1.0}
    assert set(result.driving_direction) <= {0.0, 0.5, 1.0}
    for name in ("drivable_area", "time_to_collision", "comfort"):
        assert set(getattr(result, name)) <= {0.0, 1.0}
    assert np.all(result.progress_raw >= 0)
    m = result.no_at_fault_collision * result.drivable_area * result.driving_direction
    assert np.all(result.total <= m)
    collided = result.no_at_fault_collision < 1
    np.testing.assert_array_equal(np.isfinite(result.collision_time), collided)
    np.testing.assert_array_equal(result.collision_object >= 0, collided)
    np.testing.assert_array_equal(np.isfinite(result.ttc_time), result.time_to_collision < 1)


@given(seeds, st.integers(0, NUM_OBJECTS - 1))
def test_removing_an_object_never_lowers_a_safety_score(seed: int, row: int):
    rng = np.random.default_rng(seed)
    states = random_states(rng)
    objects = random_objects(rng, states)
    objects["present"][row] = True
    fewer = dict(objects, present=objects["present"] & (np.arange(NUM_OBJECTS) != row))
    before, after = score(states, objects), score(states, fewer)
    assert np.all(after.no_at_fault_collision >= before.no_at_fault_collision)
    assert np.all(after.time_to_collision >= before.time_to_collision)
    assert np.all(after.collision_time >= before.collision_time)
    for name in ("drivable_area", "driving_direction", "comfort", "progress_raw"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@given(seeds)
def test_order_of_objects_does_not_matter(seed: int):
    rng = np.random.default_rng(seed)
    states = random_states(rng)
    objects = random_objects(rng, states)
    order = rng.permutation(NUM_OBJECTS)
    one, other = score(states, objects), score(states, take(objects, order))
    for name in SubScores.__dataclass_fields__:
        if name not in ("collision_object", "ttc_object", "collision_kind"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_order_of_proposals_does_not_matter():
    rng = np.random.default_rng(5)
    states = random_states(rng)
    objects = random_objects(rng, states)
    order = rng.permutation(NUM_PROPOSALS)
    one, other = score(states, objects), score(states[order], objects)
    for name in SubScores.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name)[order], getattr(other, name))


def same(one: SubScores, other: SubScores, rows: int) -> None:
    for name in SubScores.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name)[:rows], getattr(other, name)[:rows])


def test_padding_changes_nothing():
    rng = np.random.default_rng(21)
    states = random_states(rng)
    objects = random_objects(rng, states)
    alone = score(states, objects)
    # Objects that are not there, with boxes on top of the trajectories.
    ghosts = dict(random_objects(rng, states, 10), present=np.zeros(10, bool))
    more = {name: np.concatenate([objects[name], ghosts[name]]) for name in objects}
    # Proposals that are not there: the longest way down either lane (at no speed, hence no fault).
    extra = np.zeros((5, 41, 11))
    extra[..., 0], extra[..., 1] = np.linspace(-38, 50, 41), [[0.0]] * 2 + [[-3.5]] * 3
    valid = np.arange(NUM_PROPOSALS + 5) < NUM_PROPOSALS
    wider = score(np.concatenate([states, extra]), more, valid)
    same(alone, wider, NUM_PROPOSALS)
    np.testing.assert_array_equal(wider.total[NUM_PROPOSALS:], 0)
    np.testing.assert_array_equal(wider.valid, valid)
    # Were they there, the progress of all others would count for less.
    longer = score(np.concatenate([states, extra]), more)
    assert longer.progress[:NUM_PROPOSALS].sum() < 0.9 * alone.progress.sum()


NO_ROWS = pytest.mark.xfail(reason="arrays without rows are not supported", strict=True)


@pytest.mark.parametrize("num", [pytest.param(0, marks=NO_ROWS), NUM_OBJECTS])
def test_empty_worlds_are_scored(num: int):
    """No row at all, or rows that hold no object."""
    rng = np.random.default_rng(2)
    states = random_states(rng)
    objects = dict(random_objects(rng, states, num), present=np.zeros(num, bool))
    result = score(states, objects)
    np.testing.assert_array_equal(result.no_at_fault_collision, 1)
    np.testing.assert_array_equal(result.time_to_collision, 1)
    np.testing.assert_array_equal(result.collision_object, -1)
    np.testing.assert_array_equal(result.ttc_object, -1)
    assert np.all(np.isinf(result.collision_time)) and np.all(np.isinf(result.ttc_time))
    assert result.total.max() > 0


def test_nobody_moves():
    """Without progress every admissible proposal gets the full progress term."""
    states = np.zeros((NUM_PROPOSALS, 41, 11))
    states[1::2, :, 1] = 30.0  # off the road
    objects = random_objects(np.random.default_rng(0), states)
    result = score(states, dict(objects, present=np.zeros(NUM_OBJECTS, bool)))
    np.testing.assert_array_equal(result.progress, [1, 0] * 4)
    np.testing.assert_array_equal(result.total, [1, 0] * 4)


def test_weights_and_thresholds_are_used():
    rng = np.random.default_rng(8)
    states = random_states(rng)
    world = grid_world(forecast_of(random_objects(rng, states)))
    mask = jnp.ones(NUM_PROPOSALS, bool)
    run = lambda **changes: _score(
        state_of(states), mask, world, VEHICLE, dataclasses.replace(PARAMS, **changes)
    )
    usual = run()
    m = usual.no_at_fault_collision * usual.drivable_area * usual.driving_direction
    only_comfort = run(progress_weight=0.0, ttc_weight=0.0)
    np.testing.assert_allclose(only_comfort.total, m * usual.comfort, atol=1e-12)
    lenient = run(lon_accel_min=-1e3, lon_accel_max=1e3, lon_jerk_max=1e3, jerk_max=1e3)
    assert np.all(np.asarray(lenient.comfort_flags)[:, [0, 2, 3]])
    strict = run(lat_accel_max=1e-9)
    assert not np.any(np.asarray(strict.comfort_flags)[:, 1])


@pytest.mark.slow
def test_every_transform_gives_the_same():
    """Compiled alone and mapped at once."""
    worlds = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        states = random_states(rng)
        worlds.append((state_of(states), forecast_of(random_objects(rng, states))))
    batch = jax.tree.map(lambda *v: jnp.stack(v), *worlds)
    mask = jnp.ones(NUM_PROPOSALS, bool)

    def one(args):
        states, forecast = args
        return score_trajectories(states, mask, grid_world(forecast), VEHICLE, PARAMS)

    compiled = jax.jit(one)
    expected = jax.tree.map(lambda *v: jnp.stack(v), *(compiled(world) for world in worlds))
    close(jax.jit(jax.vmap(one))(batch), expected)


@pytest.mark.slow
def test_eager_scores_are_the_compiled_ones():
    rng = np.random.default_rng(0)
    states = random_states(rng)
    objects = random_objects(rng, states)
    mask = jnp.ones(NUM_PROPOSALS, bool)
    world = grid_world(forecast_of(objects))
    close(
        score_trajectories(state_of(states), mask, world, VEHICLE, PARAMS), score(states, objects)
    )


def close(ours: SubScores, theirs: SubScores) -> None:
    for name in SubScores.__dataclass_fields__:
        a, b = np.asarray(getattr(ours, name)), np.asarray(getattr(theirs, name))
        if a.dtype.kind == "f":
            np.testing.assert_allclose(a, b, atol=1e-9, err_msg=name)
        else:
            np.testing.assert_array_equal(a, b, err_msg=name)
