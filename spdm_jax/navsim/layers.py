"""The map of a frame as a few bits per point (host).

The score asks of a point whether it is drivable, on the route or in an intersection, and of a box
which lanes its corners are in. The first three are one area each, a union. Lanes that no box can
touch together share a bit: hundreds of polygons become some dozens of bits.
"""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.config import VehicleParams
from spdm_jax.io.grid import build_grid
from spdm_jax.scoring.areas import AreaMasks
from spdm_jax.types import Array, PolygonGrid

BLOCK, LANE, CONNECTOR, INTERSECTION, CAR_PARK = range(5)
"""Kinds of map polygons, numbered as in the exported frames."""
DRIVABLE_KINDS = (BLOCK, INTERSECTION, CAR_PARK)
LANE_KINDS = (LANE, CONNECTOR)
_DRIVABLE, _ROUTE, _CROSSING, _LANES = range(4)  # first bits of the layers
# Lanes must be farther apart than the box's diagonal to share a bit; rounding must not matter.
_SLACK = 0.1


def shared_bits(lanes: Sequence[BaseGeometry], apart: float) -> np.ndarray:
    """Numbers lanes so that those of one number are farther than `apart` from each other.

    Returns:
      `[L]` numbers from 0, few of them.
    """
    if not lanes:
        return np.zeros(0, int)
    tree = shapely.STRtree(list(lanes))
    pairs = tree.query(list(lanes), predicate="dwithin", distance=apart)
    neighbours = [pairs[1][pairs[0] == i] for i in range(len(lanes))]
    number = np.full(len(lanes), -1)
    # The most crowded first: they need the most numbers.
    for lane in sorted(range(len(lanes)), key=lambda i: -len(neighbours[i])):
        taken = set(number[neighbours[lane]].tolist())
        number[lane] = next(n for n in range(len(lanes)) if n not in taken)
    return number


def map_layers(
    polygons: Sequence[BaseGeometry],
    kind: np.ndarray,
    on_route: np.ndarray,
    vehicle: VehicleParams,
) -> tuple[PolygonGrid, AreaMasks]:
    """Builds the point-in-polygon index of a frame.

    Args:
      polygons: map objects, local frame.
      kind: `[D]` one of the kinds above.
      on_route: `[D]` bool, counts for lanes and connectors only.
      vehicle: ego dimensions.

    Returns:
      Grid and masks with NumPy leaves of exact size.
    """
    whole = [p if shapely.is_valid(p) else shapely.make_valid(p) for p in polygons]
    chosen = lambda flags: [p for p, take in zip(whole, flags, strict=True) if take]
    is_lane = np.isin(kind, LANE_KINDS)
    lanes = chosen(is_lane)
    number = shared_bits(lanes, float(np.hypot(vehicle.length, vehicle.width)) + _SLACK)
    count = int(number.max()) + 1 if len(number) else 0
    areas = [
        shapely.union_all(chosen(np.isin(kind, DRIVABLE_KINDS))),
        shapely.union_all(chosen(is_lane & on_route)),
        shapely.union_all(chosen(kind == INTERSECTION)),
    ]
    for n in range(count):
        members = [lane for lane, own in zip(lanes, number, strict=True) if own == n]
        areas.append(shapely.union_all(members))
    grid = build_grid(areas)
    words = grid.masks.shape[1]
    layer = lambda *bits: _words(bits, words)
    masks = AreaMasks(
        drivable=layer(_DRIVABLE),
        on_route=layer(_ROUTE),
        intersection=layer(_CROSSING),
        lanes=layer(*range(_LANES, _LANES + count)),
    )
    return grid, masks


def _words(bits: Sequence[int], words: int) -> Array:
    packed = np.zeros(words, np.uint32)
    for bit in bits:
        packed[bit >> 5] |= np.uint32(1 << (bit & 31))
    return packed
