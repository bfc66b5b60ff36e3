"""Recorded objects as the scorer meets them: 0.1 s samples between the frames of a 2 Hz log."""

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.agents.observation import ego_contacts, is_agent
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import ego_box, wrap
from spdm_jax.navsim.types import LoggedObjects
from spdm_jax.scoring.lights import STEPS_PER_FRAME
from spdm_jax.scoring.profile import Profile
from spdm_jax.types import AgentForecast, EgoState


def replay(
    objects: LoggedObjects, ego: EgoState, vehicle: VehicleParams, profile: Profile
) -> AgentForecast:
    """Interpolates the log.

    An object is there from its first frame to its last one, gaps included; one that was recorded
    once stands there all the time. Its speed is that of the first frame, whenever it is met.

    Args:
      objects: `[A, F]` log.
      ego: `[]` state at the first frame.
      vehicle: ego dimensions.
      profile: length of the replay, and whether objects that touch the ego at its start are left
        out.

    Returns:
      `AgentForecast` `[A, S]`, S = `profile.replay_samples`.

    Source: NAVSIM `MetricCacheProcessor` (v1.1: 5.0 s; v2.2: 4.0 s), its interpolated tracked
    objects; its log-replay traffic for objects that touch.
    """
    samples = profile.replay_samples
    frames = (samples - 1) // STEPS_PER_FRAME + 1
    valid = objects.valid[:, :frames]
    number = jnp.arange(frames, dtype=jnp.int32)
    # Recorded frames at or before, and at or after, each frame.
    before = jax.lax.cummax(jnp.where(valid, number, -1), axis=1)
    after = jax.lax.cummin(jnp.where(valid, number, frames), axis=1, reverse=True)
    step = np.arange(samples)
    left = before[:, step // STEPS_PER_FRAME]
    right = after[:, -(-step // STEPS_PER_FRAME)]
    between = (left >= 0) & (right < frames)
    first = jnp.minimum(after[:, :1], frames - 1)
    once = jnp.sum(valid, axis=1, keepdims=True) == 1
    left = jnp.where(once, first, jnp.clip(left, 0, frames - 1))
    right = jnp.where(once, first, jnp.clip(right, 0, frames - 1))
    at = jnp.asarray(step / STEPS_PER_FRAME, objects.x.dtype)
    span = jnp.maximum(right - left, 1).astype(objects.x.dtype)
    share = jnp.where(right > left, (at - left.astype(objects.x.dtype)) / span, 0)
    pick = lambda values, frame: jnp.take_along_axis(values, frame, axis=1)
    mix = lambda values: pick(values, left) + share * (pick(values, right) - pick(values, left))
    turn = wrap(pick(objects.heading, right) - pick(objects.heading, left))
    heading = wrap(pick(objects.heading, left) + share * turn)
    x, y, there = mix(objects.x), mix(objects.y), between | once
    known = jnp.any(valid, axis=1)
    if profile.drops_touching:
        size = (objects.length, objects.width)
        touches = ego_contacts(ego_box(ego, vehicle), x[:, 0], y[:, 0], heading[:, 0], *size)
        known &= ~(touches & there[:, 0])
    agent = is_agent(objects.type)
    speed = jnp.hypot(pick(objects.vx, first), pick(objects.vy, first))[:, 0]
    return AgentForecast(
        x=x,
        y=y,
        heading=heading,
        sample_valid=there,
        length=objects.length,
        width=objects.width,
        type=objects.type,
        is_agent=agent,
        speed=jnp.where(agent, speed, 0),
        current_heading=heading[:, 0],
        track=jnp.arange(x.shape[0], dtype=jnp.int32),
        valid=known,
        ignored=jnp.zeros(known.shape, bool),
    )
