"""The work of a sweep on one chunk: load, compute every run, write the part.

Whoever does the work (this process, or a worker of a cluster) is given a `Job` once and a `Chunk`
at a time; nothing else is shared.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from spdm_experiments.inventory import Entry
from spdm_experiments.loading import LoadedScenes, Loader
from spdm_experiments.parts import part_name
from spdm_experiments.run_folder import write_part
from spdm_experiments.sweep_grid import Run
from spdm_experiments.sweep_rows import Layout, failed_rows, poses_of, scored_rows
from spdm_experiments.sweep_scene import UNREAD, Reading, Shared, Switches, read_scene
from spdm_jax import PlannerConfig, PlannerParams
from spdm_jax.batching import BatchConfig, BatchStats, Precision, SceneRunner
from spdm_jax.padding import PaddingConfig
from spdm_jax.types import ScenarioBatch


@dataclass(frozen=True)
class Group:
    """Scenarios of one shape.

    Attributes:
      padding: one size per axis.
      max_path_points: room for the points of a path.
      chunk: scenarios at a time.
    """

    padding: PaddingConfig
    max_path_points: int
    chunk: int


@dataclass(frozen=True)
class Job:
    """What all chunks of a sweep have in common.

    Attributes:
      folder: of the run.
      points: as run.json holds them.
      runs: sets of proposals to score.
      groups: shapes.
      precision: of all computation.
      trajectories: whether to write poses.
      batching: how scenes are spread over devices.
    """

    folder: Path
    points: list[dict[str, Any]]
    runs: list[Run]
    groups: list[Group]
    precision: Precision
    trajectories: bool
    batching: BatchConfig


@dataclass(frozen=True)
class Chunk:
    """Scenarios that make one part of the run folder.

    Attributes:
      prefix: of the part's name, says whose part it is.
      group: their shape.
      entries: their files.
    """

    prefix: str
    group: int
    entries: list[Entry]

    @property
    def name(self) -> str:
        """Of the part."""
        return part_name(self.prefix, f"g{self.group}", [entry.token for entry in self.entries])


@dataclass
class Loaded:
    """A chunk in memory and the seconds that took."""

    chunk: Chunk
    scenes: LoadedScenes
    seconds: float


@dataclass
class Done:
    """What became of a chunk.

    Attributes:
      name: of its part.
      status: token -> whether all its rows are "ok".
      reasons: token -> why not, for those that are not.
      programs: programs that had to be made.
      seconds: of this chunk: "load", "compile", "run", "write".
      messages: what the user should know.
    """

    name: str
    status: dict[str, bool]
    reasons: dict[str, str]
    programs: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)


def loader_of(job: Job) -> Loader:
    """Returns what reads the scenarios of a job."""
    return Loader(unread=UNREAD, dtype=np.float64 if job.precision == "f64" else np.float32)


def load_chunk(chunk: Chunk, job: Job, loader: Loader) -> Loaded:
    """Reads the files of a chunk."""
    started = time.perf_counter()
    scenes = loader.load(chunk.entries, job.groups[chunk.group].padding)
    return Loaded(chunk, scenes, time.perf_counter() - started)


class Engine:
    """Computes chunks of one job."""

    def __init__(self, job: Job):
        self.job = job
        self.layout = Layout.of(job.points)
        self._runners: dict[tuple[Switches, int], SceneRunner] = {}
        self._messages = 0

    @property
    def stats(self) -> list[BatchStats]:
        """Counters of all programs."""
        return [runner.stats for runner in self._runners.values()]

    def process(self, loaded: Loaded) -> Done:
        """Computes a chunk and writes its part."""
        job, chunk, scenes = self.job, loaded.chunk, loaded.scenes
        before = self._totals()
        rows = failed_rows(self.layout, scenes.failures)
        poses: list[Mapping[str, np.ndarray]] = []
        for run in job.runs if scenes.batch is not None else ():
            reading, run_ms = self._read(run, scenes.batch, chunk.group)
            known = (scenes.entries, scenes.track_ids)
            rows += scored_rows(self.layout, *known, reading, run.points, run_ms)
            if job.trajectories:
                tokens = [entry.token for entry in scenes.entries]
                poses.append(poses_of(reading, tokens, run.points, scenes.origins))
        scenes.release()
        order = {entry.token: i for i, entry in enumerate(chunk.entries)}
        rows.sort(key=lambda row: (order[row["token"]], row["point"]))
        started = time.perf_counter()
        write_part(job.folder, chunk.name, self.layout.frame(rows), _join(poses))
        programs, compiled, run_s = self._totals()
        done = outcome(chunk.name, rows)
        done.programs = programs - before[0]
        done.seconds = {
            "load": loaded.seconds,
            "compile": compiled - before[1],
            "run": run_s - before[2],
            "write": time.perf_counter() - started,
        }
        messages = [m for stats in self.stats for m in stats.messages]
        done.messages, self._messages = messages[self._messages :], len(messages)
        return done

    def _totals(self) -> tuple[int, float, float]:
        stats = self.stats
        return (
            sum(s.programs for s in stats),
            sum(s.compile_s for s in stats),
            sum(s.run_s for s in stats),
        )

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
        switches = Switches(config, self.job.trajectories)
        runner = self._runners.get((switches, chunk))
        if runner is None:
            batching = replace(self.job.batching, chunk=chunk)
            runner = SceneRunner(
                read_scene, switches, precision=self.job.precision, config=batching
            )
            self._runners[switches, chunk] = runner
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


def _join(poses: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray] | None:
    if not poses:
        return None
    return {name: np.concatenate([part[name] for part in poses]) for name in poses[0]}


def outcome(name: str, rows: Sequence[Mapping[str, Any]]) -> Done:
    """Sums up the rows of a part."""
    done = Done(name, {}, {})
    for row in rows:
        token, ok = row["token"], row["status"] == "ok"
        done.status[token] = done.status.get(token, True) and ok
        if not ok:
            done.reasons.setdefault(token, row["reason"])
    return done
