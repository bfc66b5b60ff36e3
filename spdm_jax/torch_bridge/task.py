"""What is computed for torch, as pure functions of arrays on the device.

The file is apart from the rest because a stored program is found by the source that it was made
from.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.api import score_scene
from spdm_jax.config import DT, NUM_STATES, PlannerConfig, PlannerParams
from spdm_jax.decision import poses_only
from spdm_jax.trajectories import Frame, resampling
from spdm_jax.types import Array, EgoState, Scenario

COMPONENTS = (
    "total",
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "progress",
    "progress_raw",
    "collision_time",
    "ttc_time",
)
"""Fields of `SubScores` with one number per trajectory."""


@dataclass(frozen=True)
class Task:
    """What a new value of compiles anew."""

    config: PlannerConfig
    tracks: bool
    frame: Frame
    dt: float


class Found(struct.PyTreeNode, kw_only=True):
    """Scores `[C, P]` of one scene, in the order of `COMPONENTS`, and a key of `PROBLEMS` or 0."""

    scores: Array
    problem: Array


def score_rows(task: Task, scene: Scenario, trajectories: Array, params: PlannerParams) -> Found:
    """Scores `[P, T, 3]` in one scene (pure)."""
    ego = jax.tree.map(lambda leaf: leaf[scene.num_history], scene.ego)
    poses = place(trajectories, ego, task)
    states = poses_only(*jnp.moveaxis(poses, -1, 0))
    if not task.tracks:
        states = differentiated(states, ego)
    scores, _, _, overflow = score_scene(scene, states, params, task.config, tracker=task.tracks)
    finite = jnp.all(jnp.isfinite(scores.total))
    return Found(
        scores=jnp.stack([getattr(scores, name) for name in COMPONENTS]),
        problem=jnp.where(jnp.asarray(overflow), 1, jnp.where(finite, 0, 2)),
    )


def score_batch(
    task: Task, scenes: Scenario, index: Array, trajectories: Array, params: PlannerParams
) -> Found:
    """Scores `[B, P, T, 3]`, row b in scene `index[b]`; the scores are `[C, B, P]`."""

    def one(number, poses):
        scene = jax.tree.map(lambda leaf: leaf[number], scenes)
        return score_rows(task, scene, poses, params)

    return jax.vmap(one, out_axes=Found(scores=1, problem=0))(index, trajectories)


def place(values: Array, ego: EgoState, task: Task) -> Array:
    """Local poses `[P, 41, 3]`: `trajectories.resample` and `to_local` on the device."""
    here = jnp.stack([ego.x, ego.y, ego.heading])
    if np.isclose(task.dt, DT):
        values = values[:, :NUM_STATES]
    else:
        lacks_current, right, share = resampling(values.shape[1], task.dt)
        if lacks_current:
            front = here if task.frame == "local" else jnp.zeros_like(here)
            front = jnp.broadcast_to(front, (values.shape[0], 1, 3))
            values = jnp.concatenate([front, values], axis=1)
        share = jnp.asarray(share, values.dtype)[:, None]
        heading = jnp.unwrap(values[..., 2:], axis=1)
        values = jnp.concatenate([values[..., :2], heading], axis=-1)
        before = values[:, right - 1]
        values = before + share * (values[:, right] - before)
    if task.frame == "local":
        return values
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    x, y, heading = (values[..., i] for i in range(3))
    return here + jnp.stack([cos * x - sin * y, sin * x + cos * y, heading], axis=-1)


def differentiated(states: EgoState, ego: EgoState) -> EgoState:
    """Speeds and accelerations from poses: `trajectories.untracked_states` on the device."""
    x, y, heading = jnp.diff(states.x), jnp.diff(states.y), states.heading[:, :-1]
    start = lambda value: jnp.broadcast_to(value, (states.x.shape[0], 1))
    speed = (x * jnp.cos(heading) + y * jnp.sin(heading)) / DT
    speed = jnp.concatenate([start(ego.vx), speed], axis=1)
    acceleration = jnp.concatenate([start(ego.ax), jnp.diff(speed) / DT], axis=1)
    return states.replace(vx=speed, ax=acceleration)
