"""Strips along paths and vehicles on them, against shapely's buffers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from spdm_jax.geometry import Box
from spdm_jax.simulation.shapes import (
    WIDTH,
    one_box,
    outline_shape,
    run_circles,
    shape_circle,
    shapes_distance,
    strip_meets,
    vehicle_shape,
)

SIZE = 33
FAR = 1e3


def line(rng: np.random.Generator) -> np.ndarray:
    """A gently bending polyline of 2 to 30 points."""
    num = int(rng.integers(2, 30)) - 1
    step, heading = rng.uniform(0.3, 2, num), np.cumsum(rng.normal(0, 0.05, num))
    heading += rng.uniform(-np.pi, np.pi)
    ways = np.stack([step * np.cos(heading), step * np.sin(heading)], 1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(ways, 0)]) + rng.uniform(-15, 15, 2)


def filled(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.repeat(points[-1:], SIZE - len(points), 0)])


def body_at(points: np.ndarray, half_width: float) -> tuple[np.ndarray, shapely.Polygon]:
    x, y = points[0]
    heading = np.arctan2(*(points[1] - points[0])[::-1])
    box = np.array([x, y, np.cos(heading), np.sin(heading), 2.3, half_width])
    ring = shapely.box(-2.3, -half_width, 2.3, half_width)
    turn = np.array([[box[2], box[3]], [-box[3], box[2]]])
    return box, shapely.transform(ring, lambda xy: xy @ turn + [x, y])


@jax.jit
def compare(a, b, half_a, half_b, body_a, body_b):
    first = vehicle_shape(a[:, 0], a[:, 1], half_a, Box(*body_a))
    second = vehicle_shape(b[:, 0], b[:, 1], half_b, Box(*body_b))
    circles = run_circles(a[:, 0], a[:, 1], half_a)
    met = strip_meets(a[:, 0], a[:, 1], half_a, circles, second, shape_circle(second))
    return shapes_distance(first, second, jnp.asarray(FAR, a.dtype)), met


@pytest.mark.parametrize("dtype, tolerance", [(jnp.float64, 2e-4), (jnp.float32, 1e-3)])
def test_vehicles_are_as_far_apart_as_buffered_lines(dtype, tolerance: float):
    rng = np.random.default_rng(1)
    met = 0
    for _ in range(80):
        a, b = line(rng), line(rng)
        half_a, half_b = rng.uniform(0.8, 1.3, 2)
        (body_a, area_a), (body_b, area_b) = body_at(a, half_a), body_at(b, half_b)
        strip = shapely.LineString(a).buffer(half_a, cap_style="flat")
        other = shapely.LineString(b).buffer(half_b, cap_style="flat").union(area_b)
        expected, touches = strip.union(area_a).distance(other), strip.intersects(other)
        given = (filled(a), filled(b), half_a, half_b, body_a, body_b)
        distance, hit = compare(*(jnp.asarray(v, dtype) for v in given))
        assert distance.dtype == dtype
        assert abs(float(distance) - expected) < tolerance
        if abs(strip.distance(other)) > 1e-3 or touches:
            assert bool(hit) == touches
        met += touches
    assert 5 < met < 75


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_what_touches_by_a_centimetre_meets(dtype):
    """A small box, and a small strip, along one side of every strip: bounds must not lose it."""
    rng = np.random.default_rng(7)
    half, overlap = 0.3, 0.01

    @jax.jit
    def both(a, half_a, probe, body, away):
        xy = lambda points: (points[:, 0], points[:, 1])
        box = one_box(Box(*body))
        circles = run_circles(*xy(a), half_a)
        by_box = strip_meets(*xy(a), half_a, circles, box, shape_circle(box))
        shape = vehicle_shape(*xy(a), half_a, Box(*away))
        circles = run_circles(*xy(probe), body[5])
        return by_box, strip_meets(*xy(probe), body[5], circles, shape, shape_circle(shape))

    for _ in range(60):
        a, half_a, side = line(rng), rng.uniform(0.8, 1.3), rng.choice([-1, 1])
        k = rng.integers(len(a) - 1)
        way = (a[k + 1] - a[k]) / np.linalg.norm(a[k + 1] - a[k])
        aside = side * np.array([-way[1], way[0]])
        middle = 0.5 * (a[k] + a[k + 1]) + (half_a + half - overlap) * aside
        probe = filled(np.stack([middle - 0.1 * way, middle + 0.1 * way]))
        body = np.array([*middle, *way, 0.1, half])
        away = np.array([*(middle + 90 * aside), *way, 0.1, half])
        given = (filled(a), half_a, probe, body, away)
        assert all(both(*(jnp.asarray(v, dtype) for v in given)))


def test_a_strip_without_extent_meets_nothing():
    point = jnp.zeros(SIZE)
    circles = run_circles(point, point, jnp.asarray(1.0))
    assert np.all(np.asarray(circles[2]) < 0)
    one = jnp.asarray(1.0)
    box = one_box(Box(0 * one, 0 * one, one, 0 * one, one, one))
    assert not strip_meets(point, point, one, circles, box, shape_circle(box))


def test_outline_is_its_edges():
    ring = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 2.0], [3.0, 1.0], [0.0, 2.0]])
    edges = np.zeros((WIDTH, 4))
    edges[:5] = np.concatenate([ring, np.roll(ring, -1, 0)], 1)
    shape = outline_shape(jnp.asarray(edges), jnp.arange(WIDTH) < 5, 1)
    one = jnp.asarray(1.0)
    for x, y in ((3.0, 4.0), (9.0, -3.0), (3.0, 1.8), (20.0, 1.0)):
        box = one_box(Box(x * one, y * one, one, 0 * one, 0.3 * one, 0.2 * one))
        area = shapely.box(x - 0.3, y - 0.2, x + 0.3, y + 0.2)
        expected = shapely.Polygon(ring).distance(area)
        assert float(shapes_distance(box, shape, FAR * one)) == pytest.approx(expected, abs=1e-9)
    near = one_box(Box(20 * one, 0 * one, one, 0 * one, one, one))
    assert float(shapes_distance(near, shape, 2 * one)) == 2.0
