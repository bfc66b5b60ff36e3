"""Time stamps as NAVSIM counts them: whole microseconds (host, float64 and integers)."""

import numpy as np

from spdm_jax.config import NUM_STATES
from spdm_jax.navsim.types import NUM_POSES, EgoPast, Sampling

SAMPLE_US = 100_000
"""Interval of scored states and of the past, microseconds."""
MAX_PLAN_AGE_US = 550_000
"""Oldest previous plan that extended comfort compares with, microseconds."""
# State columns that are interpolated; the others of the past are 0 (NAVSIM).
_HEADING, _AX, _AY = 2, 5, 6
_LINEAR = (0, 1, 3, 4, 5, 6, 7)


def pose_times(start_us: int) -> np.ndarray:
    """Time stamps `[8]` of predicted poses, microseconds.

    Source: NAVSIM `transform_trajectory`: seconds in float64, then truncated.
    """
    seconds = start_us * 1e-6
    return ((np.arange(0, 0.5 * NUM_POSES, 0.5) + 0.5 + seconds) * 1e6).astype(np.int64)


def sample_times(start_us: int) -> np.ndarray:
    """Time stamps `[41]` of the scored states, microseconds.

    Source: NAVSIM `get_trajectory_as_array`: seconds in float64, then truncated, so that a stamp
    may be one microsecond early; clipped to the trajectory.
    """
    seconds = start_us * 1e-6
    times = ((np.arange(NUM_STATES) * 0.1 + seconds) * 1e6).astype(np.int64)
    return np.clip(times, start_us, pose_times(start_us)[-1])


def sampling(start_us: int) -> Sampling:
    """Where the samples lie among the current pose and the predicted ones."""
    nodes = np.concatenate([[start_us], pose_times(start_us)])
    times = sample_times(start_us)
    left = np.clip(np.searchsorted(nodes, times, side="right") - 1, 0, NUM_POSES - 1)
    share = (times - nodes[left]) / (nodes[left + 1] - nodes[left])
    return Sampling(left=left.astype(np.int32), share=share)


def past_samples(states: np.ndarray, times_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples the recorded past every 0.1 s.

    Args:
      states: `[K, 11]` recorded rear-axle states, oldest first, the current one last.
      times_us: `[K]` their time stamps.

    Returns:
      Time stamps `[H]` and states `[H, 11]`, headings unwrapped.

    Source: NAVSIM `PDMScorer` (v2.2), history comfort: stamps from the oldest state up to, without,
    the current one, and then without the last of them.
    """
    times = np.arange(times_us[0], times_us[-1], SAMPLE_US)[:-1]
    states = np.array(states, float)
    states[:, _HEADING] = np.unwrap(states[:, _HEADING])
    sampled = np.zeros((len(times), states.shape[1]))
    # Differences of stamps: a float64 second of today keeps a quarter of a microsecond only.
    at, nodes = times - times_us[0], times_us - times_us[0]
    for column in (*_LINEAR, _HEADING):
        sampled[:, column] = np.interp(at, nodes, states[:, column])
    return times, sampled


def ego_past(states: np.ndarray, room: int) -> EgoPast:
    """What history comfort reads of sampled states `[H, 11]`, the latest at the end of `room`.

    Raises:
      ValueError: they do not fit.
    """
    count = len(states)
    if count > room:
        raise ValueError(f"{count} past samples do not fit {room}")

    def column(index: int) -> np.ndarray:
        values = np.zeros(room)
        values[room - count :] = states[:, index]
        # Padding repeats the oldest heading: the filters never see it, but an unwrap would.
        values[: room - count] = states[0, index] if count else 0
        return values

    return EgoPast(
        heading=column(_HEADING), ax=column(_AX), ay=column(_AY), count=np.array(count, np.int32)
    )
