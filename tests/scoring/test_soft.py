"""The parts of the smooth score against their hard counterparts, and their gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from scorer_world import (
    DRIVABLE,
    NUM_OBJECTS,
    NUM_PROPOSALS,
    ON_ROUTE,
    forecast_of,
    grid_world,
    random_objects,
    random_states,
    state_of,
)
from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.geometry import Box, box_at, boxes_overlap
from spdm_jax.io.grid import polygon_edges
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.scoring.comfort import comfort_flags
from spdm_jax.scoring.driving import driving_direction
from spdm_jax.scoring.score import score_trajectories
from spdm_jax.scoring.smooth import FAR, SHARPNESS, safe_sqrt, soft_min
from spdm_jax.scoring.soft import (
    SoftWorld,
    comfort_margin,
    relative_progress,
    soft_direction,
    soft_score_trajectories,
)
from spdm_jax.scoring.soft_areas import Layer, inside_margin
from spdm_jax.scoring.soft_contacts import separation
from spdm_jax.types import EgoState, Polygons

VEHICLE, PARAMS = VehicleParams(), ScoringParams()
TERMS = (
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "progress",
    "progress_raw",
    "total",
)


def polygons_of(shapes: list, room: int = 0, dtype=np.float64) -> Polygons:
    """Edges of shapes, with `room` padded polygons behind them."""
    edges, rows = polygon_edges(shapes)
    count = np.bincount(rows, minlength=len(shapes) + room).astype(np.int32)
    spare = np.zeros((room, 4))
    edges = np.concatenate([edges, spare]).astype(dtype)
    return Polygons(
        xy=jnp.asarray(edges[:, :2]),
        next_xy=jnp.asarray(edges[:, 2:]),
        row=jnp.asarray(np.concatenate([rows, np.zeros(room, int)]), jnp.int32),
        valid=jnp.asarray(np.arange(len(edges)) < len(rows)),
        start=jnp.asarray(np.cumsum(count) - count, jnp.int32),
        count=jnp.asarray(count),
    )


def soft_world(objects: dict, dtype=np.float64) -> SoftWorld:
    flags = lambda *values: jnp.asarray(values)
    return SoftWorld(
        hard=grid_world(forecast_of(objects, dtype), dtype),
        lanes=polygons_of(DRIVABLE[:4], room=2, dtype=dtype),
        car_parks=polygons_of(DRIVABLE[4:], dtype=dtype),
        lane_drivable=flags(*[True] * 4, False, False),
        park_drivable=flags(True),
        lane_on_route=flags(*ON_ROUTE[:4].tolist(), False, False),
    )


_soft = jax.jit(soft_score_trajectories)
_hard = jax.jit(score_trajectories)
ALL = jnp.ones(NUM_PROPOSALS, bool)


@partial(jax.jit, static_argnums=0)
def gradient(name: str, states: EgoState, valid, world: SoftWorld, temperature) -> EgoState:
    of = lambda s: soft_score_trajectories(s, valid, world, VEHICLE, PARAMS, temperature)
    return jax.grad(lambda s: getattr(of(s), name).sum())(states)


# Smooth minimum and root


def test_soft_min_lies_just_below_the_minimum():
    margin = np.random.default_rng(0).normal(0, 3, (50, 164))
    found = np.asarray(soft_min(jnp.asarray(margin), 1))
    assert (found <= margin.min(1)).all()
    assert (found >= margin.min(1) - np.log(164) / SHARPNESS).all()
    same = soft_min(jnp.full((1, 100), 2.0), 1)
    assert float(same[0]) == pytest.approx(2 - np.log(100) / SHARPNESS)


def test_soft_min_ignores_what_is_masked():
    margin = jnp.asarray([1.0, -5.0, 2.0])
    some = jnp.asarray([True, False, True])
    assert float(soft_min(margin, 0, some)) == pytest.approx(1, abs=1e-4)
    grad = jax.grad(lambda m: soft_min(m, 0, some))(margin)
    assert grad[1] == 0 and grad[0] > 0.99
    none = jnp.zeros(3, bool)
    value, grad = jax.value_and_grad(lambda m: soft_min(m, 0, none))(margin)
    assert value > 0.99 * FAR and not grad.any()


def test_root_has_no_endless_gradient():
    value, grad = jax.vmap(jax.value_and_grad(safe_sqrt))(jnp.asarray([0.0, 4.0]))
    np.testing.assert_allclose(value, [0, 2])
    np.testing.assert_allclose(grad, [0, 0.25])


# Separations


def random_boxes(rng: np.random.Generator, num: int) -> Box:
    draw = lambda low, high: jnp.asarray(rng.uniform(low, high, num))
    return box_at(draw(-4, 4), draw(-4, 4), draw(-4, 4), draw(0, 3), draw(0, 2))


def test_separation_is_negative_exactly_where_boxes_overlap():
    rng = np.random.default_rng(1)
    a, b = random_boxes(rng, 3000), random_boxes(rng, 3000)
    overlap = np.asarray(boxes_overlap(a, b))
    np.testing.assert_array_equal(np.asarray(separation(a, b)) <= 0, overlap)
    assert 500 < overlap.sum() < 2500


def test_separation_of_aligned_boxes():
    a, b = box_at(0.0, 0.0, 0.0, 2.0, 1.0), box_at(5.0, 0.5, 0.0, 2.0, 1.0)
    gap, slope = jax.value_and_grad(lambda x: separation(a, b._replace(x=x)))(5.0)
    assert float(gap) == pytest.approx(1) and float(slope) == pytest.approx(1)
    grads = jax.grad(lambda x, y: separation(a, a._replace(x=x, y=y)), (0, 1))(0.0, 0.0)
    assert np.isfinite(grads).all()  # one upon the other


# Areas


SQUARES = [shapely.box(0, 0, 4, 4), shapely.box(4, 0, 8, 4), shapely.box(3, 2, 6, 7)]
HOLE = shapely.box(10, 0, 20, 10).difference(shapely.box(13, 3, 17, 7))


_margin = jax.jit(inside_margin)


def margin_at(points, temperature: float, shapes=None, counts=None) -> jax.Array:
    shapes = [*SQUARES, HOLE] if shapes is None else shapes
    flags = jnp.ones(len(shapes), bool) if counts is None else jnp.asarray(counts)
    x, y = jnp.asarray(points, float).T
    layer = Layer(polygons_of(shapes, room=1), jnp.append(flags, False))
    return _margin((layer,), x, y, jnp.asarray(temperature))


def test_margin_says_inside_or_outside():
    points = np.random.default_rng(2).uniform([-2, -2], [22, 12], (2000, 2))
    union = shapely.union_all([*SQUARES, HOLE])
    inside = shapely.contains_xy(union, *points.T)
    margin = np.asarray(margin_at(points, 1e-3))
    far = shapely.distance(shapely.points(points), union.boundary) > 0.02
    np.testing.assert_array_equal(margin[far] > 5, inside[far])
    np.testing.assert_array_equal(margin[far] < -5, ~inside[far])
    assert far.mean() > 0.95 and 300 < inside.sum() < 1700


def test_margin_is_the_distance_over_the_temperature():
    points = [(-3.0, 2.0), (0.5, 1.0), (15.0, 2.0), (15.0, 3.5), (-3.0, -4.0)]
    found = margin_at(points, 1.0, shapes=[SQUARES[0], HOLE])
    np.testing.assert_allclose(found, [-3, 0.5, 1, -0.5, -5], atol=0.01)


def test_neighbours_have_no_seam():
    seam = np.stack([np.linspace(3.5, 4.5, 21), np.full(21, 1.0)], 1)
    assert (np.asarray(margin_at(seam, 0.2, shapes=SQUARES[:2])) > 4.5).all()
    alone = np.asarray(margin_at(seam, 0.2, shapes=SQUARES[:2], counts=[True, False]))
    assert abs(alone[10]) < 0.01  # the seam is an end where the neighbour does not count


def test_nothing_to_be_inside_of():
    margin, grad = jax.value_and_grad(lambda p: margin_at(p, 0.1, counts=[False] * 4).sum())(
        jnp.ones((1, 2))
    )
    assert margin < -1e5 and np.isfinite(grad).all()


def test_margin_has_the_gradient_of_its_finite_differences():
    points = np.random.default_rng(3).uniform([-1, -1], [21, 11], (200, 2))
    grad = np.asarray(jax.grad(lambda p: margin_at(p, 0.5).sum())(jnp.asarray(points)))
    step = 1e-6
    for axis in range(2):
        move = np.eye(2)[axis] * step
        slope = (margin_at(points + move, 0.5) - margin_at(points - move, 0.5)) / (2 * step)
        np.testing.assert_allclose(grad[:, axis], slope, rtol=1e-4, atol=1e-4)
    assert (np.abs(grad).max(1) > 0.5).mean() > 0.5
    on_edge = jax.grad(lambda p: margin_at(p, 0.5).sum())(jnp.asarray([[0.0, 2.0], [0.0, 0.0]]))
    assert np.isfinite(on_edge).all()


# Direction, comfort, progress


def test_direction_counts_uninterrupted_ways():
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.uniform(0, 0.5, (64, 41)), 1)
    y = np.cumsum(rng.normal(0, 0.1, (64, 41)), 1)
    oncoming = rng.random((64, 41)) < rng.choice([0.5, 0.9, 0.97], (64, 1))
    hard = driving_direction(jnp.asarray(x), jnp.asarray(y), jnp.asarray(oncoming), PARAMS)
    share = jnp.asarray(oncoming, float)
    soft = soft_direction(jnp.asarray(x), jnp.asarray(y), share, PARAMS, jnp.asarray(1e-4))
    np.testing.assert_allclose(soft, hard, atol=1e-3)
    assert set(np.unique(hard)) == {0.0, 0.5, 1.0}


def test_comfort_margin_has_the_sign_of_the_flags():
    states = random_states(np.random.default_rng(5), 64)
    calm = np.random.default_rng(6).uniform(0, 1, (64, 1))
    states[..., 5], states[..., 6] = states[..., 5] * calm, states[..., 6] * calm
    states[..., 2] *= calm
    ego = state_of(states)
    margin = np.asarray(comfort_margin(ego, PARAMS, jnp.asarray(1e-5)))
    fine = np.asarray(comfort_flags(ego, PARAMS)).all(1)
    np.testing.assert_array_equal(margin > 0, fine)
    assert 5 < fine.sum() < 59


@pytest.mark.parametrize("way", [20.0, 0.05], ids=["moving", "nobody moved"])
def test_progress_is_normalised_like_the_hard_one(way: float):
    rng = np.random.default_rng(7)
    multiplier = jnp.asarray(rng.choice([0, 0.25, 0.5, 1], 40))
    raw = jnp.asarray(rng.uniform(0, way, 40))
    half = jnp.full(40, 0.5)
    hard = aggregate(multiplier, raw, half, half, jnp.ones(40, bool), PARAMS)
    soft = relative_progress(multiplier, raw, PARAMS, jnp.asarray(1e-3))
    np.testing.assert_allclose(soft, hard.progress, atol=1e-9)


# All terms together


def test_scores_converge_in_random_worlds():
    """As the temperature falls, every term ends at the hard one, whatever happens in the world."""
    gaps: list[dict[str, np.ndarray]] = []
    values: dict[str, set[float]] = {name: set() for name in TERMS}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        states = random_states(rng)
        # Smoother than random states are, so that comfort is kept by some.
        states[::2, :, 5:7] = 0.0
        states[::2, :, 2] = states[::2, :1, 2]
        world = soft_world(random_objects(rng, states))
        ego = state_of(states)
        hard = _hard(ego, ALL, world.hard, VEHICLE, PARAMS)
        difference = lambda name, soft, hard=hard: np.abs(getattr(soft, name) - getattr(hard, name))
        soft = [_soft(ego, ALL, world, VEHICLE, PARAMS, jnp.asarray(t)) for t in (1.0, 0.1, 1e-4)]
        for name in TERMS:
            values[name] |= set(np.unique(np.round(getattr(hard, name), 6)).tolist())
            gaps.append({name: np.stack([difference(name, s) for s in soft])})
    for name in TERMS:
        gap = np.concatenate([g[name] for g in gaps if name in g], axis=1)
        assert len(values[name]) > 1, name
        # Within a few 1e-4 m of a threshold; of 480 proposals at most two.
        assert (gap[2] > 1e-3).sum() <= 2, (name, (gap[2] > 1e-3).sum())
        assert gap[2].mean() <= gap[1].mean() <= gap[0].mean(), name


def test_padding_and_absent_objects_change_nothing():
    rng = np.random.default_rng(20)
    states = random_states(rng)
    objects = random_objects(rng, states)
    garbage = np.copy(states)
    garbage[-2:] = random_states(np.random.default_rng(21))[:2] * 3
    garbage[-2:, -1, 0] = 1000.0  # the way of a rocket
    counts = ALL.at[-2:].set(False)
    run = lambda s, o: _soft(state_of(s), counts, soft_world(o), VEHICLE, PARAMS, jnp.asarray(0.2))
    wanted, found = run(states, objects), run(garbage, objects)
    for name in TERMS:
        np.testing.assert_array_equal(getattr(found, name)[:-2], getattr(wanted, name)[:-2])
    assert not found.total[-2:].any() and not found.progress[-2:].any()
    absent = dict(objects, present=objects["present"] & (np.arange(NUM_OBJECTS) < 4))
    moved = dict(absent, x=absent["x"].copy(), length=absent["length"].copy())
    moved["x"][4:], moved["length"][4:] = 3.0, 50.0
    a, b = run(states, absent), run(states, moved)
    for name in TERMS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def odd_states() -> np.ndarray:
    """Standing, creeping, turning on the spot, upon an object, far off the map, backwards."""
    states = np.zeros((NUM_PROPOSALS, 41, 11))
    time = np.arange(41) * 0.1
    states[1, :, 0], states[1, :, 3] = 1e-7 * time, 1e-7
    states[2, :, 2] = time
    states[3, :, 0] = 5.0
    states[4, :, :2] = 1e4
    states[5, :, 0], states[5, :, 3] = -3 * time, -3
    states[6, :, 0], states[6, :, 3] = 8 * time, 8
    states[7, :, 1] = 1.75  # on the edge between two lanes
    return states


def odd_objects(num: int = NUM_OBJECTS) -> dict:
    """Objects that stand exactly where proposals are, one without any size."""
    rng = np.random.default_rng(0)
    objects = random_objects(rng, odd_states(), num)
    objects["x"][:], objects["y"][:], objects["heading"][:] = 0.0, 0.0, 0.0
    objects["x"][:2], objects["x"][2] = VEHICLE.rear_axle_to_center, 5.0
    objects["length"][1], objects["width"][1] = 0.0, 0.0
    return dict(objects, present=np.ones(num, bool), ignored=np.zeros(num, bool))


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("present", [True, False], ids=["overlap", "no objects"])
def test_gradients_are_finite_in_odd_places(dtype: type, present: bool):
    """Also: float32 stays float32 where 64-bit types are on."""
    objects = odd_objects()
    objects["present"] &= present
    world, states = soft_world(objects, dtype), state_of(odd_states(), dtype)
    for counts in (ALL, ~ALL):
        for temperature in (1e-3, 0.1, 10.0):
            grad = gradient("total", states, counts, world, jnp.asarray(temperature, dtype))
            for leaf in jax.tree.leaves(grad):
                assert leaf.dtype == dtype
                assert np.isfinite(leaf).all()
                assert counts.any() or not leaf.any()
