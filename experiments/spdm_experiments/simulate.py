"""`spdm simulate`: whole drives of planners in simulation, scored with nuPlan's metrics."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import polars
from rich.box import SIMPLE_HEAD
from rich.table import Table

from spdm_experiments.grid_run import MAX_CHUNK, GridRun, Workers, check_chunk, group_of, workers_of
from spdm_experiments.inventory import Entry, Shard
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import bootstrap, known_means
from spdm_experiments.report_grid import distinguishing, label
from spdm_experiments.runtime import configure_jax
from spdm_experiments.sequence import go_on
from spdm_experiments.simulate_points import (
    Point,
    entries_of,
    learned_planners,
    make_points,
)
from spdm_experiments.simulate_rows import METRICS
from spdm_experiments.simulate_scenes import Scenes, find_scenes
from spdm_experiments.simulate_scripts import Extras, ScriptRoom, check_points, room_of
from spdm_experiments.simulate_terms import INTERPLAN, SHORT, TITLES
from spdm_experiments.simulate_work import SimulateJob
from spdm_experiments.tables import console
from spdm_experiments.work import Group
from spdm_jax.batching import BatchConfig, group_by_shape

CPU_CHUNK = 8
"""Scenarios of a chunk on a CPU: a drive takes seconds, and a chunk is what a kill can cost."""

WASTE = 4.0
"""How much larger than need be a scenario may become to share a program, which takes half a minute
to compile for each point."""


def run_simulate(options: Simulate) -> bool:
    """Computes what a run still lacks; returns False if a scenario of the shard failed.

    Raises:
      ValueError: options or files are of no use, or the folder holds another run.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    shard = Shard.parse(options.shard)
    check_chunk(options)
    if options.replan_every < 1:
        raise ValueError(f"--replan-every is {options.replan_every}; it must be at least 1")
    if learned_planners(options):
        configure_jax(options)  # weights are read to the device
    points = make_points(options)
    scenes = find_scenes(options)
    check_points(scenes.extras, points)
    return go_on(SimulateRun(options, scenes, points), scenes.inventory, shard)


class SimulateRun(GridRun):
    """One simulation."""

    def __init__(self, options: Simulate, scenes: Scenes, points: Sequence[Point]):
        """Puts it together; see `GridRun`."""
        workers = workers_of(options)
        shapes = list(_shapes(options, scenes.inventory.entries, scenes.extras, workers))
        job = SimulateJob(
            folder=options.out,
            points=entries_of(points),
            groups=[group for group, _, _ in shapes],
            precision=options.precision,
            batching=BatchConfig(),
            arrays=None if options.record == "none" else "histories",
            runs=list(points),
            replan_every=options.replan_every,
            plans=options.record == "plans",
            extras=scenes.extras,
            rooms=[room for _, room, _ in shapes],
        )
        about = {
            "command": "simulate",
            "suite": scenes.suite,
            "scenes": str(scenes.folder),
            "seed": options.seed,
            "num_interplan": len(scenes.extras),
            "config": {
                "replan_every": options.replan_every,
                "record": options.record,
                "types": list(options.types),
            },
        }
        members = [entries for _, _, entries in shapes]
        super().__init__(options, scenes.inventory, job, members, workers, about)
        self._seed, self._by_type = options.seed, options.by_type
        self._changed = list(scenes.extras)

    def tell(self) -> None:
        """Prints a line per point, and one per type of scenario if asked to."""
        rows = self.read_rows()
        for mode in METRICS:
            numbers = [n for n, point in enumerate(self.job.points) if point["mode"] == mode]
            if numbers:
                title = f"{self.folder}, {mode} loop"
                console().print(self._table(rows, numbers, title, "score", METRICS[mode]))
        changed = rows.filter(polars.col("token").is_in(self._changed))
        if self._changed:
            title, (score, *metrics) = f"{self.folder}, scored by interPlan", INTERPLAN
            console().print(
                self._table(changed, range(len(self.job.points)), title, score, metrics)
            )
        if self._by_type:
            console().print(self._type_table(rows, "score"))
            if self._changed:
                console().print(self._type_table(changed, "interplan_score"))

    def _table(
        self,
        rows: polars.DataFrame,
        numbers: Sequence[int],
        title: str,
        score: str,
        metrics: Sequence[str],
    ) -> Table:
        """Means over the scenarios that are "ok"; what a row lacks does not count."""
        table = Table(
            title=title,
            caption=", ".join(f"{SHORT[name]} {TITLES[name].lower()}" for name in metrics),
            title_justify="left",
            caption_justify="left",
            box=SIMPLE_HEAD,
            collapse_padding=True,
            pad_edge=False,
        )
        names = [n for n in (*self.layout.fixed, *self.layout.names) if n not in ("point", "mode")]
        heads = ("N_p" if name == "num_proposals" else name for name in names)
        for name in (*heads, "scenes", "failed", "score", "95 %", *(SHORT[n] for n in metrics)):
            table.add_column(name, justify="left" if name == "planner" else "right", no_wrap=True)
        for number in numbers:
            mine = rows.filter(polars.col("point") == number)
            good = mine.filter(polars.col("status") == "ok")
            values = good.select(polars.col(score, *metrics).cast(polars.Float64)).to_numpy()
            low, high = bootstrap(values[:, :1], self._seed)[:, 0]
            means = known_means(values)
            about = self.layout.point(number)
            table.add_row(
                *(_plain(about[name]) for name in names),
                str(len(good)),
                str(len(mine) - len(good)),
                _text(means[0], 4),
                f"{_text(low, 3)} - {_text(high, 3)}" if len(values) > 1 else "",
                *(_text(mean, 3) for mean in means[1:]),
            )
        return table

    def _type_table(self, rows: polars.DataFrame, score: str) -> Table:
        """Means of a score over each scenario type, a column per point."""
        title = f"Mean {score} by scenario type"
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
        table.add_column("type", no_wrap=True)
        table.add_column("scenes", justify="right")
        shown = [name for name in distinguishing(self.job.points) if name != "point"]
        for point in self.job.points:
            table.add_column(label(point, shown), justify="right")
        good = rows.filter(polars.col("status") == "ok")
        for (kind,), mine in good.sort("scenario_type").group_by(
            "scenario_type", maintain_order=True
        ):
            means = dict(mine.group_by("point").agg(polars.col(score).mean()).iter_rows())
            cells = [means.get(number) for number in range(len(self.job.points))]
            texts = ("" if mean is None else _text(mean, 4) for mean in cells)
            table.add_row(str(kind), str(mine["token"].n_unique()), *texts)
        return table


def _text(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def _plain(value: Any) -> str:
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _shapes(
    options: Simulate, entries: Sequence[Entry], extras: Extras, workers: Workers
) -> Iterator[tuple[Group, ScriptRoom | None, list[Entry]]]:
    """Yields the scenarios of one shape and length, scripted or not, which share a program."""
    kind_of = lambda entry: (entry.num_iterations, entry.token in extras)
    for shape in group_by_shape([entry.sizes for entry in entries], waste=WASTE):
        mine = [entries[row] for row in shape.rows]
        for count, scripted in sorted({kind_of(entry) for entry in mine}):
            members = [entry for entry in mine if kind_of(entry) == (count, scripted)]
            largest = CPU_CHUNK if workers.kind == "cpu" else MAX_CHUNK
            group = group_of(
                options,
                shape.padding,
                members,
                workers.kind,
                largest=largest,
                num_iterations=count,
            )
            room = room_of([extras[entry.token] for entry in members]) if scripted else None
            yield group, room, members
