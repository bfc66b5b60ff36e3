"""The same drives in float32 and in float64: how many scores agree, and what parts the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import polars

from spdm_experiments.closed_loop_lineup import name_of
from spdm_experiments.closed_loop_trace import Trace, trace_scene
from spdm_experiments.inventory import Entry
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import Run, pair_up
from spdm_experiments.simulate_points import Point
from spdm_experiments.simulate_together import together
from spdm_experiments.simulate_work import switches_of
from spdm_jax.batching import Precision, SceneRunner

WITHIN: Final = 0.01
"""Scores of one scenario that differ by no more count as the same."""


@dataclass(frozen=True)
class Pair:
    """One suite in both precisions.

    Attributes:
      single: run in float32; it may have more rows.
      double: run in float64.
      points: of the run in float64.
      entries: scenarios of both.
    """

    single: Run
    double: Run
    points: Sequence[Point]
    entries: Sequence[Entry]


def compare(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Compares runs scenario by scenario; drives once more what does not agree.

    Returns:
      What the page shows, as JSON holds it: `within`; `commit`; and `rows`, each of one planner in
      one suite and kind of traffic. A row lists as `others` the scenarios whose scores differ.

    Raises:
      ValueError: a run in float32 lacks a row, or is of other scenarios than that in float64.
    """
    rows = [row for pair in pairs for row in _rows(pair)]
    runs = [run for pair in pairs for run in (pair.single, pair.double)]
    commits = dict.fromkeys(str(run.about.get("commit") or "unknown") for run in runs)
    return {"within": WITHIN, "commit": ", ".join(commits), "rows": rows}


def _rows(pair: Pair) -> list[dict[str, Any]]:
    single, double = pair.single, pair.double
    for key in ("suite", "input_hash"):
        if single.about[key] != double.about[key]:
            raise ValueError(
                f"{double.folder}: {key} is {double.about[key]!r}, {single.folder} has "
                f"{single.about[key]!r}; give both the same --limit, and another --out if the "
                "suite has changed meanwhile"
            )
    places = {(name_of(p), p["traffic"]): number for number, p in enumerate(single.points)}
    rows = []
    for number, point in enumerate(pair.points):
        name, traffic = name_of(point.entry(number)), point.traffic
        if (name, traffic) not in places:
            raise ValueError(f"{single.folder}: no row of {name} in {traffic} traffic")
        both = pair_up(single, double, (places[name, traffic], number))
        apart = both.filter(polars.col("difference").abs() > WITHIN)
        change = both["difference"].to_numpy()
        rows.append(
            {
                "suite": str(double.about["suite"]),
                "traffic": traffic,
                "name": name,
                "scenarios": len(both),
                "mean_difference": float(change.mean()) if len(change) else None,
                "others": _others(pair.entries, apart, point),
            }
        )
    return rows


def _others(
    entries: Sequence[Entry], apart: polars.DataFrame, point: Point
) -> list[dict[str, Any]]:
    """Says of each scenario where its two drives part."""
    tokens = apart["token"].to_list()
    if not tokens:
        return []
    mine = [entry for entry in entries if entry.token in tokens]
    singles, doubles = (trace_drives(mine, point, precision) for precision in ("f32", "f64"))
    found = []
    for token, f32, f64 in apart.select("token", "total", "other").iter_rows():
        single, double = singles[token], doubles[token]
        again = max(abs(float(single.score) - f32), abs(float(double.score) - f64))
        found.append(
            {
                "token": token,
                "f32": f32,
                "f64": f64,
                "repeats": again <= WITHIN,
                "first": first_other_choice(single, double),
            }
        )
    return found


def trace_drives(entries: Sequence[Entry], point: Point, precision: Precision) -> dict[str, Trace]:
    """Drives scenarios with every choice recorded; returns NumPy traces by token.

    Raises:
      ValueError: a scenario cannot be read.
    """
    job = together(Simulate(scenes=entries[0].path, precision=precision), entries, [point])
    group = job.groups[0]
    scenes = job.loader().load(entries, group.padding)
    if scenes.failures or scenes.batch is None:
        raise ValueError(scenes.failures[0][0].reason)
    static = switches_of(point, group, job)
    static = replace(static, simulation=replace(static.simulation, record_plans=True))
    runner = SceneRunner(trace_scene, static, precision=precision)
    found: Trace = runner(scenes.batch, None, point.params)
    row = lambda i: Trace(**{name: values[i] for name, values in vars(found).items()})
    return {entry.token: row(i) for i, entry in enumerate(scenes.entries)}


def first_other_choice(single: Trace, double: Trace) -> dict[str, Any] | None:
    """Returns the first step at which two drives choose differently; None if there is none.

    Args:
      single: in float32, `[T, ...]`.
      double: in float64.

    Returns:
      `time` in s; `f32` and `f64`, the proposals chosen; `brake`, the precision that alone chooses
      the emergency brake ("" if neither); `margin`, the float64 score of the proposal that float64
      chose minus that of the one that float32 chose; `apart`, the distance of the two egos, m.
    """
    real = single.valid & double.valid
    braking = single.brake != double.brake
    # Which proposal was the best does not matter to a planner that brakes.
    other = braking | ((single.best != double.best) & ~(single.brake & double.brake))
    steps = np.flatnonzero(real & other)
    if not len(steps):
        return None
    at = int(steps[0])
    brake = ("float32" if single.brake[at] else "float64") if braking[at] else ""
    mine, theirs = int(double.best[at]), int(single.best[at])
    return {
        "time": float(double.time[at]),
        "f32": theirs,
        "f64": mine,
        "brake": brake,
        "margin": float(double.scores[at, mine] - double.scores[at, theirs]),
        "apart": float(np.hypot(single.x[at] - double.x[at], single.y[at] - double.y[at])),
    }
