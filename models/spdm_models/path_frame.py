"""Points beside a path that is sampled every 0.1 m: the nearest sample, and the distance to it."""

import jax
import jax.numpy as jnp

PATH_STEP = 0.1
"""Distance of a path's samples, m."""


def nearest_point(xy: jax.Array, path: jax.Array) -> jax.Array:
    """Returns `[...]` int32 indices of the samples `[P, >= 2]` nearest to `[..., 2]`."""
    offset = jax.lax.stop_gradient(xy)[..., None, :] - jax.lax.stop_gradient(path[:, :2])
    square = jnp.sum(offset**2, axis=-1)
    # The first smallest entry, several times faster on a CPU than `argmin`.
    index = jnp.arange(path.shape[0], dtype=jnp.int32)
    smallest = jnp.min(square, axis=-1, keepdims=True)
    return jnp.min(jnp.where(square <= smallest, index, path.shape[0] - 1), axis=-1)


def signed_distance(xy: jax.Array, path: jax.Array, index: jax.Array) -> jax.Array:
    """Distance to the given samples, positive on the left; no gradient passes.

    Args:
      xy: `[..., 2]` m.
      path: `[P, >= 3]` x, y, heading.
      index: `[...]` of `nearest_point`.

    Returns:
      `[...]` m.
    """
    xy, path = jax.lax.stop_gradient(xy), jax.lax.stop_gradient(path)
    point = path[index]
    dx, dy, heading = xy[..., 0] - point[..., 0], xy[..., 1] - point[..., 1], point[..., 2]
    side = jnp.sign(dy * jnp.cos(heading) - dx * jnp.sin(heading))
    return side * jnp.sqrt(dx**2 + dy**2)
