"""Red lights: contacts of the ego's box with connectors that are red at that time."""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import true_indices
from spdm_jax.geometry import Box, crosses_upward_ray, segment_meets_box
from spdm_jax.types import Array


class RedConnectors(struct.PyTreeNode, kw_only=True):
    """Lane connectors on the route that are red at some time.

    Attributes:
      edges: `[V, 4]` x0, y0, x1, y1 of their polygons, connector after connector.
      start: `[M]` int32, first edge of each connector.
      count: `[M]` int32, number of its edges (0 for padding).
      red: `[M, F]` bool, status in each frame; a status holds until the next frame.
    """

    edges: Array
    start: Array
    count: Array
    red: Array


STEPS_PER_FRAME = 5
"""Scored steps (0.1 s) per frame of the log (2 Hz)."""


def red_contact(box: Box, red: RedConnectors) -> jax.Array:
    """First time index at which each box touches a connector that is red then, T if none.

    A box that lies in a connector touches it too, so it counts from the start.

    Args:
      box: `[P, T]` ego boxes.
      red: connectors.

    Returns:
      `[P]` int32.

    Source: NAVSIM `PDMScorer._calculate_traffic_light_compliance` (v2.2).
    """
    steps = box.x.shape[1]
    active = jnp.repeat(red.red, STEPS_PER_FRAME, axis=1)[:, :steps] & (red.count > 0)[:, None]
    reach = 1.001 * jnp.hypot(box.half_length, box.half_width) + 1e-3
    low_x, high_x = jnp.min(box.x, axis=0) - reach, jnp.max(box.x, axis=0) + reach
    low_y, high_y = jnp.min(box.y, axis=0) - reach, jnp.max(box.y, axis=0) + reach
    number = jnp.arange(red.edges.shape[0])
    own = (number >= red.start[:, None]) & (number < (red.start + red.count)[:, None])  # [M, V]
    ax, ay, bx, by = red.edges.T
    least = lambda v: jnp.min(jnp.where(own, v, jnp.inf), axis=1)[:, None]
    most = lambda v: jnp.max(jnp.where(own, v, -jnp.inf), axis=1)[:, None]
    near = active & (
        (least(ax) <= high_x) & (most(ax) >= low_x) & (least(ay) <= high_y) & (most(ay) >= low_y)
    )
    some = jnp.any(near, axis=1)
    rows, _ = true_indices(some, some.shape[0])

    def visit(i, touched):
        row = rows[i]

        def edge(k, state):
            meets, odd = state
            x0, y0, x1, y1 = ax[k], ay[k], bx[k], by[k]
            meets |= segment_meets_box(x0, y0, x1, y1, box)
            return meets, odd ^ crosses_upward_ray(box.x, box.y, x0, y0, x1, y1)

        nowhere = jnp.zeros(box.x.shape, bool)
        first = red.start[row]
        meets, odd = jax.lax.fori_loop(first, first + red.count[row], edge, (nowhere, nowhere))
        return touched | ((meets | odd) & active[row])

    count = jnp.sum(some, dtype=jnp.int32)
    start = jnp.zeros(box.x.shape, bool)
    touched = jax.lax.fori_loop(jnp.int32(0), count, visit, start)
    first = jnp.argmax(touched, axis=1).astype(jnp.int32)
    return jnp.where(jnp.any(touched, axis=1), first, jnp.int32(steps))
