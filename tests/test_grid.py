"""Point in polygon by the grid against shapely, on polygons of every kind."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.grid import CELL_SIZES, build_grid
from spdm_jax.scoring.areas import containing_polygons
from spdm_jax.types import PolygonGrid

NUM_POINTS = 600
# Fixed sizes, so that all examples share one compiled query.
CELLS, ROWS, EDGES, MASKS, WORDS = 16384, 4096, 32768, 256, 2

_query = jax.jit(containing_polygons)


def padded(grid: PolygonGrid, dtype=jnp.float64) -> PolygonGrid:
    def grown(values: np.ndarray, *sizes: int, fill: int = 0) -> np.ndarray:
        widths = [(0, max(0, n - m)) for n, m in zip(sizes, values.shape, strict=False)]
        widths += [(0, 0)] * (values.ndim - len(widths))
        return np.pad(values, widths, constant_values=fill)

    return PolygonGrid(
        origin=jnp.asarray(grid.origin, dtype),
        cell_size=jnp.asarray(grid.cell_size, dtype),
        shape=jnp.asarray(grid.shape),
        cell_row=jnp.asarray(grown(np.asarray(grid.cell_row), CELLS)),
        row_mask=jnp.asarray(grown(np.asarray(grid.row_mask), ROWS)),
        masks=jnp.asarray(grown(np.asarray(grid.masks), MASKS, WORDS)),
        edge_start=jnp.asarray(grown(np.asarray(grid.edge_start), ROWS)),
        edge_count=jnp.asarray(grown(np.asarray(grid.edge_count), ROWS)),
        edges=jnp.asarray(grown(np.asarray(grid.edges), EDGES), dtype),
        edge_polygon=jnp.asarray(grown(np.asarray(grid.edge_polygon), EDGES, fill=-1)),
    )


def inside(grid: PolygonGrid, points: np.ndarray, num: int) -> np.ndarray:
    """`[N, num]` which polygons contain each point."""
    words = _query(grid, *jnp.asarray(points, grid.origin.dtype).T)
    bits = [(np.asarray(words[d // 32]) >> (d % 32)) & 1 for d in range(num)]
    return np.stack(bits, 1).astype(bool)


def random_polygon(rng: np.random.Generator) -> BaseGeometry:
    """A star, a rectangle, one with holes, two parts, or a ring that touches itself."""
    center = rng.uniform(-15, 15, 2)
    kind = int(rng.integers(5))
    if kind == 0:
        num = int(rng.integers(3, 15))
        angle = np.sort(rng.uniform(0, 2 * np.pi, num))
        radius = rng.uniform(0.5, 8, num)
        ring = center + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        return shapely.Polygon(ring)
    low = np.round(center)
    high = low + rng.integers(2, 9, 2)
    box = shapely.box(*low, *high)
    if kind == 1:  # edges on whole metres, along the axes
        return box
    if kind == 2:
        hole = shapely.box(*(low + 0.5), *(low + 1.5))
        return box.difference(hole)
    if kind == 3:
        return shapely.MultiPolygon([box, shapely.box(*(high + 1), *(high + 3))])
    # Two squares that share a corner, drawn as one ring.
    x, y = low
    ring = [(0, 0), (2, 0), (2, 2), (4, 2), (4, 4), (2, 4), (2, 2), (0, 2)]
    return shapely.Polygon([(x + a, y + b) for a, b in ring])


def contains(polygons: list[BaseGeometry], points: np.ndarray) -> np.ndarray:
    """Even-odd rule by triangles, which holds for rings that touch themselves too."""
    out = np.zeros((len(points), len(polygons)), bool)
    for j, polygon in enumerate(polygons):
        for ring in shapely.get_rings(shapely.get_parts(polygon)):
            xy = shapely.get_coordinates(ring)
            for a, b in itertools.pairwise(xy):
                triangle = shapely.Polygon([xy[0], a, b])
                if triangle.area > 0:
                    out[:, j] ^= shapely.contains_xy(triangle, points)
    return out


def clearance(polygons: list[BaseGeometry], points: np.ndarray) -> np.ndarray:
    """Distance of each point to the nearest line that decides about it in `contains`."""
    lines = []
    for polygon in polygons:
        for ring in shapely.get_rings(shapely.get_parts(polygon)):
            xy = shapely.get_coordinates(ring)
            lines += [shapely.LineString([xy[0], p]) for p in xy[1:-1]] + [ring]
    where: Any = shapely.points(points)
    return shapely.distance(where[:, None], np.array(lines)).min(axis=1)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([None, *CELL_SIZES]))
def test_grid_agrees_with_shapely(seed: int, cell_size: float | None):
    rng = np.random.default_rng(seed)
    polygons = [random_polygon(rng) for _ in range(int(rng.integers(1, 40)))]
    polygons = polygons[: 40 if cell_size != 0.25 else 8]
    grid = padded(build_grid(polygons, cell_size))
    points = rng.uniform(-25, 25, (NUM_POINTS, 2))
    # Close to the edges, where the cell's edges decide.
    rim = shapely.get_coordinates(polygons)
    near = rim[rng.integers(len(rim), size=NUM_POINTS // 2)]
    points[: NUM_POINTS // 2] = near + rng.normal(0, 0.05, near.shape)
    clear = clearance(polygons, points) > 1e-9
    assert clear.mean() > 0.9
    expected = contains(polygons, points)
    np.testing.assert_array_equal(inside(grid, points, len(polygons))[clear], expected[clear])
    # Float32 may be wrong only where the margin is within its rounding (1e-5 m at 25 m).
    single = inside(padded(build_grid(polygons, cell_size), jnp.float32), points, len(polygons))
    wide = clearance(polygons, points) > 1e-4
    np.testing.assert_array_equal(single[wide], expected[wide])


def test_plain_polygons_agree_with_shapely_itself():
    hole = shapely.box(-3, -3, 3, 3).difference(shapely.box(-1, -1, 1, 1))
    grid = padded(build_grid([hole, shapely.box(2.0, 2.0, 8.0, 5.0)]))
    points = np.random.default_rng(3).uniform(-10, 10, (NUM_POINTS, 2))
    found = inside(grid, points, 2)
    np.testing.assert_array_equal(found[:, 0], shapely.contains_xy(hole, points))
    np.testing.assert_array_equal(found[:, 1], shapely.contains_xy(shapely.box(2, 2, 8, 5), points))
    assert 0.05 < found[:, 0].mean() < 0.95


@pytest.mark.parametrize("far", [1e3, 1e6, 1e8])
def test_points_beyond_the_grid_are_in_nothing(far: float):
    grid = padded(build_grid([shapely.box(-5, -5, 5, 5)]))
    points = np.zeros((NUM_POINTS, 2))
    points[1:5] = [[far, 0], [-far, 0], [0, far], [far, -far]]
    found = inside(grid, points, 1)[:, 0]
    np.testing.assert_array_equal(found[:6], [True, False, False, False, False, True])


def test_no_polygons_give_a_grid_that_contains_nothing():
    assert not inside(padded(build_grid([])), np.zeros((NUM_POINTS, 2)), 32).any()


def test_neighbours_share_no_point_and_leave_no_gap():
    # Lanes that share an edge: a point just beside it is in exactly one of them.
    lanes = [shapely.box(0, 3.5 * k, 100, 3.5 * (k + 1)) for k in range(4)]
    grid = padded(build_grid(lanes))
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(1, 99, NUM_POINTS), 3.5 * rng.integers(1, 4, NUM_POINTS)], 1)
    points[:, 1] += rng.choice([-1, 1], NUM_POINTS) * 10 ** rng.uniform(-9, -3, NUM_POINTS)
    np.testing.assert_array_equal(inside(grid, points, 4).sum(axis=1), 1)
