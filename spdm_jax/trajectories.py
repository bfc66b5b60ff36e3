"""Trajectories from outside: checks, resampling, frames, and states without a tracker (host)."""

from typing import Literal

import numpy as np

from spdm_jax.config import DT, NUM_STATES
from spdm_jax.types import EgoState

Frame = Literal["ego", "local", "global"]

STATE_COLUMNS = tuple(EgoState.__dataclass_fields__)
"""Column order of `[..., 11]` states (nuPlan's and tuplan_garage's)."""


def as_array(trajectories) -> np.ndarray:
    """NumPy array of whatever the user holds (NumPy, JAX, anything with `__array__`)."""
    return np.asarray(trajectories, np.float64)


def check_trajectories(values: np.ndarray, dt: float, num_scenes: int) -> np.ndarray:
    """Brings trajectories to `[B, P, T, 3 or 11]` and checks them.

    Raises:
      ValueError: wrong rank, batch size, columns, steps or interval, or a value that is not finite;
        names the first offending entry.
    """
    if values.ndim == 3:
        values = np.broadcast_to(values, (num_scenes, *values.shape))
    if values.ndim != 4 or values.shape[-1] not in (3, 11):
        raise ValueError(
            f"trajectories has shape {values.shape}; expected [B, P, T, 3] or [B, P, T, 11] for "
            f"{num_scenes} scenes, or [P, T, 3] for the same trajectories in every scene"
        )
    if values.shape[0] != num_scenes:
        raise ValueError(
            f"trajectories holds {values.shape[0]} scenes, the scenario set {num_scenes}; "
            "pass one set per scene, or [P, T, 3] for all of them"
        )
    if values.shape[1] == 0:
        raise ValueError("trajectories holds no proposals (shape[1] is 0)")
    if not dt > 0:
        raise ValueError(f"dt is {dt}; it must be a positive number of seconds")
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        at = tuple(int(i) for i in bad[0])
        raise ValueError(
            f"trajectories{list(at)} is {values[at]}; all poses must be finite "
            f"({len(bad)} values are not)"
        )
    return values


def resample(values: np.ndarray, dt: float) -> np.ndarray:
    """Brings trajectories to 41 states at 0.1 s.

    Linear in time, headings unwrapped first. Longer trajectories are cut at 4 s; ones without the
    current pose (8 poses at 0.5 s) get it in front.

    Args:
      values: `[B, P, T, C]` in the ego frame of each scene, so that the current pose is 0.
      dt: their interval, s.

    Raises:
      ValueError: the trajectories do not cover 4 s.
    """
    steps = values.shape[2]
    needed = NUM_STATES - 1
    if np.isclose(dt, DT) and steps >= NUM_STATES:
        return values[:, :, :NUM_STATES]
    horizon = needed * DT
    if np.isclose(dt, DT) or steps * dt < horizon - 1e-6:
        hint = (
            f"{steps} steps at {dt:g} s end at {(steps - 1) * dt:g} s"
            if not np.isclose(dt, DT)
            else "Pass dt=... if they are not 0.1 s apart"
        )
        raise ValueError(
            f"trajectories has {steps} steps at {dt:g} s; scoring needs {NUM_STATES} at {DT} s "
            f"(0 ... {horizon:g} s). {hint}."
        )
    lacks_current, right, weight = resampling(steps, dt)
    if lacks_current:
        values = np.concatenate([np.zeros_like(values[:, :, :1]), values], axis=2)
    values = np.concatenate(
        [values[..., :2], np.unwrap(values[..., 2:3], axis=2), values[..., 3:]], axis=-1
    )
    left_values, right_values = values[:, :, right - 1], values[:, :, right]
    return left_values + weight[:, None] * (right_values - left_values)


def resampling(steps: int, dt: float) -> tuple[bool, np.ndarray, np.ndarray]:
    """How 41 states at 0.1 s lie among `steps` poses that cover 4 s.

    Returns:
      Whether the current pose is to be put in front (the first one is an interval ahead), and for
      each state, counted with it, the pose to its right `[41]` and the share of that one `[41]`.
    """
    lacks_current = (steps - 1) * dt < (NUM_STATES - 1) * DT - 1e-6
    time = np.arange(steps + lacks_current) * dt
    wanted = np.arange(NUM_STATES) * DT
    right = np.clip(np.searchsorted(time, wanted - 1e-9), 1, len(time) - 1)
    share = np.clip((wanted - time[right - 1]) / (time[right] - time[right - 1]), 0, 1)
    return lacks_current, right, share


def to_local(
    values: np.ndarray, frame: Frame, ego_pose: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Moves poses into the scenes' local frames.

    Args:
      values: `[B, P, T, C]`, the first three columns x, y, heading.
      frame: frame they are given in.
      ego_pose: `[B, 3]` current rear-axle pose, local frame.
      origin: `[B, 2]` float64 map coordinates of the local frames.
    """
    values = np.array(values)
    if frame == "global":
        values[..., :2] -= origin[:, None, None]
    elif frame == "ego":
        cos, sin = np.cos(ego_pose[:, 2]), np.sin(ego_pose[:, 2])
        x, y = values[..., 0].copy(), values[..., 1].copy()
        cos, sin = cos[:, None, None], sin[:, None, None]
        values[..., 0] = ego_pose[:, 0, None, None] + cos * x - sin * y
        values[..., 1] = ego_pose[:, 1, None, None] + sin * x + cos * y
        values[..., 2] += ego_pose[:, 2, None, None]
    elif frame != "local":
        raise ValueError(f"frame is {frame!r}; it must be 'ego', 'local' or 'global'")
    return values


def to_ego(
    values: np.ndarray, frame: Frame, ego_pose: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Inverse of `to_local` into the ego frame: the current pose becomes 0."""
    if frame == "ego":
        return values
    values = to_local(values, frame, ego_pose, origin)
    x = values[..., 0] - ego_pose[:, 0, None, None]
    y = values[..., 1] - ego_pose[:, 1, None, None]
    cos, sin = np.cos(ego_pose[:, 2])[:, None, None], np.sin(ego_pose[:, 2])[:, None, None]
    values[..., 0], values[..., 1] = cos * x + sin * y, cos * y - sin * x
    values[..., 2] -= ego_pose[:, 2, None, None]
    return values


def untracked_states(poses: np.ndarray, current: EgoState) -> np.ndarray:
    """States `[B, P, T, 11]` straight from poses, for scoring without a tracker.

    Speeds and accelerations are differences along the heading; the first state keeps the ego's own
    speed and acceleration.

    Args:
      poses: `[B, P, T, 3]` local frame, 0.1 s apart.
      current: `[B]` current ego states.
    """
    states = np.zeros((*poses.shape[:-1], len(STATE_COLUMNS)))
    states[..., :3] = poses
    step = np.diff(poses[..., :2], axis=2)
    heading = poses[..., :-1, 2]
    along = (step[..., 0] * np.cos(heading) + step[..., 1] * np.sin(heading)) / DT
    states[..., 1:, 3] = along
    states[..., 0, 3] = np.asarray(current.vx)[:, None]
    states[..., 1:, 5] = np.diff(states[..., 3], axis=2) / DT
    states[..., 0, 5] = np.asarray(current.ax)[:, None]
    return states
