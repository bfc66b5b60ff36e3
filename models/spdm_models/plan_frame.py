"""Plans of the ego frame as the simulation and the PDM scorer take them."""

import jax
import jax.numpy as jnp

from spdm_jax.config import DT, NUM_STATES
from spdm_jax.geometry import wrap
from spdm_jax.simulation.controller import Plan
from spdm_jax.types import EgoState, ProposalSet


def in_scene(poses: jax.Array, ego: EgoState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Moves poses to the scene's frame and puts the current one before them.

    Args:
      poses: `[..., T, 3]` x, y, heading in the frame of the ego's rear axle, first at 0.1 s.
      ego: current state, scalars.

    Returns:
      x, y, heading `[..., T + 1]`.
    """
    now = jnp.zeros_like(poses[..., :1, :])
    x, y, heading = jnp.moveaxis(jnp.concatenate([now, poses], axis=-2), -1, 0)
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    return (
        ego.x + cos * x - sin * y,
        ego.y + sin * x + cos * y,
        wrap(ego.heading + heading),
    )


def plan_in_scene(poses: jax.Array, ego: EgoState, time: jax.Array) -> Plan:
    """Returns the plan that follows poses `[T, 3]` of the ego frame, see `in_scene`."""
    x, y, heading = in_scene(poses, ego)
    return Plan(
        x=x, y=y, heading=heading, time=jnp.arange(x.shape[0], dtype=x.dtype) * DT, start=time
    )


def proposals_in_scene(
    poses: jax.Array, ego: EgoState, valid: jax.Array | None = None
) -> ProposalSet:
    """Returns plans `[M, T, 3]` of the ego frame as proposals `[M, 41]` of stage 2 without a lane.

    Args:
      poses: as in `in_scene`, 40 steps or more.
      ego: current state, scalars.
      valid: `[M]` bool, real ones; a plan that is not finite is none in any case.
    """
    x, y, heading = (values[:, :NUM_STATES] for values in in_scene(poses, ego))
    real = jnp.all(jnp.isfinite(x) & jnp.isfinite(y) & jnp.isfinite(heading), axis=1)
    real = real if valid is None else real & valid
    keep = lambda values, now: jnp.where(real[:, None], values, now)
    index = jnp.arange(x.shape[0], dtype=jnp.int32)
    return ProposalSet(
        x=keep(x, ego.x),
        y=keep(y, ego.y),
        heading=keep(heading, ego.heading),
        valid=real,
        path=index,
        policy=jnp.zeros_like(index),
        stage=jnp.full_like(index, 2),
        lane=jnp.full_like(index, -1),
    )


def continued(poses: jax.Array, steps: int) -> jax.Array:
    """Lengthens a plan `[T, 3]` of the ego frame to `[steps, 3]`: straight on at its last speed."""
    missing = steps - poses.shape[0]
    if missing <= 0:
        return poses[:steps]
    way = jnp.hypot(*(poses[-1, :2] - poses[-2, :2])) * jnp.arange(1, missing + 1)
    x, y, heading = poses[-1]
    on = jnp.stack(
        [x + way * jnp.cos(heading), y + way * jnp.sin(heading), jnp.full_like(way, heading)],
        axis=-1,
    )
    return jnp.concatenate([poses, on])
