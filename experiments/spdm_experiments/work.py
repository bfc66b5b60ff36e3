"""What the verbs that go through scenarios chunk by chunk have in common: jobs, chunks, engines.

Whoever does the work (this process, or a worker of a cluster) is given a `Job` once and a `Chunk`
at a time; nothing else is shared.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.inventory import Entry
from spdm_experiments.loading import LoadedScenes, Loader
from spdm_experiments.parts import part_name
from spdm_experiments.rows import Layout, failed_rows
from spdm_experiments.run_folder import write_part
from spdm_jax.batching import BatchConfig, BatchStats, Precision, SceneRunner
from spdm_jax.padding import PaddingConfig

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Group:
    """Scenarios of one shape.

    Attributes:
      padding: one size per axis.
      max_path_points: room for the points of a path.
      max_lane_points: points of the longest lane.
      chunk: scenarios at a time.
      num_iterations: of each of them; None where the verb does not ask.
    """

    padding: PaddingConfig
    max_path_points: int
    max_lane_points: int
    chunk: int
    num_iterations: int | None = None


@dataclass(frozen=True)
class Job(ABC):
    """What all chunks of a run have in common.

    Attributes:
      folder: of the run.
      points: as run.json holds them.
      groups: shapes.
      precision: of all computation.
      batching: how scenes are spread over devices.
      arrays: folder of what lies beside the rows, one of `run_folder.ARRAYS`, or None.
    """

    folder: Path
    points: list[dict[str, Any]]
    groups: list[Group]
    precision: Precision
    batching: BatchConfig
    arrays: str | None

    @abstractmethod
    def layout(self) -> Layout:
        """Returns the columns of the rows."""

    @abstractmethod
    def unread(self) -> Sequence[str]:
        """Returns prefixes of the scenario's fields that nobody reads."""

    @abstractmethod
    def engine(self) -> "Engine":
        """Returns what computes the chunks."""

    def loader(self) -> Loader:
        """Returns what reads the scenarios."""
        dtype = np.float64 if self.precision == "f64" else np.float32
        return Loader(unread=self.unread(), dtype=dtype)


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
      reasons: token -> why its rows are not all "ok", "" where they are.
      programs: programs that had to be made.
      seconds: of this chunk: "load", "compile", "run", "write".
      messages: what the user should know.
    """

    name: str
    reasons: dict[str, str]
    programs: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)


def load_chunk(chunk: Chunk, job: Job, loader: Loader) -> Loaded:
    """Reads the files of a chunk."""
    started = time.perf_counter()
    scenes = loader.load(chunk.entries, job.groups[chunk.group].padding)
    return Loaded(chunk, scenes, time.perf_counter() - started)


class Engine(ABC):
    """Computes chunks of one job. A verb says how rows come from scenes (`compute`)."""

    def __init__(self, job: Job):
        self.job = job
        self.layout = job.layout()
        self._runners: dict[tuple[Hashable, int], SceneRunner] = {}
        self._messages = 0

    @property
    def stats(self) -> list[BatchStats]:
        """Counters of all programs."""
        return [runner.stats for runner in self._runners.values()]

    def runner(self, function: Callable[..., Any], switches: Hashable, chunk: int) -> SceneRunner:
        """Returns what runs the engine's function, one runner for each of its static settings.

        Args:
          function: as `SceneRunner` takes it, the same at every call.
          switches: its static settings.
          chunk: scenes per device call.
        """
        if (switches, chunk) not in self._runners:
            batching = replace(self.job.batching, chunk=chunk)
            self._runners[switches, chunk] = SceneRunner(
                function, switches, precision=self.job.precision, config=batching
            )
        return self._runners[switches, chunk]

    @abstractmethod
    def compute(self, scenes: LoadedScenes, group: int) -> tuple[list[dict[str, Any]], Arrays]:
        """Computes scenes that were read.

        Args:
          scenes: of one shape, `batch` included.
          group: number of the shape.

        Returns:
          Rows, one per scene and point in any order, and arrays to keep beside them (empty: none).
        """

    def process(self, loaded: Loaded) -> Done:
        """Computes a chunk and writes its part."""
        job, chunk, scenes = self.job, loaded.chunk, loaded.scenes
        before = self._totals()
        rows, arrays = failed_rows(self.layout, scenes.failures), {}
        if scenes.batch is not None:
            found, arrays = self.compute(scenes, chunk.group)
            rows += found
        scenes.release()
        order = {entry.token: i for i, entry in enumerate(chunk.entries)}
        rows.sort(key=lambda row: (order[row["token"]], row["point"]))
        started = time.perf_counter()
        write_part(job.folder, chunk.name, self.layout.frame(rows), arrays, job.arrays)
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


def outcome(name: str, rows: Sequence[Mapping[str, Any]]) -> Done:
    """Sums up the rows of a part."""
    reasons: dict[str, str] = {}
    for row in rows:
        reasons[row["token"]] = reasons.get(row["token"], "") or row["reason"]
    return Done(name, reasons)
