"""What is computed for torch, as pure functions of arrays on the device.

The file is apart from the rest because a stored program is found by the source that it was made
from.
"""

from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.config import DT, NUM_STATES, PlannerConfig, PlannerParams
from spdm_jax.decision import poses_only
from spdm_jax.navsim.evaluate import POSE_DT, STEPS_PER_POSE
from spdm_jax.navsim.results import COMPONENTS as NAVSIM_COMPONENTS
from spdm_jax.navsim.results import component
from spdm_jax.navsim.score import score_trajectories
from spdm_jax.navsim.types import NUM_POSES, NavsimScene
from spdm_jax.scene_score import score_scene
from spdm_jax.scoring.profile import Profile
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


@dataclass(frozen=True)
class NavsimTask:
    """The same for NAVSIM's profiles."""

    profile: Profile
    frame: Frame
    dt: float


AnyTask: TypeAlias = Task | NavsimTask


def components_of(task: AnyTask) -> tuple[str, ...]:
    """Names of the scores, in the order of `Found`."""
    return NAVSIM_COMPONENTS if isinstance(task, NavsimTask) else COMPONENTS


class Found(struct.PyTreeNode, kw_only=True):
    """Scores `[C, P]` of one scene, as `components_of` orders them, a key of `PROBLEMS` or 0."""

    scores: Array
    problem: Array


def score_rows(
    task: AnyTask, scene: Scenario | NavsimScene, trajectories: Array, params: PlannerParams
) -> Found:
    """Scores `[P, T, 3]` in one scene (pure)."""
    if isinstance(scene, NavsimScene):
        assert isinstance(task, NavsimTask)
        return _score_in_frame(task, scene, trajectories, params)
    assert isinstance(task, Task)
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


def _score_in_frame(
    task: NavsimTask, frame: NavsimScene, trajectories: Array, params: PlannerParams
) -> Found:
    # A reward is for one plan: it has none of the frame before.
    none = jnp.zeros_like(frame.previous.present)
    frame = frame.replace(previous=frame.previous.replace(present=none))
    poses = navsim_poses(trajectories, frame.ego, task)
    scores = score_trajectories(frame, poses, task.profile, params.scoring)
    finite = jnp.all(jnp.isfinite(scores.total))
    return Found(
        scores=jnp.stack([component(scores, name) for name in NAVSIM_COMPONENTS]),
        problem=jnp.where(finite, 0, 2),
    )


def score_batch(
    task: AnyTask,
    scenes: Scenario | NavsimScene,
    index: Array,
    trajectories: Array,
    params: PlannerParams,
) -> Found:
    """Scores `[B, P, T, 3]`, row b in scene `index[b]`; the scores are `[C, B, P]`."""

    def one(number, poses):
        scene = jax.tree.map(lambda leaf: leaf[number], scenes)
        return score_rows(task, scene, poses, params)

    return jax.vmap(one, out_axes=Found(scores=1, problem=0))(index, trajectories)


def place(values: Array, ego: EgoState, task: Task) -> Array:
    """Local poses `[P, 41, 3]`: `trajectories.resample` and `to_local` on the device."""
    here = jnp.stack([ego.x, ego.y, ego.heading])
    values = _resampled(values, task.dt, here if task.frame == "local" else jnp.zeros_like(here))
    if task.frame == "local":
        return values
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    x, y, heading = (values[..., i] for i in range(3))
    return here + jnp.stack([cos * x - sin * y, sin * x + cos * y, heading], axis=-1)


def navsim_poses(values: Array, ego: EgoState, task: NavsimTask) -> Array:
    """NAVSIM's poses `[P, 8, 3]`, ego frame: those of `evaluate.score_frames` on the device."""
    if task.frame == "local":
        cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
        x, y = values[..., 0] - ego.x, values[..., 1] - ego.y
        heading = values[..., 2] - ego.heading
        values = jnp.stack([cos * x + sin * y, cos * y - sin * x, heading], axis=-1)
    if values.shape[1] == NUM_POSES and np.isclose(task.dt, POSE_DT):
        return values
    return _resampled(values, task.dt, jnp.zeros_like(values[0, 0]))[
        :, STEPS_PER_POSE::STEPS_PER_POSE
    ]


def _resampled(values: Array, dt: float, here: Array) -> Array:
    """41 poses at 0.1 s; `here` is the current one, put in front where it is missing."""
    if np.isclose(dt, DT):
        return values[:, :NUM_STATES]
    lacks_current, right, share = resampling(values.shape[1], dt)
    if lacks_current:
        front = jnp.broadcast_to(here, (values.shape[0], 1, 3))
        values = jnp.concatenate([front, values], axis=1)
    share = jnp.asarray(share, values.dtype)[:, None]
    heading = jnp.unwrap(values[..., 2:], axis=1)
    values = jnp.concatenate([values[..., :2], heading], axis=-1)
    before = values[:, right - 1]
    return before + share * (values[:, right] - before)


def differentiated(states: EgoState, ego: EgoState) -> EgoState:
    """Speeds and accelerations from poses: `trajectories.untracked_states` on the device."""
    x, y, heading = jnp.diff(states.x), jnp.diff(states.y), states.heading[:, :-1]
    start = lambda value: jnp.broadcast_to(value, (states.x.shape[0], 1))
    speed = (x * jnp.cos(heading) + y * jnp.sin(heading)) / DT
    speed = jnp.concatenate([start(ego.vx), speed], axis=1)
    acceleration = jnp.concatenate([start(ego.ax), jnp.diff(speed) / DT], axis=1)
    return states.replace(vx=speed, ax=acceleration)
