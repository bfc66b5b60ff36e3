"""Verbs whose folder has a row for every scenario at every point of a grid: sweep and simulate."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol

import jax
import polars

from spdm_experiments.chunks import suite_name
from spdm_experiments.inventory import Entry, Inventory, Shard, split
from spdm_experiments.options import OverGrid
from spdm_experiments.rows import failed_rows
from spdm_experiments.run_folder import (
    FORMAT,
    ROWS,
    clean,
    open_run,
    read_done,
    write_part,
)
from spdm_experiments.runtime import configure_jax, now, provenance
from spdm_experiments.sequence import Verb
from spdm_experiments.work import Chunk, Done, Group, Job, load_chunk
from spdm_jax import Failure
from spdm_jax.batching import padded_bytes, prefetch, usable_cores
from spdm_jax.padding import PATH_ROOM, PaddingConfig, bucket

MEMORY = {"cpu": 64 * 2**20, "gpu": 512 * 2**20}
"""Bytes that the scenarios of one chunk may take; three chunks are in memory at a time."""
MAX_CHUNK = 64
"""Scenarios of a chunk at most, so that little is lost with it."""


class Workers(Protocol):
    """Who computes.

    Attributes:
      serial: nothing is computed while something compiles.
      kind: of their devices.
    """

    serial: bool
    kind: Literal["cpu", "gpu"]

    def provenance(self) -> dict[str, object]:
        """Returns versions, commit and device."""
        ...

    def run(self, job: Job, chunks: Sequence[Chunk], stop: Callable[[], bool]) -> Iterator[Done]:
        """Computes chunks until all are done or the user wants to stop."""
        ...


class Local:
    """This process does the work."""

    serial = True

    def __init__(self, options: OverGrid):
        configure_jax(options)
        self.kind: Literal["cpu", "gpu"] = "cpu" if jax.default_backend() == "cpu" else "gpu"

    def provenance(self) -> dict[str, object]:
        """Returns versions, commit and device."""
        return provenance()

    def run(self, job: Job, chunks: Sequence[Chunk], stop: Callable[[], bool]) -> Iterator[Done]:
        """Computes chunks until all are done or the user wants to stop."""
        engine, loader = job.engine(), job.loader()
        loads = prefetch(lambda chunk: load_chunk(chunk, job, loader), chunks)
        for loaded in loads:
            yield engine.process(loaded)
            if stop():
                return


def workers_of(options: OverGrid) -> Workers:
    """Returns who does the work."""
    if options.cluster is None:
        return Local(options)
    from spdm_experiments.cluster import Cluster

    return Cluster(options)


def check_chunk(options: OverGrid) -> None:
    """Raises ValueError where --chunk is no number of scenarios."""
    if options.chunk != "auto" and options.chunk < 1:
        raise ValueError(f"--chunk is {options.chunk}; it must be at least 1, or auto")


def group_of(
    options: OverGrid,
    padding: PaddingConfig,
    entries: Sequence[Entry],
    kind: Literal["cpu", "gpu"],
    *,
    largest: int = MAX_CHUNK,
    num_iterations: int | None = None,
) -> Group:
    """Returns the shape of some scenarios, and how many are computed at a time.

    Args:
      options: --chunk.
      padding: one size per axis.
      entries: all scenarios of the shape.
      kind: of device.
      largest: scenarios at a time at most, if the user leaves it to us.
      num_iterations: of each scenario, if it matters.
    """
    size = options.chunk
    if size == "auto":
        each = padded_bytes({axis: sizes[0] for axis, sizes in vars(padding).items()})
        size = min(largest, max(usable_cores(), MEMORY[kind] // each))
    points = max(entry.route_points for entry in entries)
    room = bucket(points, PATH_ROOM)
    longest = max(entry.lane_points for entry in entries)
    return Group(padding, room, longest, min(size, len(entries)), num_iterations)


class GridRun(Verb):
    """A run with a row for every scenario at every point."""

    def __init__(
        self,
        options: OverGrid,
        inventory: Inventory,
        job: Job,
        members: Sequence[Sequence[Entry]],
        workers: Workers,
        about: Mapping[str, Any],
    ):
        """Puts a run together.

        Args:
          options: of the verb.
          inventory: all scenarios.
          job: what is computed of each.
          members: scenarios of each of the job's groups.
          workers: who computes.
          about: entries of run.json that say what is computed, besides points and scenarios.
        """
        self.options, self.job, self.workers = options, job, workers
        self.layout = job.layout()
        self.folder, self.rows = options.out, options.out / ROWS
        self.serial, self.origin = workers.serial, workers.provenance()
        self._inventory, self._members, self._about = inventory, members, about

    def open(self) -> list[str]:
        """See `Verb`."""
        sources = sorted({entry.source for entry in self._inventory.entries})
        about = {
            "format": FORMAT,
            "suite": suite_name(self.options.scenes, sources),
            "scenes": str(self.options.scenes),
            "num_scenarios": len(self._inventory),
            "input_hash": self._inventory.digest,
            "precision": self.options.precision,
            **self._about,
            "points": self.job.points,
            **self.origin,
            "created": now(),
        }
        return open_run(self.folder, about, self.job.arrays)

    def clean(self, shard: Shard) -> None:
        """See `Verb`."""
        clean(self.folder, shard)

    def read_done(self) -> tuple[dict[str, str], list[str]]:
        """See `Verb`."""
        return read_done(self.folder, len(self.job.points))

    def write_unusable(self, name: str, failures: Sequence[Failure]) -> None:
        """See `Verb`."""
        rows = failed_rows(self.layout, [(failure, None) for failure in failures])
        write_part(self.folder, name, self.layout.frame(rows), {}, None)

    def run(self, shard: Shard, missing: set[str], stop: Callable[[], bool]) -> Iterator[Done]:
        """See `Verb`."""
        return self.workers.run(self.job, list(self._chunks(shard, missing)), stop)

    def _chunks(self, shard: Shard, missing: set[str]) -> Iterator[Chunk]:
        for number, (group, members) in enumerate(zip(self.job.groups, self._members, strict=True)):
            entries = [entry for entry in members if entry.token in missing]
            for rows in split(len(entries), group.chunk):
                yield Chunk(shard.name, number, [entries[i] for i in rows])

    def read_rows(self) -> polars.DataFrame:
        """Returns all rows that are there."""
        parts = [polars.read_parquet(path) for path in sorted(self.rows.glob("part-*.parquet"))]
        return polars.concat([self.layout.frame([]), *parts])
