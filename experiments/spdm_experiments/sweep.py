"""`spdm sweep`: every scenario at every point of a grid, into a folder that can be gone on with."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import polars
from rich.table import Table

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import Inventory, Shard, split, take_inventory
from spdm_experiments.options import Sweep
from spdm_experiments.parts import part_name
from spdm_experiments.run_folder import (
    FORMAT,
    ROWS,
    Progress,
    alone,
    clean,
    note,
    open_run,
    read_done,
    write_part,
)
from spdm_experiments.runtime import configure_jax, now, provenance, stop_between_chunks
from spdm_experiments.sweep_grid import Point, make_points, runs_of
from spdm_experiments.sweep_rows import Layout, failed_rows
from spdm_experiments.sweep_work import (
    Chunk,
    Done,
    Engine,
    Group,
    Job,
    load_chunk,
    loader_of,
    outcome,
)
from spdm_experiments.tables import console
from spdm_experiments.terminal import RateLine, print_files, reasons
from spdm_jax.batching import (
    BatchConfig,
    ShapeGroup,
    group_by_shape,
    padded_bytes,
    prefetch,
    usable_cores,
)
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PATH_ROOM, bucket

MEMORY = {"cpu": 64 * 2**20, "gpu": 512 * 2**20}
"""Bytes that the scenarios of one chunk may take; three chunks are in memory at a time."""
MAX_CHUNK = 64
"""Scenarios of a chunk at most, so that little is lost with it."""


@dataclass
class Tally:
    """What this process has done so far.

    Attributes:
      status: token -> whether all rows are "ok", of every scenario of the shard that has rows.
      scenarios: done here.
      programs: made here.
      seconds: spent here, by what on.
      messages: what the user was told.
    """

    status: dict[str, bool]
    scenarios: int = 0
    programs: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)

    def take(self, done: Done) -> None:
        """Adds a chunk."""
        self.status |= done.status
        self.scenarios += len(done.status)
        self.programs += done.programs
        for name, value in done.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + value
        self.messages += done.messages
        note(done.messages)

    def counts(self, total: int) -> dict[str, Any]:
        """Returns how far the shard is."""
        return {
            "scenarios": total,
            "done": len(self.status),
            "failed": sum(not ok for ok in self.status.values()),
            "finished": len(self.status) == total,
        }

    def work(self) -> dict[str, Any]:
        """Returns what was done here."""
        seconds = {f"{name}_s": round(value, 3) for name, value in self.seconds.items()}
        counts = {"scenarios": self.scenarios, "programs": self.programs}
        return {**counts, **seconds, "messages": self.messages}


def run_sweep(options: Sweep) -> bool:
    """Computes what a sweep still lacks; returns False if a scenario of the shard failed.

    Raises:
      ValueError: options, grid or files are of no use, or the folder holds another run.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    shard = Shard.parse(options.shard)
    if options.chunk != "auto" and options.chunk < 1:
        raise ValueError(f"--chunk is {options.chunk}; it must be at least 1, or auto")
    points = make_points(options)
    entries = [point.entry(number) for number, point in enumerate(points)]
    inventory = take_inventory(scenario_files(options.scenes, options.limit))
    if not inventory.entries:
        raise ScenarioError(f"{options.scenes}: no usable scenario: {inventory.failures[0].reason}")
    workers = _workers(options)
    origin = workers.provenance()
    note(open_run(options.out, _about(options, entries, inventory, origin)))
    with alone(options.out, shard):
        clean(options.out, shard)
        status, notes = read_done(options.out, len(points))
        note(notes)
        tokens = [e.token for e in inventory.entries] + [f.token for f in inventory.failures]
        mine = {token for token in tokens if shard.holds(token)}
        tally = Tally({token: ok for token, ok in status.items() if token in mine})
        progress = Progress(options.out, shard, origin)
        missing = mine - tally.status.keys()
        if missing:
            groups = group_by_shape([entry.sizes for entry in inventory.entries])
            job = Job(
                folder=options.out,
                points=entries,
                runs=runs_of(points),
                groups=[_group(options, inventory, group, workers.kind) for group in groups],
                precision=options.precision,
                trajectories=options.trajectories,
                batching=BatchConfig(),
            )
            _note_failures(job, inventory, shard, missing, tally)
            chunks = list(_chunks(job, inventory, groups, shard, missing))
            _work(workers, job, chunks, tally, progress, len(mine))
            clean(options.out, shard)  # what lost workers of a cluster left
        if options.stage_times and shard.index == 1 and tally.counts(len(mine))["finished"]:
            _time_stages(options, points, inventory)
        return _close(options, shard, entries, tally, len(mine), bool(missing))


class Local:
    """This process does the work."""

    serial = True
    """Nothing is computed while something compiles."""

    def __init__(self, options: Sweep):
        configure_jax(options)
        self.kind = "cpu" if jax.default_backend() == "cpu" else "gpu"

    def provenance(self) -> dict[str, object]:
        """Returns versions, commit and device."""
        return provenance()

    def run(self, job: Job, chunks: Sequence[Chunk], stop: Callable[[], bool]) -> Iterator[Done]:
        """Computes chunks until all are done or the user wants to stop."""
        engine, loader = Engine(job), loader_of(job)
        loads = prefetch(lambda chunk: load_chunk(chunk, job, loader), chunks)
        for loaded in loads:
            yield engine.process(loaded)
            if stop():
                return


def _workers(options: Sweep) -> Any:
    if options.cluster is None:
        return Local(options)
    from spdm_experiments.sweep_ray import Cluster

    return Cluster(options)


