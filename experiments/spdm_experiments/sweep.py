"""`spdm sweep`: every scenario at every point of a grid, into a folder that can be gone on with."""

from collections.abc import Sequence

import polars
from rich.table import Table

from spdm_experiments.chunks import scenario_files
from spdm_experiments.grid_run import GridRun, check_chunk, group_of, workers_of
from spdm_experiments.inventory import Inventory, Shard
from spdm_experiments.options import Sweep
from spdm_experiments.run_folder import note
from spdm_experiments.runtime import configure_jax
from spdm_experiments.sequence import go_on, usable_inventory
from spdm_experiments.sweep_grid import Point, make_points, runs_of
from spdm_experiments.sweep_work import SweepJob
from spdm_experiments.tables import console
from spdm_jax.batching import BatchConfig, group_by_shape


def run_sweep(options: Sweep) -> bool:
    """Computes what a sweep still lacks; returns False if a scenario of the shard failed.

    Raises:
      ValueError: options, grid or files are of no use, or the folder holds another run.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    shard = Shard.parse(options.shard)
    check_chunk(options)
    points = make_points(options)
    files = scenario_files(options.scenes, options.limit)
    inventory = usable_inventory(files, options.scenes)
    return go_on(SweepRun(options, inventory, points), inventory, shard)


class SweepRun(GridRun):
    """One sweep."""

    def __init__(self, options: Sweep, inventory: Inventory, points: Sequence[Point]):
        """Puts it together; see `GridRun`."""
        workers = workers_of(options)
        shapes = group_by_shape([entry.sizes for entry in inventory.entries])
        members = [[inventory.entries[row] for row in shape.rows] for shape in shapes]
        job = SweepJob(
            folder=options.out,
            points=[point.entry(number) for number, point in enumerate(points)],
            groups=[
                group_of(options, shape.padding, entries, workers.kind)
                for shape, entries in zip(shapes, members, strict=True)
            ],
            precision=options.precision,
            batching=BatchConfig(),
            arrays="trajectories" if options.trajectories else None,
            runs=runs_of(points),
        )
        about = {
            "command": "sweep",
            "seed": options.seed,
            "config": {"trajectories": options.trajectories},
        }
        super().__init__(options, inventory, job, members, workers, about)
        self._sweep, self._points, self._entries = options, points, inventory.entries

    def finish(self) -> None:
        """Writes the stage times where they are asked for and not there yet."""
        from spdm_experiments.sweep_stages import FILE, pick, write_stage_times

        options = self._sweep
        if options.stage_times and not (options.out / FILE).exists():
            configure_jax(options)
            chosen = pick(self._entries, options.seed)
            tell = lambda text: note([text])
            write_stage_times(options.out, self._points, chosen, options.precision, tell)

    def tell(self) -> None:
        """Prints a line per point."""
        console().print(self._table())

    def _table(self) -> Table:
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
            self.read_rows()
            .group_by("point")
            .agg(good.sum().alias("ok"), *(polars.col(c).mean() for c in columns.values()))
            .sort("point")
        )
        table = Table(title=str(self.folder), title_justify="left")
        for name in ("point", "planner", "N_p", *self.layout.names, "scenes", *columns):
            table.add_column(name, justify="left" if name == "planner" else "right")
        for row in means.iter_rows(named=True):
            about = self.layout.point(row["point"])
            numbers = [row[name] for name in columns.values()]
            table.add_row(
                *(f"{v:g}" if isinstance(v, float) else str(v) for v in about.values()),
                str(row["ok"]),
                *("" if v is None else f"{v:.3f}" for v in numbers),
            )
        return table
