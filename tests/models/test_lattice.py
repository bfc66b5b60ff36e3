"""Paths from the ego onto centre lines, their costs and their splines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.geometry import box_at
from spdm_models.lattice import (
    EGO_HALF_WIDTH,
    NUM_TARGETS,
    Polyline,
    lattice_paths,
    max_curvature,
    spline_course,
    swept_path_hits,
)

POINTS, KNOTS, ROWS = 130, 14, 400
curvature_of = jax.jit(max_curvature)
hits = jax.jit(swept_path_hits)


def on_host(function, static=()):
    """Results as NumPy arrays: slices of device arrays compile, each size anew."""
    compiled = jax.jit(function, static_argnums=static)
    return lambda *args: jax.tree.map(np.asarray, compiled(*args))


lattice = on_host(lattice_paths)
course = on_host(spline_course, static=3)


def straight_line(count: int, filler: float = 0.0, y: float = 0.0) -> Polyline:
    x = np.full(POINTS, filler)
    x[:count] = 0.25 * np.arange(count)
    rest = np.where(np.arange(POINTS) < count, 0.0, filler)
    return Polyline(jnp.asarray(x), jnp.asarray(rest + y), jnp.asarray(rest), jnp.int32(count))


def at(x: float, y: float, heading: float) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(v, jnp.float64) for v in (x, y, heading))


def test_on_the_line_the_path_is_the_line():
    found = lattice(straight_line(POINTS), *at(2.5, 0, 0))
    assert found.valid.all()
    assert float(found.distance) == 0
    for k in range(NUM_TARGETS):
        count = int(found.count[k])
        assert count == POINTS - 10 - 1 - k
        np.testing.assert_allclose(found.y[k, :count], 0, atol=1e-12)
        assert np.all(np.diff(found.x[k, :count]) > 0)
        assert float(found.x[k, count - 1]) == float(0.25 * (POINTS - 1))


def test_beside_the_line_the_path_starts_at_the_ego_and_joins_the_line():
    found = lattice(straight_line(POINTS, y=1.5), *at(1.0, 0, 0.1))
    assert float(found.distance) == pytest.approx(1.5)
    for k in range(NUM_TARGETS):
        end = 20 * (k + 1)
        assert (found.x[k, 0], found.y[k, 0]) == (1.0, 0.0)
        np.testing.assert_allclose(found.y[k, end - 1 : found.count[k]], 1.5, atol=1e-12)
        slope = np.arctan2(found.y[k, 1], found.x[k, 1] - 1.0)
        assert slope == pytest.approx(0.1, abs=0.05)


@pytest.mark.parametrize("count, targets", [(1, 1), (21, 1), (22, 1), (42, 2), (62, 3), (82, 4)])
def test_short_lines_have_fewer_paths(count: int, targets: int):
    found = lattice(straight_line(count), *at(0, 0, 0))
    assert int(found.valid.sum()) == targets
    assert found.valid[:targets].all()


def test_padding_changes_no_path():
    one, other = (lattice(straight_line(70, filler), *at(1.1, 0.4, 0)) for filler in (0.0, 3.0))
    for k in range(3):
        count = int(one.count[k])
        assert count == int(other.count[k])
        np.testing.assert_array_equal(one.x[k, :count], other.x[k, :count])
        np.testing.assert_array_equal(one.y[k, :count], other.y[k, :count])


@given(st.floats(8.0, 60.0), st.integers(8, KNOTS), st.floats(-3.0, 3.0))
def test_a_circle_keeps_its_curvature(radius: float, count: int, start: float):
    angle = start + 2.5 / radius * np.arange(KNOTS)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    x[count:], y[count:] = 7.0, -7.0
    found = course(jnp.asarray(x), jnp.asarray(y), jnp.int32(count), ROWS)
    rows = int(found.count)
    chord = 2 * radius * np.sin(1.25 / radius)
    assert abs(rows - chord * (count - 1) / 0.1) <= 1 + 1e-6
    away = np.hypot(found.x[:rows], found.y[:rows])
    # Natural ends have no curvature: the spline cuts the corner there, less than a chord would.
    assert np.max(np.abs(away - radius)) < 2.5**2 / (8 * radius)
    inner = slice(rows // 2 - 3, rows // 2 + 3)
    np.testing.assert_allclose(found.curvature[inner], 1 / radius, rtol=0.1)
    np.testing.assert_array_equal(found.x[rows:], found.x[rows - 1])


def test_a_course_goes_through_its_knots():
    x = np.linspace(0, 20, KNOTS)
    y = np.sin(0.3 * x)
    found = course(jnp.asarray(x), jnp.asarray(y), jnp.int32(KNOTS), ROWS)
    arc = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    for s, px, py in zip(arc[:-1], x, y, strict=False):
        row = int(s / 0.1)
        assert np.hypot(found.x[row] - px, found.y[row] - py) < 0.1
    heading = np.arctan2(np.diff(found.y[:150]), np.diff(found.x[:150]))
    np.testing.assert_allclose(found.heading[:149], heading, atol=0.02)


def test_curvature_of_a_circle():
    angle = 0.25 / 12 * np.arange(POINTS)
    x, y = jnp.asarray(12 * np.cos(angle)), jnp.asarray(12 * np.sin(angle))
    assert float(curvature_of(x, y, jnp.int32(POINTS))) == pytest.approx(1 / 12, rel=1e-2)
    spoilt = y.at[50:].set(90.0)
    assert float(curvature_of(x, spoilt, jnp.int32(50))) == pytest.approx(1 / 12, rel=1e-2)
    assert float(curvature_of(jnp.zeros(POINTS), jnp.zeros(POINTS), jnp.int32(50))) == 0


def test_swept_path_agrees_with_shapely():
    random = np.random.default_rng(3)
    boxes = 60
    for count in (10, 4, 2):
        heading = np.cumsum(random.uniform(-0.3, 0.3, 10))
        x, y = np.cumsum(2.5 * np.cos(heading)), np.cumsum(2.5 * np.sin(heading))
        px, py = random.uniform(-6, 28, boxes), random.uniform(-9, 9, boxes)
        turn = random.uniform(-3, 3, boxes)
        length, width = random.uniform(0.3, 5, boxes), random.uniform(0.3, 2.5, boxes)
        strip = shapely.LineString(np.stack([x, y], -1)[:count]).buffer(
            EGO_HALF_WIDTH, cap_style="square", quad_segs=64
        )
        present = random.random(boxes) < 0.9
        given_boxes = box_at(*(jnp.asarray(v) for v in (px, py, turn, length / 2, width / 2)))
        found = hits(
            jnp.asarray(x), jnp.asarray(y), jnp.int32(count), given_boxes, jnp.asarray(present)
        )
        for i in range(boxes):
            shape = shapely.box(-length[i] / 2, -width[i] / 2, length[i] / 2, width[i] / 2)
            shape = shapely.affinity.rotate(shape, turn[i], (0, 0), use_radians=True)
            shape = shapely.affinity.translate(shape, px[i], py[i])
            clear = abs(strip.boundary.distance(shape.boundary)) > 5e-3
            if clear or not present[i]:
                assert bool(found[i]) == (present[i] and strip.intersects(shape))
