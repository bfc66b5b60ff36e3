"""Scores trajectories in a set of NAVSIM frames (host): checks, blocks, one program for all."""

import jax
import numpy as np
from flax import struct

from spdm_jax.batching import BatchConfig, Precision, SceneRunner
from spdm_jax.config import DT, ScoringParams
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.navsim.results import NavsimScoreSet
from spdm_jax.navsim.score import score_states, score_trajectories
from spdm_jax.navsim.types import NUM_POSES, NavsimScene, NavsimScores
from spdm_jax.padding import bucket
from spdm_jax.scoring.profile import Profile
from spdm_jax.trajectories import (
    STATE_COLUMNS,
    Frame,
    as_array,
    check_trajectories,
    resample,
    to_ego,
    to_local,
)
from spdm_jax.types import Array

POSE_DT = 0.5
"""Interval of NAVSIM's poses, s."""
STEPS_PER_POSE = 5
"""Scored states per pose."""
BLOCK_SIZES = (16, 64, 256, 1024)
"""Trajectories scored by one program, padded to the next size; more are scored block by block."""
_PER_FRAME = ("human", "has_extended_comfort")
"""Fields of the scores without an axis of trajectories."""


class Block(struct.PyTreeNode, kw_only=True):
    """Part of a frame's trajectories.

    Attributes:
      given: `[P, 8, 3]` poses, ego frame, or `[P, 41, 11]` states, local frame.
      previous: `[1, 8, 3]` or `[P, 8, 3]` plans of the frame before, in its ego frame.
      has_previous: `[]` bool.
    """

    given: Array
    previous: Array
    has_previous: Array


def score_block(
    frame: NavsimScene, block: Block, params: ScoringParams, static: tuple[Profile, bool]
) -> NavsimScores:
    """Scores part of the trajectories of one frame (pure).

    Args:
      frame: one frame on the device.
      block: trajectories.
      params: thresholds.
      static: the profile, and whether states are given.
    """
    profile, as_states = static
    present = frame.previous.present & block.has_previous
    previous = frame.previous.replace(poses=block.previous, present=present)
    rule = score_states if as_states else score_trajectories
    return rule(frame.replace(previous=previous), block.given, profile, params)


def score_frames(
    frames: NavsimSet,
    trajectories,
    profile: Profile,
    *,
    dt: float | None = None,
    frame: Frame = "ego",
    previous=None,
    params: ScoringParams | None = None,
    precision: Precision = "f32",
    batching: BatchConfig | None = None,
) -> NavsimScoreSet:
    """Scores trajectories as NAVSIM does.

    Args:
      frames: from `load_frames` or `from_scenarios`.
      trajectories: `[B, P, T, 3]` or `[P, T, 3]` rear-axle poses, or full `[..., 11]` states, which
        are scored as they are. Of poses NAVSIM sees those at 0.5, 1.0, ... 4.0 s.
      profile: NAVSIM1, NAVSIM2 or NAVSIM2_UNFILTERED.
      dt: their interval, s; if None 0.5 for 8 poses, else 0.1.
      frame: "ego", "local" or "global".
      previous: `[B, 8, 3]` or `[B, P, 8, 3]` plans of the frame before, in its ego frame, for
        extended comfort; NaN where there is none. Without it the term is left out of the mean.
      params: thresholds.
      precision: "f32" or "f64".
      batching: how frames are spread over cores and devices.

    Returns:
      `NavsimScoreSet` with NumPy leaves `[B, P]`.

    Raises:
      ValueError: shapes, steps or interval do not fit, a value is not finite, or a frame lacks
        something that the profile looks at.
    """
    frames.require(profile)
    values = as_array(trajectories)
    step = pose_interval(values.shape, dt)
    values = check_trajectories(values, step, len(frames))
    given = _as_given(values, frames, step, frame)
    blocks, parts = _blocks(given, *_previous(previous, given.shape[:2]))
    as_states = given.shape[-1] == len(STATE_COLUMNS)
    run = SceneRunner(score_block, (profile, as_states), precision=precision, config=batching)
    owner = np.repeat(np.arange(len(frames)), parts)
    found = run(frames.stacked(), blocks, params or ScoringParams(), scene_of=owner)
    scores = _join(found, len(frames), parts, given.shape[1])
    return NavsimScoreSet(scores, frames.infos, profile, frames.failures)


