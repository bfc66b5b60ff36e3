"""The work of a sweep on one chunk: every run of the grid, read at every point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from spdm_experiments.loading import LoadedScenes
from spdm_experiments.rows import Layout
from spdm_experiments.sweep_grid import Run
from spdm_experiments.sweep_rows import layout_of, poses_of, scored_rows
from spdm_experiments.sweep_scene import UNREAD, Reading, Shared, Switches, read_scene
from spdm_experiments.work import Arrays, Engine, Job
from spdm_jax import PlannerConfig, PlannerParams
from spdm_jax.types import ScenarioBatch


@dataclass(frozen=True)
class SweepJob(Job):
    """A sweep.

    Attributes:
      runs: sets of proposals to score.
    """

    runs: list[Run]

    def layout(self) -> Layout:
        """Returns the columns of the rows."""
        return layout_of(self.points)

    def unread(self) -> Sequence[str]:
        """Returns the layers that no planner reads."""
        return UNREAD

    def engine(self) -> "SweepEngine":
        """Returns what computes the chunks."""
        return SweepEngine(self)


class SweepEngine(Engine):
    """Computes chunks of one sweep."""

    job: SweepJob

    def compute(self, scenes: LoadedScenes, group: int) -> tuple[list[dict[str, Any]], Arrays]:
        """Computes every run of the grid; see `Engine`."""
        rows: list[dict[str, Any]] = []
        poses: list[Mapping[str, np.ndarray]] = []
        for run in self.job.runs:
            reading, run_ms = self._read(run, scenes.batch, group)
            known = (scenes.entries, scenes.track_ids)
            rows += scored_rows(self.layout, *known, reading, run.points, run_ms)
            if self.job.arrays:
                tokens = [entry.token for entry in scenes.entries]
                poses.append(poses_of(reading, tokens, run.points, scenes.origins))
        return rows, _join(poses)

    def _read(self, run: Run, scenes: Any, group: int) -> tuple[Reading, float]:
        """Returns the readings `[B, C]` of one run and the milliseconds one scenario took."""
        shape = self.job.groups[group]
        config = replace(run.config, max_path_points=shape.max_path_points)
        given = (run.params, run.num_proposals, run.by_goal)
        reading, run_ms = self._call(config, *given, scenes, shape.chunk)
        # Stage 1 alone keeps its paths where stage 2 would rebuild them, and knows no overflow of
        # stage 2: there the set without stage 2 is not the first part of the larger one.
        alone = [c for c, n in enumerate(run.num_proposals) if n == run.num_stage1]
        rows = np.flatnonzero(np.asarray(reading.moved | reading.overflow)[:, 0])
        if config.num_route_paths and alone and len(rows):
            part = jax.tree.map(lambda leaf: leaf[rows], scenes)
            config = replace(config, num_route_paths=0)
            given = (run.params, (run.num_stage1,), (run.by_goal[alone[0]],))
            first, _ = self._call(config, *given, part, shape.chunk)
            reading = jax.tree.map(partial(_put, rows=rows, column=alone[0]), reading, first)
        return reading, run_ms

    def _call(
        self,
        config: PlannerConfig,
        params: PlannerParams,
        num_proposals: tuple[int, ...],
        by_goal: tuple[bool, ...],
        scenes: ScenarioBatch,
        chunk: int,
    ) -> tuple[Reading, float]:
        switches = Switches(config, self.job.arrays is not None)
        runner = self.runner(read_scene, switches, chunk)
        shared = Shared(
            params=params,
            num_proposals=np.array(num_proposals, np.int32),
            by_goal=np.array(by_goal, bool),
        )
        before = runner.stats.run_s
        reading = runner(scenes, None, shared)
        run_ms = 1e3 * (runner.stats.run_s - before) / len(scenes.num_history)
        columns = lambda flag: np.repeat(flag[:, None], len(num_proposals), axis=1)
        reading = reading.replace(overflow=columns(reading.overflow), moved=columns(reading.moved))
        return reading, run_ms


def _put(all_: np.ndarray, some: np.ndarray, rows: np.ndarray, column: int) -> np.ndarray:
    changed = all_.copy()
    changed[rows, column] = some[:, 0]
    return changed


def _join(poses: Sequence[Mapping[str, np.ndarray]]) -> Arrays:
    if not poses:
        return {}
    return {name: np.concatenate([part[name] for part in poses]) for name in poses[0]}
