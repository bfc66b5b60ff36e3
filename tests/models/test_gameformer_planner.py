"""GameFormer's reference path and speed refinement on a straight two-lane road."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_jax.geometry import box_at
from spdm_models.gameformer_paths import (
    Boundaries,
    ReferencePath,
    annotate,
    cheapest_course,
    discourage_lane_change,
    path_costs,
    path_objects,
)
from spdm_models.gameformer_refine import occupancy, plan_on_path, refine
from spdm_models.lattice import Polyline, spline_course

LANE_WIDTH = 3.5
POINTS = 200
STEPS, ROWS, MODES = 80, 1200, 2
EGO = tuple(jnp.asarray(v) for v in (0.0, 0.0, 0.0))
AWAY = (500.0, 0.0)

_costs = jax.jit(path_costs)
_cheapest = jax.jit(cheapest_course)
_annotate = jax.jit(annotate)
_refine = jax.jit(refine)
_occupancy = jax.jit(occupancy)


def make_lines(counts=(POINTS, POINTS)) -> Polyline:
    """The ego's lane and the one left of it, along +x from x = 0."""
    x = np.broadcast_to(0.25 * np.arange(POINTS), (2, POINTS))
    y = np.broadcast_to(LANE_WIDTH * np.arange(2)[:, None], (2, POINTS))
    return make_polyline(x, y, np.zeros((2, POINTS)), counts)


def make_polyline(x, y, heading, count) -> Polyline:
    return Polyline(*map(jnp.asarray, (x, y, heading)), count=jnp.asarray(count, jnp.int32))


def make_boundaries(right: float) -> Boundaries:
    """One long edge on the right of each lane's road at the given y, and a padded one."""
    row = np.array([[0.0, 0.0]] * 2)
    return Boundaries(
        ax=row, ay=row + right, bx=row + 100, by=row + right, valid=np.array([[True, False]] * 2)
    )


def boxes(*centers):
    x, y = (np.array(v, float) for v in zip(*centers, strict=True))
    return box_at(*map(jnp.asarray, (x, y, 0 * x, 0 * x + 2.3, 0 * x + 1.0)))


def price(obstacle=AWAY, vehicle=AWAY, right=-5.0, lines=None):
    flags = np.array([True, False])
    lines = make_lines() if lines is None else lines
    valid = np.ones(2, bool)
    given = boxes(obstacle, vehicle)
    return _costs(lines, valid, EGO, given, flags, ~flags, make_boundaries(right))


def test_each_term_looks_at_its_objects():
    free = price()
    assert not np.any(free.hits_obstacle) and not np.any(free.leaves_boundary)
    assert np.all(free.lane_free) and np.all(free.valid)
    np.testing.assert_allclose(free.distance, [0, LANE_WIDTH])
    np.testing.assert_allclose(free.curvature[0], 0, atol=1e-9)
    blocked = price(obstacle=(18.0, 0.0))
    assert np.all(blocked.hits_obstacle[0]) and not np.any(blocked.hits_obstacle[1, :2])
    busy = price(vehicle=(18.0, LANE_WIDTH))
    assert not np.any(busy.lane_free[1]) and not np.any(busy.hits_obstacle)
    edge = price(right=-1.0)
    assert np.all(edge.leaves_boundary)
    assert not np.any(price(right=-1.2).leaves_boundary)


def test_the_cheapest_path_passes_the_obstacle_unless_lane_changes_are_discouraged():
    blocked = price(obstacle=(18.0, 0.0))
    for stay, y_end in ((False, LANE_WIDTH), (True, 0.0)):
        course, found = _cheapest(make_lines(), EGO, blocked.total(jnp.asarray(stay)))
        assert bool(found)
        np.testing.assert_allclose(course.y[400], y_end, atol=1e-6)
    none, found = _cheapest(make_lines(), EGO, jnp.full((2, 4), jnp.inf))
    assert not bool(found)
    assert np.isfinite(none.x).all()


def test_short_lanes_are_left_out_where_there_is_a_longer_one():
    short = price(lines=make_lines((POINTS, 80)))
    assert np.all(short.valid[0]) and not np.any(short.valid[1])
    # A lane that ends early does not count as free; with none longer it does.
    ends = price(lines=make_lines((POINTS, 150)))
    assert np.all(ends.lane_free[0]) and not np.any(ends.lane_free[1])
    both = price(lines=make_lines((80, 80)))
    assert np.any(both.valid[1]) and np.all(both.lane_free)


def test_objects_are_told_apart():
    objects = boxes((10.0, 0), (10.0, 0), (10.0, 0), (10.0, 0), (50.0, 0))
    vehicle = np.array([True, True, False, False, True])
    static = np.array([False, False, True, False, False])
    speed = np.array([0.0, 3.0, 0.0, 1.0, 0.0])
    vehicle, static, speed = (jnp.asarray(v) for v in (vehicle, static, speed))
    obstacle, moving = path_objects(objects, vehicle, static, speed, boxes((0.0, 0.0)))
    assert obstacle.tolist() == [True, False, True, False, False]
    assert moving.tolist() == [False, True, False, False, False]


