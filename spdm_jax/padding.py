"""Static shapes: scenarios padded to few sizes, stacked, and sent to the device.

Every free axis of `spdm_jax.schema.LEAVES` has a list of bucket sizes. A batch takes, for each
axis, the smallest bucket that holds its largest scenario; one that no bucket holds is an error,
nothing is ever truncated. Padding changes no result: masks are False, indices -1, numbers 0.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from spdm_jax.schema import KINDS, LEAVES, check_leaves, from_leaves, leaves_of
from spdm_jax.types import Scenario, ScenarioBatch

_GRID_AREAS = ("lanes", "car_parks", "intersections")
"""Axes of the polygons that the grid numbers, in order."""
_WORD_BITS = 32
_MASKS, _EDGE_POLYGON = "map.grid.masks", "map.grid.edge_polygon"
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
      grid_rows: cells crossed by an edge, and the distinct kinds of others.
      grid_edges: edges of all cells, an edge counted in each.
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
    grid_edges: tuple[int, ...] = _doubling(8192, 8388608)
    route_roadblocks: tuple[int, ...] = _doubling(16, 512)
    slots: tuple[int, ...] = _doubling(16, 2048)
    sequence: tuple[int, ...] = _doubling(16, 256)
    branches: tuple[int, ...] = _doubling(16, 2048)
    tracks: tuple[int, ...] = _doubling(64, 4096)
    time: tuple[int, ...] = (128, 192, 256, 320, 512, 1024)


AXES = tuple(field.name for field in dataclasses.fields(PaddingConfig))
"""Free axes that have bucket sizes."""


def check_buckets(sizes: Mapping[str, int], config: PaddingConfig, name: str) -> None:
    """Refuses a scenario that is larger than the largest bucket of an axis.

    Args:
      sizes: length of its free axes.
      config: bucket sizes.
      name: of the scenario, for the error text.

    Raises:
      ValueError: names axis, length and bucket.
    """
    for axis in AXES:
        largest = max(getattr(config, axis))
        if sizes[axis] > largest:
            raise ValueError(
                f"scene {name}: {sizes[axis]} {axis}, largest bucket {largest}. Raise "
                f"PaddingConfig.{axis} or leave the scene out. Nothing was truncated."
            )


def sizes_of(scenario: Scenario) -> dict[str, int]:
    """Returns the length of every free axis of a scenario on the host.

    Raises:
      ValueError: leaves disagree with each other or with the schema.
    """
    return check_leaves({path: np.asarray(leaf) for path, leaf in leaves_of(scenario).items()})


class PaddedStack:
    """Scenarios of one padding, stacked one after the other into arrays that can be used again.

    Polygon numbers in the grid move with the rows they stand for: car parks still follow the last
    lane row, and intersections the last car-park row.

    Args:
      count: scenarios at most.
      sizes: length of each free axis but `grid_words`, which follows from the others.
      paths: leaves to hold, by field path; all of them if None.
      dtype: of floating leaves.

    Raises:
      ValueError: a size is missing.
    """

    def __init__(
        self,
        count: int,
        sizes: Mapping[str, int],
        *,
        paths: Iterable[str] | None = None,
        dtype: DTypeLike = np.float64,
    ):
        if missing := [axis for axis in AXES if axis not in sizes]:
            raise ValueError(f"sizes lacks axis {missing[0]}")
        self._sizes = {**sizes, "grid_words": _words(sizes)}
        self._count = 0
        self._arrays: dict[str, np.ndarray] = {}
        for path in LEAVES if paths is None else paths:
            axes, kind = LEAVES[path].axes, KINDS[path]
            shape = (axis if isinstance(axis, int) else self._sizes[axis] for axis in axes)
            kind = np.dtype(dtype) if kind.kind == "f" else kind
            self._arrays[path] = np.empty((count, *shape), kind)

    def add(self, leaves: Mapping[str, np.ndarray], present: Mapping[str, int]) -> None:
        """Pads a scenario at the end of every free axis and takes it in.

        Args:
          leaves: by field path.
          present: length of every free axis.

        Raises:
          ValueError: the scenario is larger than the padding.
        """
        for axis, size in present.items():
            if axis != "grid_words" and size > self._sizes[axis]:
                raise ValueError(
                    f"the scenario has {size} {axis}, sizes says {self._sizes[axis]}; "
                    "nothing was truncated"
                )
        moved = _renumbered(leaves, present, self._sizes)
        for path, array in self._arrays.items():
            leaf = moved.get(path, leaves[path])
            row = array[self._count : self._count + 1]
            if np.shape(leaf) != array.shape[1:]:
                row.fill(LEAVES[path].fill)
            row[0, *(slice(n) for n in np.shape(leaf))] = leaf
        self._count += 1

    def clear(self) -> None:
        """Forgets the scenarios; arrays handed out before hold those that are added next."""
        self._count = 0

    def leaves(self) -> dict[str, np.ndarray]:
        """Returns `[B, ...]` by field path: padded masks are False, indices -1, numbers 0."""
        return {path: array[: self._count] for path, array in self._arrays.items()}


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
    for name, present in zip(names, found, strict=True):
        check_buckets(present, config, name)
    largest = {axis: max(present[axis] for present in found) for axis in AXES}
    sizes = {axis: bucket(size, getattr(config, axis)) for axis, size in largest.items()}
    stack = PaddedStack(len(scenarios), sizes)
    for scenario, present in zip(scenarios, found, strict=True):
        stack.add(leaves_of(scenario), present)
    return from_leaves(stack.leaves())


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
    return leaves_to_device(scenarios, dtype).replace(origin=scenarios.origin)


def leaves_to_device(tree: Any, dtype: DTypeLike) -> Any:
    """Moves every leaf of a tree to the default device; see `to_device`."""
    kind = np.dtype(dtype)
    if not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"dtype is {kind}; pass a floating type")
    if jax.dtypes.canonicalize_dtype(kind) != kind:
        raise ValueError(f"dtype is {kind}, but 64-bit types are off; set jax_enable_x64")

    def move(leaf: Any) -> jax.Array:
        floating = np.issubdtype(np.asarray(leaf).dtype, np.floating)
        return jnp.asarray(leaf, dtype=kind if floating else None)

    return jax.tree.map(move, tree)


def _words(sizes: Mapping[str, int]) -> int:
    return max(1, -(-sum(sizes[axis] for axis in _GRID_AREAS) // _WORD_BITS))


def _renumbered(
    leaves: Mapping[str, np.ndarray], present: Mapping[str, int], target: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Gives the grid's polygons the numbers that they have once their layers are padded."""
    starts = np.cumsum([0, *(target[axis] for axis in _GRID_AREAS[:-1])])
    number = np.concatenate(
        [start + np.arange(present[axis]) for start, axis in zip(starts, _GRID_AREAS, strict=True)]
    ).astype(np.int32)
    # Little-endian words read as bytes, lowest bit first, run in polygon order.
    words = np.ascontiguousarray(leaves[_MASKS], "<u4")
    bits = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
    moved = np.zeros((len(bits), target["grid_words"] * _WORD_BITS), np.uint8)
    moved[:, number] = bits[:, : len(number)]
    masks = np.packbits(moved, axis=1, bitorder="little").view("<u4").astype(np.uint32)
    # The appended entry serves -1.
    return {_MASKS: masks, _EDGE_POLYGON: np.append(number, np.int32(-1))[leaves[_EDGE_POLYGON]]}
