"""Boxes, segments, polygons and polylines against shapely on random input."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.geometry import (
    Box,
    Path,
    box_at,
    box_corners,
    box_distance,
    boxes_overlap,
    crosses_upward_ray,
    interpolate,
    make_path,
    point_segment_sq,
    principal,
    project,
    segment_box_distance,
    segment_meets_box,
    wrap,
)

seeds = st.integers(0, 2**32 - 1)
PAIRS = 64
MAX_POINTS = 16

_overlap, _distance = jax.jit(boxes_overlap), jax.jit(box_distance)
_meets, _segment_distance = jax.jit(segment_meets_box), jax.jit(segment_box_distance)
_project, _interpolate, _make_path = jax.jit(project), jax.jit(interpolate), jax.jit(make_path)


def random_boxes(rng: np.random.Generator, num: int = PAIRS) -> np.ndarray:
    """`[N, 5]` x, y, heading, half length, half width; some axis-aligned, some degenerate."""
    values = np.column_stack(
        [rng.uniform(-4, 4, (num, 2)), rng.uniform(-7, 7, num), rng.uniform(0.05, 4, (num, 2))]
    )
    values[: num // 4, 2] = rng.integers(-4, 5, num // 4) * np.pi / 2
    return values


def as_box(values: np.ndarray) -> Box:
    return box_at(*(jnp.asarray(values[:, i]) for i in range(5)))


def polygons(values: np.ndarray) -> Any:
    corners = np.stack([np.asarray(v) for v in box_corners(as_box(values))], -1)
    return shapely.polygons(corners)


@given(seeds)
def test_boxes_overlap_and_distance_agree_with_shapely(seed: int):
    rng = np.random.default_rng(seed)
    a, b = random_boxes(rng), random_boxes(rng)
    shapes = polygons(a), polygons(b)
    distance = shapely.distance(*shapes)
    depth = np.sqrt(shapely.area(shapely.intersection(*shapes)))
    clear = (distance > 1e-9) | (depth > 1e-6)
    hit = np.asarray(_overlap(as_box(a), as_box(b)))
    np.testing.assert_array_equal(hit[clear], (distance == 0)[clear])
    assert hit.any() and not hit.all()
    np.testing.assert_allclose(_distance(as_box(a), as_box(b)), distance, atol=1e-9)
    np.testing.assert_allclose(_distance(as_box(b), as_box(a)), distance, atol=1e-9)


@pytest.mark.parametrize("gap, touches", [(0.0, True), (-1e-9, True), (1e-9, False)])
def test_touching_boxes_overlap(gap: float, touches: bool):
    one = box_at(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1), jnp.ones(1), jnp.ones(1))
    other = one._replace(x=jnp.full(1, 2.0 + gap))
    assert bool(boxes_overlap(one, other)[0]) == touches


def test_corner_order_is_front_left_rear_left_rear_right_front_right():
    x, y = box_corners(box_at(1.0, 2.0, jnp.asarray(jnp.pi / 2), 3.0, 0.5))
    np.testing.assert_allclose(x, [0.5, 0.5, 1.5, 1.5])
    np.testing.assert_allclose(y, [5.0, -1.0, -1.0, 5.0])


@given(seeds)
def test_segments_against_boxes_agree_with_shapely(seed: int):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng)
    ends = rng.uniform(-6, 6, (PAIRS, 4))
    ends[:4, 2:] = ends[:4, :2]  # points
    ends[4:12, 3] = ends[4:12, 1]  # along an axis
    lines = shapely.linestrings(ends.reshape(-1, 2, 2))
    distance = shapely.distance(lines, polygons(boxes))
    arguments = [jnp.asarray(ends[:, i]) for i in range(4)]
    np.testing.assert_allclose(_segment_distance(*arguments, as_box(boxes)), distance, atol=1e-9)
    # A segment that ends on the boundary may fall either way by rounding.
    inside = shapely.length(shapely.intersection(lines, polygons(boxes)))
    clear = (distance > 1e-9) | (inside > 1e-6)
    meets = np.asarray(_meets(*arguments, as_box(boxes)))
    np.testing.assert_array_equal(meets[clear], (distance == 0)[clear])


@given(seeds)
def test_point_to_segment(seed: int):
    rng = np.random.default_rng(seed)
    a, b, p = rng.uniform(-5, 5, (3, PAIRS, 2))
    b[:3] = a[:3]
    square, t = point_segment_sq(*jnp.asarray(p).T, *jnp.asarray(a).T, *jnp.asarray(b).T)
    lines = shapely.linestrings(np.stack([a, b], 1))
    np.testing.assert_allclose(np.sqrt(square), shapely.distance(lines, shapely.points(p)))
    foot = a + np.asarray(t)[:, None] * (b - a)
    np.testing.assert_allclose(np.linalg.norm(foot - p, axis=1), np.sqrt(square), atol=1e-12)


@given(seeds)
def test_ray_parity_is_point_in_polygon(seed: int):
    rng = np.random.default_rng(seed)
    ring = np.round(rng.uniform(-5, 5, (int(rng.integers(3, 12)), 2)), int(rng.integers(0, 3)))
    points = rng.uniform(-5, 5, (100, 2))
    points[:50] = np.round(points[:50])  # as high as many vertices
    a, b = ring, np.roll(ring, -1, axis=0)
    crossing = crosses_upward_ray(*points.T[:, :, None], *a.T, *b.T)
    inside = np.asarray(crossing).sum(axis=1) % 2 == 1
    # Even-odd rule of a ring that may cross itself: symmetric difference of triangles.
    expected = np.zeros(len(points), bool)
    for i in range(len(ring)):
        triangle = shapely.Polygon([ring[0], a[i], b[i]])
        if triangle.area > 0:
            expected ^= shapely.contains_xy(triangle, points)
    edges: Any = shapely.linestrings(np.stack([np.repeat(ring[:1], len(ring), 0), a], 1))
    rim: Any = shapely.linestrings(np.stack([a, b], 1))
    lines: Any = np.concatenate([edges, rim])
    where: Any = shapely.points(points)
    away = shapely.distance(where[:, None], lines) > 1e-9
    clear = away.all(axis=1)
    np.testing.assert_array_equal(inside[clear], expected[clear])


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=20))
def test_angles_are_wrapped_into_their_intervals(angles: list[float]):
    values = jnp.asarray(angles, jnp.float64)
    for function in (wrap, principal):
        wrapped = np.asarray(function(values))
        np.testing.assert_allclose(np.cos(wrapped), np.cos(angles), atol=1e-12)
        np.testing.assert_allclose(np.sin(wrapped), np.sin(angles), atol=1e-12)
        assert np.all(np.abs(wrapped) <= np.pi + 1e-15)


def test_half_turns_keep_their_side():
    assert float(wrap(jnp.asarray(np.pi))) == np.pi
    assert float(principal(jnp.asarray(np.pi))) == -np.pi


def random_path(rng: np.random.Generator) -> tuple[np.ndarray, Path]:
    """A random walk with repeated points, padded; headings that run over pi."""
    count = int(rng.integers(2, MAX_POINTS + 1))
    turn = np.cumsum(rng.uniform(-1, 1, count)) + rng.uniform(-4, 4)
    steps = rng.uniform(0.5, 6, count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    points = np.cumsum(steps, axis=0)
    if count > 4:
        points[3] = points[2]
    padded = np.zeros((MAX_POINTS, 3))
    padded[:count, :2] = points
    padded[:count, 2] = np.arctan2(np.sin(turn), np.cos(turn))
    padded[count:] = rng.normal(size=(MAX_POINTS - count, 3))  # must not matter
    x, y, heading = jnp.asarray(padded).T
    path = make_path(x, y, heading, jnp.asarray(count, jnp.int32))
    return padded[:count], path


@given(seeds)
def test_projection_agrees_with_shapely(seed: int):
    rng = np.random.default_rng(seed)
    points, path = random_path(rng)
    line = shapely.LineString(points[:, :2])
    assert float(path.length) == pytest.approx(line.length)
    queries = points[rng.integers(len(points), size=40), :2] + rng.normal(size=(40, 2)) * 3
    ours = np.asarray(_project(path, *jnp.asarray(queries).T))
    found = shapely.line_interpolate_point(line, ours)
    distance = shapely.distance(line, shapely.points(queries))
    # Where two branches are equally near, either is right: compare distances, then arc lengths.
    np.testing.assert_allclose(shapely.distance(found, shapely.points(queries)), distance)
    other = shapely.line_locate_point(line, shapely.points(queries))
    same = np.abs(ours - other) < 1e-9
    assert same.mean() > 0.9


@given(seeds)
def test_interpolation_agrees_with_numpy(seed: int):
    rng = np.random.default_rng(seed)
    points, path = random_path(rng)
    chord = np.hypot(*np.diff(points[:, :2], axis=0).T)
    progress = np.concatenate([[0], np.cumsum(chord)])
    s = rng.uniform(-3, progress[-1] + 3, 150)
    x, y, heading = _interpolate(path, jnp.asarray(s))
    at = np.clip(s, 1e-5, progress[-1])
    np.testing.assert_allclose(x, np.interp(at, progress, points[:, 0]), atol=1e-9)
    np.testing.assert_allclose(y, np.interp(at, progress, points[:, 1]), atol=1e-9)
    turns = np.interp(at, progress, np.unwrap(points[:, 2]))
    # At a repeated point the heading may be either one's.
    away = np.min(np.abs(at[:, None] - progress[None]), axis=1) > 1e-6
    difference = np.asarray(heading) - turns
    np.testing.assert_allclose(np.cos(difference[away]), 1, atol=1e-12)
    assert np.all(np.abs(heading) <= np.pi)


@given(seeds)
def test_few_and_many_queries_find_the_same_pose(seed: int):
    rng = np.random.default_rng(seed)
    _, path = random_path(rng)
    s = jnp.asarray(rng.uniform(-1, float(path.length) + 1, 150))
    many, few = _interpolate(path, s), _interpolate(path, s[:40])
    for one, other in zip(many, few, strict=True):
        np.testing.assert_array_equal(one[:40], other)


def test_float32_stays_float32():
    values = random_boxes(np.random.default_rng(0)).astype(np.float32)
    box = box_at(*(jnp.asarray(values[:, i]) for i in range(5)))
    assert _distance(box, box).dtype == jnp.float32
    zero = jnp.zeros(4, jnp.float32)
    path = make_path(zero, zero, zero, jnp.asarray(2, jnp.int32))
    assert {v.dtype for v in _interpolate(path, jnp.ones(3, jnp.float32))} == {jnp.dtype("float32")}
    assert _project(path, *jnp.ones((2, 3), jnp.float32)).dtype == jnp.float32


@given(seeds)
def test_arc_length_never_decreases(seed: int):
    rng = np.random.default_rng(seed)
    chord = rng.uniform(0, 2, 1023) * (rng.random(1023) < 0.7)  # three in ten points repeat
    x = np.concatenate([[0], np.cumsum(chord)])
    for dtype, tolerance in ((jnp.float64, 1e-9), (jnp.float32, 2e-3)):
        values = jnp.asarray(x, dtype), jnp.zeros(1024, dtype), jnp.zeros(1024, dtype)
        path = _make_path(*values, jnp.asarray(1024, jnp.int32))
        progress = np.asarray(path.progress)
        assert np.all(np.diff(progress) >= 0)
        np.testing.assert_allclose(progress, x, atol=tolerance)