def test_lane_changes_are_discouraged_at_lights_and_on_wide_slow_roads():
    ask = lambda *v: bool(discourage_lane_change(*map(jnp.asarray, v)))
    assert ask(True, 1, 20.0) and ask(False, 4, 3.0)
    assert not ask(False, 4, 3.1) and not ask(False, 3, 0.0)


def test_annotations_slow_down_for_turns_and_mark_red_connectors():
    angle = np.linspace(0, np.pi / 2, 20)
    x = np.concatenate([np.arange(0, 30, 2.5), 30 + 6 * np.sin(angle)])
    y = np.concatenate([np.zeros(12), 6 - 6 * np.cos(angle)])
    course = spline_course(jnp.asarray(x), jnp.asarray(y), jnp.asarray(len(x)))
    red = make_polyline(
        np.stack([20 + 0.1 * np.arange(100)] * 3),
        np.stack([np.full(100, v) for v in (0.3, 0.3, 5.0)]),
        np.zeros((3, 100)),
        (100, 60, 0),
    )
    ours = _annotate(course, jnp.asarray(True), jnp.asarray(40.0), red)
    assert float(ours.speed_limit[0]) == 15 and float(ours.speed_limit[-1]) == 3
    assert float(_annotate(course, jnp.asarray(True), jnp.asarray(1.0), red).speed_limit[0]) == 3
    rows = np.flatnonzero(ours.red_light)
    assert rows[0] in (196, 197) and rows[-1] > 295
    none = _annotate(course, jnp.asarray(True), jnp.asarray(9.0), red.replace(count=red.count * 0))
    assert not np.any(none.red_light)


def make_reference(valid=True, red=slice(0)) -> ReferencePath:
    path = np.zeros((ROWS, 3))
    path[:, 0] = 0.1 * np.arange(ROWS)
    light = np.zeros(ROWS, bool)
    light[red] = True
    return ReferencePath(
        path=path,
        curvature=np.zeros(ROWS),
        speed_limit=np.full(ROWS, 12.0),
        red_light=light,
        valid=np.array(valid),
    )


def make_agents(x: float, y: float, present=True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One standing agent whose second mode is the better one, and one that is missing."""
    modes = np.full((2, MODES, STEPS, 2), 90.0)
    modes[0, 1] = (x, y)
    now = np.zeros((2, 11))
    now[0, [0, 1, 6, 7]] = (x, y, 4.6, 2.0)
    return modes, np.array([[0.0, 1.0]] * 2), now * present


def cells(x, y=0.0, present=True, red=slice(0)) -> jax.Array:
    return _occupancy(*make_agents(x, y, present), make_reference(red=red))


def test_agents_on_the_path_occupy_their_length_and_3_m_behind():
    occupied = cells(30.0)
    assert occupied.shape == (STEPS, ROWS // 10)
    assert np.all(occupied == occupied[0])
    assert np.flatnonzero(occupied[0]).tolist() == list(range(24, 33))
    for free in (cells(30.0, present=False), cells(30.0, y=2.5), cells(0.0), cells(-3.0)):
        assert not free.any()
    assert np.flatnonzero(cells(30.0, present=False, red=slice(500, 511))[0]).tolist() == [50, 51]


def plan_at(speed: float) -> jax.Array:
    plan = np.zeros((STEPS, 3))
    plan[:, 0] = 0.1 * speed * np.arange(1, STEPS + 1)
    return jnp.asarray(plan)


def test_refinement_brakes_for_occupied_cells_ahead():
    args = plan_at(8.0), jnp.asarray(8.0), jnp.asarray(0.0), make_reference()
    free = _refine(*args, cells(200.0))
    np.testing.assert_allclose(np.diff(free.poses[:, 0]), 0.8, atol=0.3)
    # Cells 26 to 34, where the front would be after 3 s, the last time that counts.
    held = _refine(*args, cells(32.0))
    assert float(held.solution.objective) < 0.1 * float(held.solution.objectives[0])
    assert float(held.arc[29]) + 4.049 < 26.5 < float(free.arc[29]) + 4.049
    assert np.min(held.speed) >= 0


def test_without_a_reference_path_the_plan_stays():
    args = plan_at(8.0), jnp.asarray(8.0), jnp.asarray(0.0), make_reference(valid=False)
    ours = _refine(*args, cells(20.0))
    np.testing.assert_array_equal(ours.poses, plan_at(8.0))


def test_speeds_on_the_path_are_whole_rows():
    start = plan_on_path(plan_at(7.3), jnp.asarray(make_reference().path))
    assert set(np.round(np.asarray(start.speed), 9)) == {7.0, 8.0}
    assert int(start.row[-1]) == 584


def test_short_plans_are_an_error():
    with pytest.raises(ValueError, match="needs 30"):
        refine(plan_at(8.0)[:20], EGO[0], EGO[0], make_reference(), cells(20.0))
