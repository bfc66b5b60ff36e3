"""The ego's box over a run, and the areas its points lie in."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Box, box_corners, ego_box
from spdm_jax.scoring.areas import containing_polygons
from spdm_jax.types import EgoState, ScenarioMap


class Motion(NamedTuple):
    """The ego over a run, `[T]`.

    Attributes:
      box: footprint; its x and y are the box centre.
      corner_x, corner_y: `[T, 4]` front left, rear left, rear right, front right.
      speed: of the rear axle, m/s.
    """

    box: Box
    corner_x: jax.Array
    corner_y: jax.Array
    speed: jax.Array


def motion(ego: EgoState, vehicle: VehicleParams) -> Motion:
    """Places the ego's box on rear-axle states `[T]`."""
    box = ego_box(ego, vehicle)
    corner_x, corner_y = box_corners(box)
    return Motion(box, corner_x, corner_y, jnp.hypot(ego.vx, ego.vy))


class Areas(NamedTuple):
    """Areas that contain points `[...]`.

    Attributes:
      lanes: `[..., L]` bool, lanes and lane connectors.
      intersection: `[...]` bool, in some intersection.
    """

    lanes: jax.Array
    intersection: jax.Array


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
