"""Run folders of the table of predictions as numbers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import polars

from spdm_experiments.report_data import Run, summarise
from spdm_experiments.simulate_options import Prediction
from spdm_experiments.simulate_terms import CLOSED
from spdm_experiments.table1_lineup import COLUMNS, Column, Planner, published, row_of


@dataclass(frozen=True)
class Cell:
    """One number of the table, scores from 0 to 100.

    Attributes:
      planner: of the row.
      kind: of prediction.
      column: of the table.
      scenarios: with a score; `failed`: without one.
      mean: NaN where there is none.
      low, high: 95 % bootstrap interval, NaN below two scenarios.
      published: what the paper has there, or None.
      metrics: mean of each closed-loop metric, empty in open loop.
      run_ms: mean run time of a drive.
    """

    planner: Planner
    kind: Prediction
    column: Column
    scenarios: int
    failed: int
    mean: float
    low: float
    high: float
    published: float | None
    metrics: dict[str, float]
    run_ms: float


def cells_of(runs: Sequence[Run], seed: int = 0) -> list[Cell]:
    """Returns the cells of all runs, in the order of their points.

    Args:
      runs: one per column.
      seed: of the bootstrap.
    """
    return [cell for run in runs for cell in _cells(run, seed)]


def _cells(run: Run, seed: int) -> Iterator[Cell]:
    summaries = summarise(run, seed)
    (column,) = (column for column in COLUMNS if column.folder == run.folder.name)
    for number, point in enumerate(run.points):
        planner, kind = row_of(point)
        summary = summaries[number]
        low, high = summary.intervals["total"]
        closed = column.mode == "closed"
        yield Cell(
            planner=planner,
            kind=kind,
            column=column,
            scenarios=summary.scenarios,
            failed=summary.failed,
            mean=100 * summary.means["total"],
            low=100 * low,
            high=100 * high,
            published=published(planner, kind, column),
            metrics={name: 100 * summary.means[name] for name in CLOSED} if closed else {},
            run_ms=summary.ms,
        )


def frame_of(cells: Sequence[Cell]) -> polars.DataFrame:
    """Returns the cells as rows, metrics included."""
    rows = [
        {
            "planner": cell.planner,
            "prediction": cell.kind,
            "suite": cell.column.suite,
            "traffic": cell.column.traffic,
            "mode": cell.column.mode,
            "scenarios": cell.scenarios,
            "failed": cell.failed,
            "score": cell.mean,
            "low": cell.low,
            "high": cell.high,
            "benchmark": cell.column.benchmark,
            "published": cell.published,
            **{name: cell.metrics.get(name) for name in CLOSED},
            "run_ms": cell.run_ms,
        }
        for cell in cells
    ]
    real = ("score", "low", "high", "published", *CLOSED, "run_ms")
    return polars.DataFrame(rows, schema_overrides=dict.fromkeys(real, polars.Float64))


@dataclass(frozen=True)
class Pair:
    """One metric of a planner beside two kinds of prediction, 0 to 100."""

    planner: Planner
    metric: str
    learned: float
    perfect: float


def pairs_of(cells: Sequence[Cell], column: Column) -> list[Pair]:
    """Returns every metric that a learned planner has beside learned and perfect predictions.

    Args:
      cells: of the table.
      column: closed loop of a suite.
    """
    mine = [cell for cell in cells if cell.column == column and cell.planner != "pdm-closed"]
    perfect = {cell.planner: cell.metrics for cell in mine if cell.kind == "perfect"}
    return [
        Pair(cell.planner, name, value, perfect[cell.planner][name])
        for cell in mine
        if cell.kind == "learned" and cell.planner in perfect
        for name, value in cell.metrics.items()
        if np.isfinite([value, perfect[cell.planner][name]]).all()
    ]
