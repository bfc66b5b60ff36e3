"""What labels need of one scene: trajectories brought to it, and their sub-scores as numbers.

The file is apart from the rest because a stored program is found by the source that it was made
from.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.decision import poses_only
from spdm_jax.scene_score import score_scene
from spdm_jax.scoring.aggregate import aggregate_sets
from spdm_jax.trajectories import STATE_COLUMNS, to_local, untracked_states
from spdm_jax.types import Array, EgoState, Scenario, ScenarioBatch

COMPONENTS = (
    "total",
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "progress",
    "progress_raw",
)
"""Fields of `SubScores` that a label may hold, one number per trajectory."""


@dataclass(frozen=True)
class Switches:
    """What a new value of compiles anew.

    Attributes:
      config: forecast, progress reference, tracker and caps.
      tracks: whether trajectories are tracked before they are scored.
    """

    config: PlannerConfig
    tracks: bool


class Part(struct.PyTreeNode, kw_only=True):
    """Part of a scene's trajectories.

    Attributes:
      states: `[P, 41, 3]` poses to be tracked, or `[P, 41, 11]` states; local frame.
      valid: `[P]` bool.
    """

    states: Array
    valid: Array


class Scored(struct.PyTreeNode, kw_only=True):
    """Sub-scores of a part.

    Attributes:
      scores: component -> `[P]`.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    scores: dict[str, Array]
    overflow: Array


def score_part(scene: Scenario, part: Part, params: PlannerParams, static: Switches) -> Scored:
    """Scores trajectories in one scene at iteration 0 (pure).

    Args:
      scene: one scenario on the device.
      part: trajectories.
      params: traced settings.
      static: static settings.
    """
    columns = jnp.moveaxis(part.states, -1, 0)
    if len(columns) == 3:
        states = poses_only(*columns)
    else:
        states = EgoState(**dict(zip(STATE_COLUMNS, columns, strict=True)))
    scores, _, _, overflow = score_scene(
        scene, states, params, static.config, tracker=static.tracks, valid=part.valid
    )
    return Scored(scores={name: getattr(scores, name) for name in COMPONENTS}, overflow=overflow)


def place(vocabulary: np.ndarray, scenes: ScenarioBatch, tracks: bool) -> np.ndarray:
    """Brings one vocabulary into the local frames of several scenes.

    Args:
      vocabulary: `[V, 41, 3]`, ego frame, float64.
      scenes: NumPy leaves `[B, ...]`, float64.
      tracks: return poses; else states differentiated from them.

    Returns:
      `[B, V, 41, 3]`, or `[B, V, 41, 11]`.
    """
    rows = np.arange(len(scenes.num_history))
    ego = jax.tree.map(lambda leaf: leaf[rows, scenes.num_history], scenes.ego)
    pose = np.stack([ego.x, ego.y, ego.heading], axis=-1)
    everywhere = np.broadcast_to(vocabulary, (len(rows), *vocabulary.shape))
    local = to_local(everywhere, "ego", pose, scenes.origin)
    return local if tracks else untracked_states(local, ego)


def join(scored: Scored, count: int, parts: int, params: PlannerParams) -> Scored:
    """Puts the parts of each scene together again.

    Progress is relative to all trajectories of a scene: where there are several parts, it and the
    total are computed anew.

    Args:
      scored: `[B * parts, P]` on the host.
      count: V, real trajectories of a scene.
      parts: parts of a scene.
      params: settings.

    Returns:
      Scores `[B, V]`, overflow `[B]`.
    """
    whole = lambda v: v.reshape(-1, parts * v.shape[1])[:, :count]
    scores = {name: whole(values) for name, values in scored.scores.items()}
    if parts > 1:
        combined = aggregate_sets(
            scores["no_at_fault_collision"] * scores["drivable_area"] * scores["driving_direction"],
            scores["progress_raw"],
            scores["time_to_collision"],
            scores["comfort"],
            np.ones(scores["total"].shape, bool),
            params.scoring,
        )
        scores |= {"progress": combined.progress, "total": combined.total}
    return Scored(scores=scores, overflow=scored.overflow.reshape(-1, parts).any(axis=1))
