"""Benchmark rows of NAVSIM's scores: many trajectories in one frame, some in each of many."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spdm_jax import ScenarioSet, load_navsim, to_navsim
from spdm_jax.navsim.evaluate import STEPS_PER_POSE, score_frames
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.navsim.results import NavsimScoreSet
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, Profile

if TYPE_CHECKING:
    from spdm_experiments.bench_rows import Child

PROFILES: Final = (NAVSIM1, NAVSIM2)
TRAJECTORIES = 64
"""In each frame of a batch, as a step of a training asks for them."""


def navsim_fans(
    child: Child, scenes: ScenarioSet, fan: np.ndarray, counts: Mapping[str, int]
) -> None:
    """Adds rows of one frame made from a scenario, each trajectory with a previous plan.

    Args:
      child: takes the rows.
      scenes: one scenario.
      fan: `[P, 41, 3]` trajectories in the ego frame, 0.1 s apart.
      counts: of the scene, for the rows.
    """
    frames = to_navsim(scenes, precision=child.precision)
    for profile in PROFILES:
        _one_frame(child, frames, fan, profile, f"{profile.name} {len(fan)}", **counts)


def recorded_frames(child: Child, fan: np.ndarray) -> None:
    """Adds rows of every exported frame in the child's folder, by each profile that it serves.

    Args:
      child: takes the rows.
      fan: `[P, 41, 3]` trajectories in the ego frame, 0.1 s apart.

    Raises:
      ScenarioError: a frame cannot be read.
    """
    for path in sorted(child.folder.glob("*.npz")):
        frames = load_navsim(path)
        with np.load(path, allow_pickle=False) as file:
            counts = {"objects": len(file["obj_type"]), "polygons": len(file["map_kind"])}
        for profile in PROFILES:
            if profile.name in frames.infos[0].profiles:
                name = f"{profile.name} {len(fan)}, {path.stem}"
                _one_frame(child, frames, fan, profile, name, recorded=True, **counts)


def navsim_batch(child: Child, scenes: ScenarioSet, fan: np.ndarray, **counts: int) -> None:
    """Adds a row of some trajectories in each of many frames, from host to host.

    Args:
      child: takes the rows.
      scenes: a scenario for each frame.
      fan: `[P, 41, 3]` trajectories in the ego frame, 0.1 s apart.
      counts: of the scenes, for the row.
    """
    frames = to_navsim(scenes, precision=child.precision)
    poses = _poses(fan)
    run = lambda some: score_frames(some, poses, NAVSIM2, precision=child.precision)

    def alone(found: NavsimScoreSet) -> dict[str, Any]:
        for row in sorted({0, len(frames) - 1}):
            if not np.array_equal(run(frames.select([row])).total[0], found.total[row]):
                raise RuntimeError(f"a score depends on the {len(frames)} frames of its batch")
        return _summary(found)

    child.add(
        f"{NAVSIM2.name} {len(frames)} x {len(poses)}",
        lambda: run(frames),
        alone,
        frames=len(frames),
        num_proposals=len(poses),
        **counts,
    )


def _one_frame(
    child: Child, frames: NavsimSet, fan: np.ndarray, profile: Profile, name: str, **about: Any
) -> None:
    poses = _poses(fan)
    plans = np.ascontiguousarray(poses[None])

    def run(some: slice) -> NavsimScoreSet:
        previous = plans[:, some] if profile.judges("extended_comfort") else None
        return score_frames(
            frames, poses[some], profile, previous=previous, precision=child.precision
        )

    def alone(found: NavsimScoreSet) -> dict[str, Any]:
        # Unlike PDM's, every number of a trajectory is its own.
        half = run(slice(len(poses) // 2))
        for name in ("total", "progress", "progress_raw"):
            whole, part = getattr(found, name), getattr(half, name)
            if not np.array_equal(whole[:, : part.shape[1]], part):
                raise RuntimeError(f"{name} of a trajectory depends on the others")
        return _summary(found)

    child.add(name, lambda: run(slice(None)), alone, frames=1, num_proposals=len(poses), **about)


def _poses(fan: np.ndarray) -> np.ndarray:
    """Returns the eight poses `[P, 8, 3]` that NAVSIM sees of trajectories `[P, 41, 3]`."""
    return fan[:, STEPS_PER_POSE::STEPS_PER_POSE]


def _summary(found: NavsimScoreSet) -> dict[str, Any]:
    names = ("no_at_fault_collision", "drivable_area", "driving_direction")
    failing = {
        name: float(np.mean(getattr(found.scores.raw, name) < 1))
        for name in (*names, "time_to_collision", "comfort")
    }
    return {"failing": failing, "mean_score": float(np.mean(found.total))}
