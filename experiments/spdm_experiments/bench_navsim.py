"""Benchmark rows of NAVSIM's scores: many predicted trajectories in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spdm_jax import ScenarioSet, to_navsim
from spdm_jax.navsim.evaluate import STEPS_PER_POSE, score_frames
from spdm_jax.navsim.results import NavsimScoreSet
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, Profile

if TYPE_CHECKING:
    from spdm_experiments.bench_rows import Child

PROFILES: Final = (NAVSIM1, NAVSIM2)


def navsim_fans(
    child: Child, scenes: ScenarioSet, fan: np.ndarray, counts: Mapping[str, int]
) -> None:
    """Adds rows that drive and score trajectories by NAVSIM's rules, with a previous plan each.

    Args:
      child: takes the rows.
      scenes: one scenario.
      fan: `[P, 41, 3]` trajectories in the ego frame, 0.1 s apart.
      counts: of the scene, for the rows.
    """
    frames = to_navsim(scenes, precision=child.precision)
    poses = fan[:, STEPS_PER_POSE::STEPS_PER_POSE]
    plans = np.ascontiguousarray(poses[None])
    for profile in PROFILES:

        def run(some: slice, profile: Profile = profile) -> NavsimScoreSet:
            previous = plans[:, some] if profile.judges("extended_comfort") else None
            return score_frames(
                frames, poses[some], profile, previous=previous, precision=child.precision
            )

        def alone(found: NavsimScoreSet, run=run) -> dict[str, Any]:
            # Unlike PDM's, every number of a trajectory is its own.
            half = run(slice(len(poses) // 2))
            for name in ("total", "progress", "progress_raw"):
                whole, part = getattr(found, name), getattr(half, name)
                if not np.array_equal(whole[:, : part.shape[1]], part):
                    raise RuntimeError(f"{name} of a trajectory depends on the others")
            names = ("no_at_fault_collision", "drivable_area", "driving_direction")
            failing = {
                name: float(np.mean(getattr(found.scores.raw, name) < 1))
                for name in (*names, "time_to_collision", "comfort")
            }
            return {"failing": failing, "mean_score": float(np.mean(found.total))}

        child.add(
            f"{profile.name} {len(poses)}",
            lambda run=run: run(slice(None)),
            alone,
            num_proposals=len(poses),
            **counts,
        )