def _about(
    options: Sweep, points: list[dict[str, Any]], inventory: Inventory, origin: dict[str, object]
) -> dict[str, Any]:
    readers = sorted({entry.source for entry in inventory.entries})
    return {
        "format": FORMAT,
        "command": "sweep",
        "suite": suite_name(options.scenes, readers),
        "scenes": str(options.scenes),
        "num_scenarios": len(inventory),
        "input_hash": inventory.digest,
        "seed": options.seed,
        "precision": options.precision,
        "config": {"trajectories": options.trajectories},
        "points": points,
        **origin,
        "created": now(),
    }


def _group(options: Sweep, inventory: Inventory, group: ShapeGroup, kind: str) -> Group:
    size = options.chunk
    if size == "auto":
        each = padded_bytes({axis: sizes[0] for axis, sizes in vars(group.padding).items()})
        size = min(MAX_CHUNK, max(usable_cores(), MEMORY[kind] // each))
    points = max(inventory.entries[row].route_points for row in group.rows)
    return Group(group.padding, bucket(points, PATH_ROOM), min(size, len(group.rows)))


def _chunks(
    job: Job,
    inventory: Inventory,
    groups: Sequence[ShapeGroup],
    shard: Shard,
    missing: set[str],
) -> Iterator[Chunk]:
    for number, group in enumerate(groups):
        entries = [inventory.entries[row] for row in group.rows]
        entries = [entry for entry in entries if entry.token in missing]
        for rows in split(len(entries), job.groups[number].chunk):
            yield Chunk(shard.name, number, [entries[i] for i in rows])


def _note_failures(
    job: Job, inventory: Inventory, shard: Shard, missing: set[str], tally: Tally
) -> None:
    """Writes the rows of files that cannot be used."""
    failures = [failure for failure in inventory.failures if failure.token in missing]
    if failures:
        layout = Layout.of(job.points)
        rows = failed_rows(layout, [(failure, None) for failure in failures])
        name = part_name(shard.name, "unusable", [failure.token for failure in failures])
        write_part(job.folder, name, layout.frame(rows), None)
        tally.take(outcome(name, rows))


def _work(
    workers: Any,
    job: Job,
    chunks: Sequence[Chunk],
    tally: Tally,
    progress: Progress,
    total: int,
) -> None:
    line = RateLine(total, len(tally.status))
    with stop_between_chunks() as stopping:
        line.show(len(tally.status), 0.0, 0, 0.0)
        progress.save(tally.counts(total), tally.work())
        for done in workers.run(job, chunks, stopping):
            tally.take(done)
            progress.save(tally.counts(total), tally.work())
            compile_s = tally.seconds.get("compile", 0.0)
            waited = compile_s if workers.serial else 0.0
            line.show(len(tally.status), compile_s, tally.programs, waited)
    line.close()


def _time_stages(options: Sweep, points: Sequence[Point], inventory: Inventory) -> None:
    """Writes the stage times where they are not there yet."""
    from spdm_experiments.sweep_stages import FILE, pick, write_stage_times

    if not (options.out / FILE).exists():
        configure_jax(options)
        chosen = pick(inventory.entries, options.seed)
        tell = lambda text: note([text])
        write_stage_times(options.out, points, chosen, options.precision, tell)


def _close(
    options: Sweep,
    shard: Shard,
    points: list[dict[str, Any]],
    tally: Tally,
    total: int,
    worked: bool,
) -> bool:
    """Prints the outcome.

    Raises:
      KeyboardInterrupt: scenarios are missing because the user stopped the run.
    """
    counts = tally.counts(total)
    names = [p.name for p in sorted((options.out / ROWS).glob("part-*.parquet"))]
    layout = Layout.of(points)
    parts = [polars.read_parquet(options.out / ROWS / name) for name in names]
    rows = polars.concat([layout.frame([]), *parts])
    console().print(_table(options, layout, rows))
    whose = "" if shard.count == 1 else f" of shard {options.shard}"
    if counts["finished"] and not worked:
        print(f"all {total} scenarios{whose} were done already, {counts['failed']} failed")
    else:
        print(f"{counts['done']} of {total} scenarios{whose} done, {counts['failed']} failed")
        print(", ".join(f"{name} {value:.1f} s" for name, value in tally.seconds.items()))
    bad = rows.filter(
        (polars.col("status") != "ok") & polars.col("token").is_in(list(tally.status))
    )
    failed = dict(zip(bad["token"], bad["reason"], strict=True))
    for reason in reasons(failed, options.out / ROWS):
        print(reason)
    print_files([options.out])
    if not counts["finished"]:
        raise KeyboardInterrupt
    return not counts["failed"]


def _table(options: Sweep, layout: Layout, rows: polars.DataFrame) -> Table:
    """One line per point: means over the scenarios that are "ok"."""
    columns = {
        "score": "total",
        "NC": "no_at_fault_collision",
        "DAC": "drivable_area",
        "DDC": "driving_direction",
        "TTC": "time_to_collision",
        "C": "comfort",
        "EP": "progress",
        "m": "progress_raw",
    }
    good = polars.col("status") == "ok"
    means = (
        rows.group_by("point")
        .agg(good.sum().alias("ok"), *(polars.col(c).mean() for c in columns.values()))
        .sort("point")
    )
    table = Table(title=str(options.out), title_justify="left")
    for name in ("point", "planner", "N_p", *layout.names, "scenes", *columns):
        table.add_column(name, justify="left" if name == "planner" else "right")
    for row in means.iter_rows(named=True):
        about = layout.point(row["point"])
        numbers = [row[name] for name in columns.values()]
        table.add_row(
            *(f"{v:g}" if isinstance(v, float) else str(v) for v in about.values()),
            str(row["ok"]),
            *("" if v is None else f"{v:.3f}" for v in numbers),
        )
    return table
