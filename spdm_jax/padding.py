"""Static shapes: scenarios padded to few sizes, stacked, and sent to the device.

Every free axis of `spdm_jax.schema.LEAVES` has a list of bucket sizes. A batch takes, for each
axis, the smallest bucket that holds its largest scenario; one that no bucket holds is an error,
nothing is ever truncated. Padding changes no result: masks are False, indices -1, numbers 0.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from spdm_jax.schema import LEAVES, check_leaves, from_leaves, leaves_of
from spdm_jax.types import PolygonGrid, Scenario, ScenarioBatch

_GRID_AREAS = ("lanes", "car_parks", "intersections")
"""Axes of the polygons that the grid numbers, in order."""
_WORD_BITS = 32
PATH_ROOM = (256, 512, 1024, 2048, 4096)
"""Room for the points of a path; few sizes, so few programs."""


def bucket(n: int, sizes: Sequence[int]) -> int:
    """Returns the smallest size that holds n.

    Raises:
      ValueError: n exceeds all sizes.
    """
    for size in sorted(sizes):
        if n <= size:
            return size
    raise ValueError(f"{n} exceeds the largest bucket {max(sizes)}; raise it, never truncate")


def _doubling(first: int, last: int) -> tuple[int, ...]:
    return tuple(first << i for i in range((last // first).bit_length()))


@dataclass(frozen=True)
class PaddingConfig:
    """Bucket sizes of each axis, ascending. The defaults double from small to large real scenes.

    Attributes:
      lanes: lanes and lane connectors.
      centerline_points, left_boundary_points, right_boundary_points: points of all lanes.
      lane_edges: polygon edges of all lanes; likewise `*_edges` below.
      lane_links: successors (or predecessors) of one lane.
      roadblocks: roadblocks and their connectors.
      roadblock_edges: see lane_edges.
      roadblock_links: successors (or predecessors) of one roadblock.
      intersections, car_parks, drivable, crosswalks, walkways, stop_lines: areas of a layer.
      intersection_edges, car_park_edges, drivable_edges: see lane_edges.
      crosswalk_edges, walkway_edges, stop_line_edges: see lane_edges.
      grid_cells: cells of the polygon grid.
      grid_masks: distinct sets of polygons at cell centres.
      grid_rows: cells crossed by an edge, plus one.
      grid_slots: edges in one cell.
      route_roadblocks: roadblocks of a route.
      slots: lanes of a route.
      sequence: lanes in a sequence.
      branches: branch sequences of a route.
      tracks: recorded objects.
      time: recorded steps.
    """

    lanes: tuple[int, ...] = _doubling(64, 8192)
    centerline_points: tuple[int, ...] = _doubling(1024, 262144)
    left_boundary_points: tuple[int, ...] = _doubling(1024, 262144)
    right_boundary_points: tuple[int, ...] = _doubling(1024, 262144)
    lane_edges: tuple[int, ...] = _doubling(2048, 524288)
    lane_links: tuple[int, ...] = _doubling(4, 32)
    roadblocks: tuple[int, ...] = _doubling(32, 4096)
    roadblock_edges: tuple[int, ...] = _doubling(1024, 262144)
    roadblock_links: tuple[int, ...] = _doubling(4, 32)
    intersections: tuple[int, ...] = _doubling(8, 1024)
    intersection_edges: tuple[int, ...] = _doubling(256, 65536)
    car_parks: tuple[int, ...] = _doubling(8, 1024)
    car_park_edges: tuple[int, ...] = _doubling(64, 65536)
    drivable: tuple[int, ...] = _doubling(32, 8192)
    drivable_edges: tuple[int, ...] = _doubling(1024, 524288)
    crosswalks: tuple[int, ...] = _doubling(16, 2048)
    crosswalk_edges: tuple[int, ...] = _doubling(128, 65536)
    walkways: tuple[int, ...] = _doubling(16, 2048)
    walkway_edges: tuple[int, ...] = _doubling(128, 131072)
    stop_lines: tuple[int, ...] = _doubling(16, 2048)
    stop_line_edges: tuple[int, ...] = _doubling(64, 32768)
    grid_cells: tuple[int, ...] = _doubling(65536, 33554432)
    grid_masks: tuple[int, ...] = _doubling(256, 65536)
    grid_rows: tuple[int, ...] = _doubling(4096, 1048576)
    grid_slots: tuple[int, ...] = _doubling(8, 256)
    route_roadblocks: tuple[int, ...] = _doubling(16, 512)
    slots: tuple[int, ...] = _doubling(16, 2048)
    sequence: tuple[int, ...] = _doubling(16, 256)
    branches: tuple[int, ...] = _doubling(16, 2048)
    tracks: tuple[int, ...] = _doubling(64, 4096)
    time: tuple[int, ...] = (128, 192, 256, 320, 512, 1024)


def sizes_of(scenario: Scenario) -> dict[str, int]:
    """Returns the length of every free axis of a scenario on the host.

    Raises:
      ValueError: leaves disagree with each other or with the schema.
    """
    return check_leaves({path: np.asarray(leaf) for path, leaf in leaves_of(scenario).items()})


def pad_scenario(scenario: Scenario, sizes: Mapping[str, int]) -> Scenario:
    """Pads a scenario at the end of every free axis.

    Polygon numbers in the grid move with the rows they stand for: car parks still follow the
    last lane row, and intersections the last car-park row.

    Args:
      scenario: one scenario with NumPy leaves.
      sizes: length of each free axis but `grid_words`, which follows from the others.

    Returns:
      A new scenario with NumPy leaves: padded masks are False, indices -1, rows and numbers 0.

    Raises:
      ValueError: a size is missing or less than the scenario's.
    """
    present = sizes_of(scenario)
    for axis, size in present.items():
        if axis == "grid_words":
            continue
        if axis not in sizes:
            raise ValueError(f"sizes lacks axis {axis}, of which the scenario has {size}")
        if size > sizes[axis]:
            raise ValueError(
                f"the scenario has {size} {axis}, sizes says {sizes[axis]}; nothing was truncated"
            )
    target = {**sizes, "grid_words": _words(sizes)}
    grid = _renumber(scenario.map.grid, present, target)
    moved = scenario.replace(map=scenario.map.replace(grid=grid))
    padded: dict[str, np.ndarray] = {}
    for path, leaf in leaves_of(moved).items():
        spec = LEAVES[path]
        shape = tuple(axis if isinstance(axis, int) else target[axis] for axis in spec.axes)
        array = np.full(shape, spec.fill, np.dtype(spec.dtype))
        array[tuple(slice(n) for n in np.shape(leaf))] = leaf
        padded[path] = array
    return from_leaves(padded)


def batch(
    scenarios: Sequence[Scenario],
    config: PaddingConfig | None = None,
    *,
    tokens: Sequence[str] | None = None,
) -> ScenarioBatch:
    """Pads scenarios to common buckets and stacks them.

    Args:
      scenarios: at least one, with NumPy leaves.
      config: bucket sizes; the defaults if None.
      tokens: names of the scenarios for error texts.

    Returns:
      Batch with NumPy leaves.

    Raises:
      ValueError: no scenarios, or one exceeds the largest bucket of an axis.
    """
    if not scenarios:
        raise ValueError("no scenarios to batch; pass at least one")
    config = PaddingConfig() if config is None else config
    names = [f"#{i}" for i in range(len(scenarios))] if tokens is None else tokens
    found = [sizes_of(scenario) for scenario in scenarios]
    sizes: dict[str, int] = {}
    for field in dataclasses.fields(PaddingConfig):
        axis, buckets = field.name, getattr(config, field.name)
        for name, present in zip(names, found, strict=True):
            if present[axis] > max(buckets):
                raise ValueError(
                    f"scene {name}: {present[axis]} {axis}, largest bucket {max(buckets)}. Raise "
                    f"PaddingConfig.{axis} or leave the scene out. Nothing was truncated."
                )
        sizes[axis] = bucket(max(present[axis] for present in found), buckets)
    padded = [leaves_of(pad_scenario(scenario, sizes)) for scenario in scenarios]
    return from_leaves({path: np.stack([leaves[path] for leaves in padded]) for path in LEAVES})


def to_device(scenarios: ScenarioBatch, dtype: DTypeLike = jnp.float32) -> ScenarioBatch:
    """Moves a scenario or batch to the default device.

    Args:
      scenarios: NumPy leaves.
      dtype: floating type of all floating leaves.

    Returns:
      The same with JAX leaves. `origin` alone stays a NumPy float64 array on the host: map
      coordinates do not fit into float32.

    Raises:
      ValueError: `dtype` is not a floating type, or is 64 bit while JAX runs with 32.
    """
    kind = np.dtype(dtype)
    if not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"dtype is {kind}; pass a floating type")
    if jax.dtypes.canonicalize_dtype(kind) != kind:
        raise ValueError(f"dtype is {kind}, but 64-bit types are off; set jax_enable_x64")

    def move(leaf: Any) -> jax.Array:
        floating = np.issubdtype(leaf.dtype, np.floating)
        return jnp.asarray(leaf, dtype=kind if floating else leaf.dtype)

    return jax.tree.map(move, scenarios).replace(origin=scenarios.origin)


def _words(sizes: Mapping[str, int]) -> int:
    return max(1, -(-sum(sizes[axis] for axis in _GRID_AREAS) // _WORD_BITS))


def _renumber(
    grid: PolygonGrid, present: Mapping[str, int], target: Mapping[str, int]
) -> PolygonGrid:
    """Gives the grid's polygons the numbers that they have once their layers are padded."""
    starts = np.cumsum([0, *(target[axis] for axis in _GRID_AREAS[:-1])])
    number = np.concatenate(
        [start + np.arange(present[axis]) for start, axis in zip(starts, _GRID_AREAS, strict=True)]
    ).astype(np.int32)
    # Little-endian words read as bytes, lowest bit first, run in polygon order.
    words = np.ascontiguousarray(grid.masks, "<u4")
    bits = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
    moved = np.zeros((len(bits), target["grid_words"] * _WORD_BITS), np.uint8)
    moved[:, number] = bits[:, : len(number)]
    masks = np.packbits(moved, axis=1, bitorder="little").view("<u4").astype(np.uint32)
    # The appended entry serves -1.
    edge_polygon = np.append(number, np.int32(-1))[grid.edge_polygon]
    return grid.replace(masks=masks, edge_polygon=edge_polygon)
