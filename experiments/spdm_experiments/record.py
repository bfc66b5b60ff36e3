"""The folder a run leaves: rows.parquet, run.json and trajectories.npz, always whole.

Every file is replaced at once, after each chunk: whatever stops a run, the folder holds what was
finished, and run.json says whether that is all.
"""

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars

from spdm_experiments.runtime import Clock, now, provenance
from spdm_jax import Failure, NavsimScoreSet, PlanSet, ScenarioSet, ScoreSet
from spdm_jax.io.scenario_file import write_atomically

ROWS = "rows.parquet"
RUN = "run.json"
TRAJECTORIES = "trajectories.npz"


class Record:
    """Collects the results of a run and writes them."""

    def __init__(self, folder: Path, about: Mapping[str, Any], failures: list[Failure]):
        """Starts a record; an older one in the folder is removed.

        Args:
          folder: made if absent.
          about: what run.json says of the run, besides what is the same for all.
          failures: scenarios that were not usable to begin with; `failed` has all so far.
        """
        self.folder = folder
        self.failed = {failure.token: failure.reason for failure in failures}
        self.files: list[Path] = []
        self._about = {**about, "started": now(), **provenance()}
        self._frames: list[polars.DataFrame] = []
        self._tokens: list[str] = []
        self._trajectories: list[np.ndarray] = []
        folder.mkdir(parents=True, exist_ok=True)
        for name in (RUN, ROWS, TRAJECTORIES):
            (folder / name).unlink(missing_ok=True)

    def add(self, result: ScoreSet | NavsimScoreSet) -> None:
        """Takes the rows of a result; scenes that are not "ok" become failures without scores."""
        self._frames.append(rows(result).filter(polars.col("status") == "ok"))
        self.failed |= {failure.token: failure.reason for failure in unusable(result)}

    def add_trajectories(self, scenes: ScenarioSet, result: PlanSet) -> None:
        """Takes the plans, in map coordinates."""
        for i, status in enumerate(result.status):
            if status == "ok":
                self._tokens.append(result.infos[i].token)
                self._trajectories.append(global_plan(scenes, result, i))

    def save(self, *, clock: Clock, finished: bool) -> None:
        """Writes what has been taken so far."""
        table = self.table()
        buffer = io.BytesIO()
        table.write_parquet(buffer)
        self._write(ROWS, buffer.getvalue())
        if self._trajectories:
            buffer = io.BytesIO()
            np.savez_compressed(
                buffer,
                tokens=np.array(self._tokens),
                trajectories=np.stack(self._trajectories)[:, None],
            )
            self._write(TRAJECTORIES, buffer.getvalue())
        description = {
            **self._about,
            "ended": now(),
            "finished": finished,
            "scenarios_done": self.num_done(),
            "scenarios_failed": len(self.failed),
            "failures": self.failed,
            "times": clock.seconds(),
        }
        self._write(RUN, (json.dumps(description, indent=1) + "\n").encode())

    def table(self) -> polars.DataFrame:
        """Returns all rows so far, failed scenarios last (their scores are null)."""
        frames = list(self._frames)
        if self.failed:
            failed = {
                "token": list(self.failed),
                "status": ["failed"] * len(self.failed),
                "reason": list(self.failed.values()),
            }
            frames.append(polars.DataFrame(failed))
        return polars.concat(frames, how="diagonal_relaxed") if frames else polars.DataFrame()

    def num_done(self) -> int:
        """Returns how many scenarios have scores from every planner."""
        scored = {token for frame in self._frames for token in frame["token"].unique()}
        return len(scored - self.failed.keys())

    def _write(self, name: str, content: bytes) -> None:
        path = self.folder / name
        write_atomically(path, content)
        if path not in self.files:
            self.files.append(path)


def rows(result: ScoreSet | NavsimScoreSet) -> polars.DataFrame:
    """Returns one row per real proposal: `to_table`, and for plans what the planner knew of it."""
    table = dataclasses.replace(result, failures=[]).to_table()
    if not isinstance(result, PlanSet):
        return table
    valid = np.asarray(result.scores.valid)
    scene, _ = np.nonzero(valid)
    plans = result.plans
    policy = np.asarray(plans.proposals.policy)[valid]
    return table.with_columns(
        num_proposals=result.num_proposals[scene],
        target_speed=np.asarray(plans.target_speed)[scene, policy],
        progress_centerline=np.asarray(plans.progress_centerline)[valid],
        progress_goal=np.asarray(plans.progress_goal)[valid],
        emergency_brake=np.asarray(plans.emergency_brake)[scene],
    )


REASONS = {
    "overflow": "more path points or red lights than the planner has room for; raise "
    "PlannerConfig.max_path_points, max_red_lights or max_red_edges in the Python API",
    "failed": "a score is not a finite number; compare with --precision f64, and run: spdm doctor",
}


def unusable(result: ScoreSet | NavsimScoreSet) -> list[Failure]:
    """Returns the scenes of a result whose scores are not to be used, with reasons."""
    return [
        Failure(info.token, REASONS[status])
        for info, status in zip(result.infos, result.status, strict=True)
        if status != "ok"
    ]


def global_plan(scenes: ScenarioSet, result: PlanSet, row: int) -> np.ndarray:
    """Returns a plan `[81, 3]` in map coordinates: rear-axle x, y, heading, 0.1 s apart."""
    plan = result.trajectory
    poses = [np.asarray(values)[row] for values in (plan.x, plan.y, plan.heading)]
    values = np.stack(poses, axis=-1).astype(np.float64)
    values[:, :2] += np.asarray(scenes.batch.origin)[row]
    return values
