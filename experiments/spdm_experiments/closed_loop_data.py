"""Run folders of the closed-loop page as numbers: a panel per suite and kind of traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import polars

from spdm_experiments.closed_loop_lineup import QUOTED_AS, name_of
from spdm_experiments.report_data import (
    PointSummary,
    Run,
    bootstrap,
    pair_up,
    summarise,
)

TRAFFIC: Final = {"replay": "non-reactive", "reactive": "reactive"}
"""What people call traffic."""


@dataclass(frozen=True)
class Panel:
    """One suite under one kind of traffic.

    Attributes:
      run: of the suite; other kinds of traffic are in it as well.
      traffic: "replay" or "reactive".
      points: row name -> number of the point, in the order of the tables.
      summaries: row name -> means and intervals.
      step_ms: row name -> mean run time of a drive over its steps; NaN where nothing is known.
      timed: scenarios whose run times are meant.
    """

    run: Run
    traffic: str
    points: Mapping[str, int]
    summaries: Mapping[str, PointSummary]
    step_ms: Mapping[str, float]
    timed: int

    @property
    def suite(self) -> str:
        """Name of the suite."""
        return str(self.run.about["suite"])

    @property
    def title(self) -> str:
        """Suite and traffic, for people."""
        return f"{self.suite}, {TRAFFIC[self.traffic]}"

    @property
    def benchmark(self) -> str | None:
        """Published benchmark to be shown beside it."""
        return QUOTED_AS.get((self.suite, self.traffic))

    def point(self, name: str) -> Mapping[str, Any]:
        """Returns a row's entry of run.json."""
        return self.run.points[self.points[name]]


@dataclass(frozen=True)
class Difference:
    """Score of one row minus that of another over the scenarios of one type, 0 to 100.

    Attributes:
      kind: type of the scenarios.
      scenarios: that both have scores of.
      mean: mean difference; `low`, `high`: its 95 % bootstrap interval, NaN below two scenarios.
    """

    kind: str
    scenarios: int
    mean: float
    low: float
    high: float


def panels_of(
    runs: Sequence[Run], seed: int = 0, timed: Sequence[Run] | None = None
) -> list[Panel]:
    """Splits runs by traffic, in the order of their points.

    Args:
      runs: one per suite.
      seed: of the bootstrap.
      timed: runs of the same suites and points whose run times are shown; `runs` by default.

    Raises:
      ValueError: a suite was timed with other points, or not at all.
    """
    clocks = {str(run.about["suite"]): run for run in (runs if timed is None else timed)}
    found = []
    for run in runs:
        clock = clocks.get(str(run.about["suite"]))
        if clock is None or clock.points != run.points:
            raise ValueError(
                f"{run.about['suite']}: the timed run is missing or of other planners; make it "
                "with the same version of the program"
            )
        summaries = summarise(run, seed)
        for traffic in dict.fromkeys(point["traffic"] for point in run.points):
            points = {
                name_of(point): number
                for number, point in enumerate(run.points)
                if point["traffic"] == traffic
            }
            found.append(
                Panel(
                    run=run,
                    traffic=traffic,
                    points=points,
                    summaries={name: summaries[number] for name, number in points.items()},
                    timed=clock.about["num_scenarios"] - clock.missing,
                    step_ms={name: _step_ms(clock, number) for name, number in points.items()},
                )
            )
    return found


def rows_of(panels: Sequence[Panel]) -> list[str]:
    """Returns the names of all rows, in the order of the tables."""
    return list(dict.fromkeys(name for panel in panels for name in panel.points))


def _step_ms(run: Run, point: int) -> float:
    times = run.usable(point).select(ms=polars.col("run_ms") / polars.col("samples"))["ms"]
    return float(np.mean(times.to_numpy())) if len(times) else float("nan")


def scores_by_type(panel: Panel) -> dict[str, dict[str, float]]:
    """Returns type -> row name -> mean score from 0 to 100, types in alphabetical order.

    A row is left out where it has no score of the type.
    """
    names = {number: name for name, number in panel.points.items()}
    good = panel.run.rows.filter(
        (polars.col("status") == "ok") & polars.col("point").is_in(list(names))
    )
    means = good.group_by("scenario_type", "point").agg(polars.col("total").mean())
    found: dict[str, dict[str, float]] = {}
    for kind, point, mean in means.sort("scenario_type", "point").iter_rows():
        found.setdefault(str(kind), {})[names[point]] = 100 * float(mean)
    return found


def scenarios_by_type(panel: Panel) -> dict[str, int]:
    """Returns how many scenarios of each type have a score of some row."""
    numbers = list(panel.points.values())
    good = panel.run.rows.filter(
        (polars.col("status") == "ok") & polars.col("point").is_in(numbers)
    )
    counts = good.group_by("scenario_type").agg(polars.col("token").n_unique())
    return {str(kind): int(count) for kind, count in counts.iter_rows()}


def differences(panel: Panel, first: str, second: str, seed: int = 0) -> list[Difference]:
    """Compares two rows scenario by scenario, for each type; empty if the panel lacks one.

    Args:
      panel: suite and traffic.
      first: name of a row.
      second: name of the row that is subtracted.
      seed: of the bootstrap.
    """
    if first not in panel.points or second not in panel.points:
        return []
    pairs = pair_up(panel.run, panel.run, (panel.points[first], panel.points[second]))
    found = []
    for (kind,), mine in pairs.sort("scenario_type", "token").group_by(
        "scenario_type", maintain_order=True
    ):
        change = 100 * mine["difference"].to_numpy()
        low, high = bootstrap(change[:, None], seed)[:, 0].tolist()
        found.append(Difference(str(kind), len(change), float(change.mean()), low, high))
    return found


def curve(panel: Panel, planner: str) -> list[tuple[int, str]]:
    """Returns N_p and row name of a planner under its own settings, by N_p."""
    found = []
    for name in panel.points:
        point = panel.point(name)
        count = point["num_proposals"]
        if count is not None and name == f"{planner} {count}":
            found.append((int(count), name))
    return sorted(found)
