"""Builds the uniform grid that answers point-in-polygon queries exactly (host, float64)."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.types import PolygonGrid

CELL_SIZES = (1.0, 0.5)
"""Cell sizes to try, m; the first whose fullest cell holds few edges is taken."""
# Where many lanes fork, their edges meet in one point and no cell size would part them.
MAX_EDGES_PER_CELL = 40
# An irrational shift keeps cell centres off the axis-aligned edges of drawn maps.
_SHIFT = np.array([0.41421356, 0.73205081])
# Cells are widened by this fraction when edges are collected, so that a point that rounding puts
# into the neighbouring cell still finds its edges.
_OVERLAP = 1e-3


def polygon_edges(polygons: Sequence[BaseGeometry]) -> tuple[np.ndarray, np.ndarray]:
    """Returns edges `[V, 4]` (x0, y0, x1, y1) and the polygon `[V]` they belong to."""
    edges, rows = [], []
    for row, polygon in enumerate(polygons):
        for part in shapely.get_parts(polygon):
            if part.geom_type != "Polygon":
                continue
            for ring in (part.exterior, *part.interiors):
                xy = shapely.get_coordinates(ring)
                if len(xy) > 1:
                    edges.append(np.concatenate([xy[:-1], xy[1:]], axis=1))
                    rows.append(np.full(len(xy) - 1, row))
    if not edges:
        return np.zeros((0, 4)), np.zeros(0, int)
    return np.concatenate(edges), np.concatenate(rows)


def build_grid(polygons: Sequence[BaseGeometry], cell_size: float | None = None) -> PolygonGrid:
    """Builds the grid over polygons, in their own coordinates.

    Args:
      polygons: areas in bit order; holes and parts are respected (even-odd rule).
      cell_size: m; None picks the coarsest of `CELL_SIZES` with at most `MAX_EDGES_PER_CELL` edges
        in a cell.

    Returns:
      `PolygonGrid` with NumPy leaves of exact size.
    """
    edges, rows = polygon_edges(polygons)
    sizes = CELL_SIZES if cell_size is None else (cell_size,)
    if len(edges) == 0:
        return _pack(np.zeros(2), sizes[0], (1, 1), np.zeros((0, 2), int), edges, rows, polygons)
    low = np.minimum(edges[:, :2].min(0), edges[:, 2:].min(0))
    high = np.maximum(edges[:, :2].max(0), edges[:, 2:].max(0))

    def cells(size):
        origin = np.floor(low) - (1 + _SHIFT) * size
        nx, ny = (np.ceil((high - origin) / size).astype(int) + 1).tolist()
        return origin, size, (nx, ny), _cells_of_edges(edges, origin, size, nx, ny)

    *coarse, finest = sizes
    for size in coarse:
        layout = cells(size)
        if np.bincount(layout[-1][:, 0]).max() <= MAX_EDGES_PER_CELL:
            return _pack(*layout, edges, rows, polygons)
    return _pack(*cells(finest), edges, rows, polygons)


def _cells_of_edges(edges, origin, size, nx, ny) -> np.ndarray:
    """Returns `[M, 2]` (cell, edge) pairs of touching cells, sorted by cell."""
    relative = (edges.reshape(-1, 2, 2) - origin) / size
    low = np.floor(relative.min(1) - _OVERLAP).astype(int)
    high = np.floor(relative.max(1) + _OVERLAP).astype(int)
    # Columns first: within one column of cells the edge covers a run of rows.
    span = high[:, 0] - low[:, 0] + 1
    edge = np.repeat(np.arange(len(edges)), span)
    column = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span) + low[edge, 0]
    a, b = relative[edge, 0], relative[edge, 1]
    dx = b[:, 0] - a[:, 0]
    steep = np.abs(dx) < 1e-12
    with np.errstate(divide="ignore", invalid="ignore"):
        t0 = (column - _OVERLAP - a[:, 0]) / dx
        t1 = (column + 1 + _OVERLAP - a[:, 0]) / dx
    t_low = np.where(steep, 0, np.clip(np.minimum(t0, t1), 0, 1))
    t_high = np.where(steep, 1, np.clip(np.maximum(t0, t1), 0, 1))
    y0 = a[:, 1] + t_low * (b[:, 1] - a[:, 1])
    y1 = a[:, 1] + t_high * (b[:, 1] - a[:, 1])
    bottom = np.floor(np.minimum(y0, y1) - _OVERLAP).astype(int)
    top = np.floor(np.maximum(y0, y1) + _OVERLAP).astype(int)
    span = top - bottom + 1
    index = np.repeat(np.arange(len(edge)), span)
    row = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span) + bottom[index]
    cell = np.clip(column[index], 0, nx - 1) * ny + np.clip(row, 0, ny - 1)
    pairs = np.unique(np.stack([cell, edge[index]], 1), axis=0)
    return pairs


def _pack(origin, size, shape, pairs, edges, rows, polygons) -> PolygonGrid:
    nx, ny = shape
    words = max(1, -(-len(polygons) // 32))
    ij = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), -1).reshape(-1, 2)
    centers = origin + (ij + 0.5) * size
    masks = np.zeros((nx * ny, words), np.uint32)
    for bit, polygon in enumerate(polygons):
        if shapely.is_empty(polygon):
            continue
        bounds = (np.array(shapely.bounds(polygon)) - np.tile(origin, 2)) / size
        i0, j0 = np.maximum(bounds[:2].astype(int) - 1, 0)
        i1, j1 = np.minimum(bounds[2:].astype(int) + 2, shape)
        inside = _inside(
            origin[0] + (np.arange(i0, i1) + 0.5) * size,
            origin[1] + (np.arange(j0, j1) + 0.5) * size,
            edges[rows == bit],
        )
        cells = np.arange(i0, i1)[:, None] * ny + np.arange(j0, j1)
        masks[cells[inside], bit // 32] |= np.uint32(1 << (bit % 32))
    unique, cell_mask = _unique_rows(masks)

    # A row for each mask, for cells without edges; then one for each cell that has some.
    cell_row = cell_mask.reshape(-1).astype(np.int32)
    cells, first, counts = np.unique(pairs[:, 0], return_index=True, return_counts=True)
    plain = np.zeros(len(unique), int)
    row_mask = np.append(np.arange(len(unique)), cell_row[cells])
    cell_row[cells] = len(unique) + np.arange(len(cells))
    table, owner = edges[pairs[:, 1]] - np.tile(centers[pairs[:, 0]], 2), rows[pairs[:, 1]]
    if not len(pairs):  # there is something to index, though nobody does
        table, owner = np.zeros((1, 4)), np.array([-1])
    return PolygonGrid(
        origin=np.asarray(origin, float),
        cell_size=np.asarray(size, float),
        shape=np.array([nx, ny], np.int32),
        cell_row=cell_row,
        row_mask=row_mask.astype(np.int32),
        edge_start=np.append(plain, first).astype(np.int32),
        edge_count=np.append(plain, counts).astype(np.int32),
        masks=unique,
        edges=table,
        edge_polygon=owner.astype(np.int32),
    )


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`np.unique(rows, axis=0, return_inverse=True)` by hashing, in another order."""
    factors = np.random.default_rng(0).integers(1, 2**63, rows.shape[1], np.uint64) | np.uint64(1)
    with np.errstate(over="ignore"):
        key = (rows.astype(np.uint64) * factors).sum(axis=1, dtype=np.uint64)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first][inverse], rows):  # two rows with one hash
        unique, inverse = np.unique(rows, axis=0, return_inverse=True)
        return unique, inverse.reshape(-1)
    return rows[first], inverse


def _inside(columns: np.ndarray, rows: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Even-odd membership of the points columns x rows in one polygon, `[len(columns), len(rows)]`.

    Each crossing of an edge with a column flips all points above it.
    """
    ax, ay, bx, by = edges.T
    straddles = (ax[:, None] > columns) != (bx[:, None] > columns)
    edge, column = np.nonzero(straddles)
    t = (columns[column] - ax[edge]) / (bx[edge] - ax[edge])
    above = np.searchsorted(rows, ay[edge] + t * (by[edge] - ay[edge]), side="right")
    flips = np.zeros((len(columns), len(rows) + 1), np.int64)
    np.add.at(flips, (column, above), 1)
    return np.cumsum(flips, axis=1)[:, :-1] % 2 == 1
