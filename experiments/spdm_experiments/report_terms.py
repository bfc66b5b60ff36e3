"""What a report shows of a run, by the verb that wrote it: scores, their names, and words."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from spdm_experiments.simulate_terms import CLOSED, INTERPLAN, OPEN

TERMS: Final = {
    "total": "Total score",
    "no_at_fault_collision": "No at-fault collision",
    "drivable_area": "Drivable area",
    "driving_direction": "Driving direction",
    "progress": "Progress",
    "time_to_collision": "Time to collision",
    "comfort": "Comfort",
}
SHORT: Final = dict(zip(TERMS, ("Score", "NC", "DAC", "DDC", "EP", "TTC", "C"), strict=True))
METRES: Final = "progress_raw"
"""Progress in metres of a sweep's rows, the one mean that is no score."""


@dataclass(frozen=True)
class Terms:
    """Scores of a kind of run.

    Attributes:
      command: verb that wrote it.
      title: of the report.
      titles: column of the rows -> name; the first is the score itself, "total".
      short: column -> head of a column.
      metres: column of the progress in metres.
      summary: words below the table of means.
      score: words below the curves of scores.
      braking: whether rows know of emergency brakes.
    """

    command: str
    title: str
    titles: Mapping[str, str]
    short: Mapping[str, str]
    metres: str
    summary: str
    score: str
    braking: bool

    def columns(self) -> list[str]:
        """Columns that are averaged."""
        return [*self.titles, self.metres]

    def first_lost(self, row: Mapping[str, Any]) -> tuple[str, str]:
        """Returns the first term that a row lost, and the reason; empty if none."""
        return _lost_in_sweep(row) if self.command == "sweep" else _lost_in_drive(row)


_BANDS = "bands and bars are 95 % bootstrap intervals over scenarios. The axis does not start at"
_SWEEP = Terms(
    command="sweep",
    title="Sweep report",
    titles=TERMS,
    short=SHORT,
    metres=METRES,
    summary="m the chosen proposal's progress in 4 s, brake the share of scenarios with an "
    "emergency brake, ms the run time per scenario without compilation.",
    score=f"Mean over scenarios of the chosen proposal; {_BANDS} zero.",
    braking=True,
)


def terms_of(about: Mapping[str, Any]) -> Terms:
    """Returns the terms of a run.

    Args:
      about: run.json.

    Raises:
      ValueError: reports are not made of what this verb writes.
    """
    if about.get("command") == "sweep":
        return _SWEEP
    if about.get("command") != "simulate":
        raise ValueError(about.get("command"))
    modes = {point["mode"] for point in about["points"]}
    shown = {**(CLOSED if "closed" in modes else {}), **(OPEN if "open" in modes else {})}
    if about.get("num_interplan"):
        shown |= INTERPLAN
    return Terms(
        command="simulate",
        title="Simulation report",
        titles={"total": "Score", **{name: title for name, (title, _) in shown.items()}},
        short={"total": "Score", **{name: short for name, (_, short) in shown.items()}},
        metres="progress_m",
        summary="m the way along the expert's route, ms the run time of a whole drive without "
        "compilation.",
        score=f"Mean over drives; {_BANDS} zero.",
        braking=False,
    )


def needed(terms: Terms) -> Iterable[str]:
    """Returns the columns that rows must have."""
    common = ("token", "point", "planner", "num_proposals", "status", "reason")
    return (*common, *terms.columns())


def _lost_in_sweep(row: Mapping[str, Any]) -> tuple[str, str]:
    # The order is that of the rules: what sets the total to zero comes first.
    if row["no_at_fault_collision"] < 1:
        return "no_at_fault_collision", "at-fault collision" + _blame(row, "collision")
    if row["drivable_area"] < 1:
        return "drivable_area", "a corner leaves the drivable area"
    if row["driving_direction"] < 1:
        return "driving_direction", "drives off the route's lanes or against traffic"
    if row["time_to_collision"] < 1:
        return "time_to_collision", "less than 1 s to a collision" + _blame(row, "ttc")
    if row["comfort"] < 1:
        return "comfort", "uncomfortable: acceleration, jerk or yaw beyond the bounds"
    if row["progress"] < 1 - 1e-6:
        share = 100 * row["progress"]
        return "progress", f"{row[METRES]:.1f} m, {share:.0f} % of the best admissible proposal"
    return "", ""


def _blame(row: Mapping[str, Any], kind: str) -> str:
    """Says with whom and when, as far as the row knows."""
    agent, time = row.get(f"{kind}_agent"), row.get(f"{kind}_time")
    text = f" with {agent}" if agent else ""
    return text + (f" at {time:.1f} s" if time is not None and np.isfinite(time) else "")


def _lost_in_drive(row: Mapping[str, Any]) -> tuple[str, str]:
    lost = row.get("lost")
    if not lost:
        return "", ""
    first = lost[0]
    who = f" with {first['object_type']} {first['object']}" if first["object"] else ""
    when = "" if first["time"] is None else f" at {first['time']:.1f} s"
    return first["metric"], first["detail"] + who + when