def _as_given(values: np.ndarray, frames: NavsimSet, dt: float, frame: Frame) -> np.ndarray:
    """Poses `[B, P, 8, 3]` in the ego frame, or states `[B, P, 41, 11]` in the local one."""
    ego = [scene.ego for scene in frames.frames]
    pose = np.array([[float(e.x), float(e.y), float(e.heading)] for e in ego])
    origin = np.array([scene.origin for scene in frames.frames], float)
    values = to_ego(values, frame, pose, origin)
    if values.shape[-1] == len(STATE_COLUMNS):
        return to_local(resample(values, dt), "ego", pose, origin)
    return navsim_poses(values, dt)


def navsim_poses(values: np.ndarray, dt: float) -> np.ndarray:
    """Returns what NAVSIM sees of poses `[B, P, T, 3]`, ego frame: `[B, P, 8, 3]`.

    Raises:
      ValueError: they do not cover 4 s.
    """
    if values.shape[2] == NUM_POSES and np.isclose(dt, POSE_DT):
        return values
    return resample(values, dt)[:, :, STEPS_PER_POSE::STEPS_PER_POSE]


def pose_interval(shape: tuple[int, ...], given: float | None) -> float:
    """Returns the interval of trajectories of a shape, s: NAVSIM's for its own eight poses."""
    return given if given is not None else POSE_DT if shape[-2:] == (NUM_POSES, 3) else DT


def _previous(previous, count: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns plans `[B, 1 or P, 8, 3]` and `[B]` whether a frame has any.

    Raises:
      ValueError: another shape, or only part of a frame's values are numbers.
    """
    size, trajectories = count
    if previous is None:
        return np.zeros((size, 1, NUM_POSES, 3)), np.zeros(size, bool)
    plans = as_array(previous)
    plans = plans[:, None] if plans.ndim == 3 else plans
    if plans.shape not in ((size, n, NUM_POSES, 3) for n in (1, trajectories)):
        raise ValueError(
            f"previous has shape {np.shape(previous)}; expected [{size}, 8, 3] for one plan per "
            f"frame, or [{size}, {trajectories}, 8, 3] for one per trajectory"
        )
    known = np.isfinite(plans)
    flat = known.reshape(size, -1)
    whole, some = np.all(flat, axis=1), np.any(flat, axis=1)
    if partly := np.flatnonzero(some & ~whole).tolist():
        raise ValueError(
            f"previous[{partly[0]}] has values that are not finite; a frame without "
            "a previous plan has NaN everywhere"
        )
    return np.where(known, plans, 0.0), whole


def _blocks(given: np.ndarray, previous: np.ndarray, has: np.ndarray) -> tuple[Block, int]:
    """Cuts trajectories into blocks of one size; returns them and how many a frame has."""
    total, count = given.shape[:2]
    size = bucket(min(count, BLOCK_SIZES[-1]), BLOCK_SIZES)
    parts = -(-count // size)

    def split(values: np.ndarray) -> np.ndarray:
        # Rows beyond the last one repeat it; nobody reads their scores.
        rows = np.minimum(np.arange(parts * size), count - 1)
        return values[:, rows].reshape(total * parts, size, *values.shape[2:])

    one = previous.shape[1] == 1
    plans = np.repeat(previous, parts, axis=0) if one else split(previous)
    return Block(given=split(given), previous=plans, has_previous=np.repeat(has, parts)), parts


def _join(found: NavsimScores, total: int, parts: int, count: int) -> NavsimScores:
    first = lambda v: v.reshape(total, parts)[:, 0]
    whole = lambda v: v.reshape(total, parts * v.shape[1], *v.shape[2:])[:, :count]
    return found.replace(
        **{
            name: jax.tree.map(first if name in _PER_FRAME else whole, getattr(found, name))
            for name in NavsimScores.__dataclass_fields__
        }
    )
