"""The ego's box over a run."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Box, box_corners, ego_box
from spdm_jax.types import EgoState


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
