"""Which lanes the ego stands on: point-in-polygon by the grid, and the three ego-area flags."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.geometry import Box, box_corners
from spdm_jax.types import EgoState, PolygonGrid, ScenarioMap


class AreaMasks(NamedTuple):
    """Bit sets over the grid's polygons, `[W]` uint32 each.

    Attributes:
      drivable: polygons of this step's drivable map (lanes and car parks near the ego).
      on_route: those of the drivable map that belong to the route.
      intersection: intersection areas.
      lanes: lanes, where they are told apart by other bits than the drivable map; None takes its.
    """

    drivable: jax.Array
    on_route: jax.Array
    intersection: jax.Array
    lanes: jax.Array | None = None


class EgoAreas(NamedTuple):
    """Ego-area flags, each `[P, T]` bool (tuplan_garage `EgoAreaIndex`).

    Attributes:
      multiple_lanes: corners in several polygons and in none with all four.
      non_drivable: some corner outside the drivable map.
      oncoming: centre in no on-route polygon.
    """

    multiple_lanes: jax.Array
    non_drivable: jax.Array
    oncoming: jax.Array


class Crossings(NamedTuple):
    """Whether a point of the ego lies in an intersection, `[P, T]` bool each."""

    rear_axle: jax.Array
    center: jax.Array


class Areas(NamedTuple):
    """Areas that contain points `[...]`.

    Attributes:
      lanes: `[..., L]` bool, lanes and lane connectors.
      intersection: `[...]` bool, in some intersection.
    """

    lanes: jax.Array
    intersection: jax.Array


def pack_bits(flags: jax.Array, words: int) -> jax.Array:
    """Packs `[D]` booleans into `[words]` uint32, bit d of word d // 32."""
    padded = jnp.zeros(words * 32, bool).at[: flags.shape[0]].set(flags).reshape(words, 32)
    return jnp.sum(
        padded.astype(jnp.uint32) << jnp.arange(32, dtype=jnp.uint32), axis=1, dtype=jnp.uint32
    )


def containing_polygons(grid: PolygonGrid, x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """Bit sets of the polygons that contain each point.

    Args:
      grid: index over the polygons.
      x: `[...]` point coordinates, m.
      y: `[...]`.

    Returns:
      One uint32 array `[...]` per word of the grid's masks. Points outside the grid are in none.
      A point exactly on an edge belongs to either side.
    """
    fx, fy = (x - grid.origin[0]) / grid.cell_size, (y - grid.origin[1]) / grid.cell_size
    i, j = jnp.floor(fx).astype(jnp.int32), jnp.floor(fy).astype(jnp.int32)
    inside = (i >= 0) & (j >= 0) & (i < grid.shape[0]) & (j < grid.shape[1])
    cell = jnp.where(inside, i * grid.shape[1] + j, 0)
    px = x - (grid.origin[0] + (i.astype(x.dtype) + 0.5) * grid.cell_size)
    py = y - (grid.origin[1] + (j.astype(y.dtype) + 0.5) * grid.cell_size)
    row = jnp.where(inside, grid.cell_row[cell], 0)  # row 0 has no edges
    mask, num_words = grid.row_mask[row], grid.masks.shape[1]
    words = [jnp.where(inside, grid.masks[mask, w], jnp.uint32(0)) for w in range(num_words)]

    first, count = grid.edge_start[row], grid.edge_count[row]

    def flip(number, words):
        edge = first + number
        ax, ay, bx, by = (grid.edges[edge, k] for k in range(4))
        polygon = grid.edge_polygon[edge]
        # The segment runs from the cell centre (0, 0) to (px, py).
        ends_apart = (px * ay - py * ax > 0) != (px * by - py * bx > 0)
        ex, ey = bx - ax, by - ay
        points_apart = (ey * ax - ex * ay > 0) != (ex * (py - ay) - ey * (px - ax) > 0)
        crossed = ends_apart & points_apart & (number < count)
        bit = jnp.where(crossed, jnp.uint32(1), jnp.uint32(0)) << (polygon & 31).astype(jnp.uint32)
        word = polygon >> 5
        return tuple(v ^ jnp.where(word == w, bit, jnp.uint32(0)) for w, v in enumerate(words))

    # The fullest cell that was hit bounds the work.
    return jax.lax.fori_loop(jnp.int32(0), jnp.max(count), flip, tuple(words))


def areas_at(scene_map: ScenarioMap, x: jax.Array, y: jax.Array) -> Areas:
    """Looks points `[...]` up in the map's polygon grid."""
    words = jnp.stack(containing_polygons(scene_map.grid, x, y), axis=-1)

    def bits(first: int, count: int) -> jax.Array:
        number = first + jnp.arange(count)
        return (words[..., number >> 5] >> (number & 31).astype(jnp.uint32)) & 1 == 1

    num_lanes = scene_map.lanes.valid.shape[0]
    num_car_parks = scene_map.car_parks.count.shape[0]
    crossings = bits(num_lanes + num_car_parks, scene_map.intersections.count.shape[0])
    return Areas(bits(0, num_lanes) & scene_map.lanes.valid, jnp.any(crossings, axis=-1))


def ego_areas(
    grid: PolygonGrid, masks: AreaMasks, ego: EgoState, box: Box
) -> tuple[EgoAreas, Crossings]:
    """Classifies ego states `[P, T]` and their boxes.

    With c_j corners in lane j: multiple lanes = more than one j with c_j > 0 and none with c_j = 4;
    non-drivable = a corner in no drivable polygon; oncoming = centre in no on-route polygon (so
    off-road counts as oncoming too).

    Returns:
      The flags, and which points lie in an intersection.

    Source: tuplan_garage `PDMScorer._calculate_ego_areas`.
    """
    cx, cy = box_corners(box)
    # Corners, centre, rear axle; the long axes last, so that loops run along them.
    x = jnp.concatenate([jnp.moveaxis(cx, -1, 0), box.x[None], ego.x[None]])
    y = jnp.concatenate([jnp.moveaxis(cy, -1, 0), box.y[None], ego.y[None]])
    touched = jnp.zeros(box.x.shape, jnp.int32)
    whole = jnp.zeros(box.x.shape, bool)
    on_route = jnp.zeros(box.x.shape, bool)
    crossing = jnp.zeros((2, *box.x.shape), bool)
    corner_inside = jnp.zeros((4, *box.x.shape), bool)
    for w, word in enumerate(containing_polygons(grid, x, y)):
        drivable = word & masks.drivable[w]
        lanes = drivable if masks.lanes is None else word & masks.lanes[w]
        a, b, c, d = (lanes[i] for i in range(4))
        touched += jax.lax.population_count(a | b | c | d).astype(jnp.int32)
        whole |= (a & b & c & d) != 0
        corner_inside |= drivable[:4] != 0
        on_route |= (word[4] & masks.on_route[w]) != 0
        crossing |= (word[4:] & masks.intersection[w]) != 0
    areas = EgoAreas((touched > 1) & ~whole, ~jnp.all(corner_inside, axis=0), ~on_route)
    return areas, Crossings(rear_axle=crossing[1], center=crossing[0])
