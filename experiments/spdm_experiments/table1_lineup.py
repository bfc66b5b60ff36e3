"""The paper's table of predictions: planners, kinds of prediction, benchmarks, published scores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

from spdm_experiments.closed_loop_lineup import Suite
from spdm_experiments.simulate_options import LearnedName, Prediction
from spdm_experiments.simulate_points import NAMES

Planner = Literal["pdm-closed", "dtpp", "gameformer", "gameformer-dipp", "dipp"]
PLANNERS: Final[tuple[Planner, ...]] = get_args(Planner)
"""Rows of the table, in the paper's order."""
KINDS: Final[tuple[Prediction, ...]] = get_args(Prediction)
TITLES: Final[Mapping[Prediction, str]] = {
    "learned": "learned / rule-based",
    "perfect": "perfect",
    "none": "none",
}
FORECASTS: Final[Mapping[str, Prediction]] = {
    "constant_velocity": "learned",
    "perfect": "perfect",
    "none": "none",
}
"""PDM-Closed's forecasts, by what stands in the table for them."""


@dataclass(frozen=True)
class Column:
    """One column of the table.

    Attributes:
      key: name on the command line.
      suite: whose scenarios.
      traffic: "replay" or "reactive".
      mode: "closed" or "open".
      kind: of simulation, for people.
      benchmark: what the paper measured instead.
    """

    key: str
    suite: str
    traffic: str
    mode: str
    kind: str
    benchmark: str

    @property
    def folder(self) -> str:
        """Name of the run folder."""
        return f"{self.suite}-{self.kind.replace(' ', '-')}"

    @property
    def title(self) -> str:
        """Suite and kind of simulation."""
        return f"{self.suite}, {self.kind}"


COLUMNS: Final = (
    Column("nr", "common-14", "replay", "closed", "non-reactive", "Val14 NR"),
    Column("r", "common-14", "reactive", "closed", "reactive", "Val14 R"),
    Column("ol", "common-14", "replay", "open", "open loop", "Val14 OL"),
    Column("interplan", "interactive-8", "reactive", "closed", "reactive", "interPlan R"),
)
_PUBLISHED: Final[Mapping[Planner, Sequence[Sequence[float | None]]]] = {
    "pdm-closed": (
        (92.84, 92.28, 42.52, 41.88),
        (93.80, None, 46.96, None),
        (41.07, 40.33, 15.74, 30.63),
    ),
    "dtpp": (
        (64.54, 68.23, 67.05, 37.27),
        (53.65, 64.04, 32.52, 25.12),
        (51.09, 54.81, 56.49, 21.72),
    ),
    "gameformer": (
        (34.99, 34.98, 76.33, 4.10),
        (33.92, 34.82, 76.31, 3.28),
        (30.24, 26.71, 76.26, 3.28),
    ),
    "gameformer-dipp": (
        (79.83, 80.95, 80.38, 21.26),
        (81.04, 81.15, 81.01, 19.00),
        (58.14, 51.14, 80.73, 13.19),
    ),
    "dipp": (
        (73.35, 77.65, 37.21, 21.25),
        (74.19, 79.02, 37.67, 12.90),
        (49.58, 56.86, 37.25, 13.07),
    ),
}
SOURCE: Final = (
    "A. Distelzweig et al., Perfect Prediction or Plenty of Proposals? What Matters Most in "
    "Planning for Autonomous Driving, 2025"
)
"""Of the published scores."""


def published(planner: Planner, kind: Prediction, column: Column) -> float | None:
    """Returns the paper's score from 0 to 100; None where it has none."""
    return _PUBLISHED[planner][KINDS.index(kind)][COLUMNS.index(column)]


def suite_of(
    column: Column, planners: Sequence[Planner], weights: Path | None, scenes: Path | None = None
) -> Suite:
    """Returns who drives where for one column.

    PDM-Closed's forecast is fixed before it proposes: as in the paper it has no perfect one where
    traffic reacts.

    Args:
      column: of the table.
      planners: rows of the table.
      weights: folder with PLANNER.safetensors for each learned planner.
      scenes: scenarios to drive through instead of the built-in suite.
    """
    lineup: list[dict[str, Any]] = []
    loop = {"traffic": (column.traffic,), "mode": (column.mode,)}
    for planner in (planner for planner in PLANNERS if planner in planners):
        own: dict[str, Any] = {"weights": weights, "prediction": KINDS}
        if planner == "pdm-closed":
            known = [f for f in FORECASTS if f != "perfect" or column.traffic == "replay"]
            own = {"forecast": tuple(known)}
        lineup.append({"planner": (planner,), **loop, **own})
    return Suite(column.folder, scenes or Path(column.suite), (), tuple(lineup))


def learned(planners: Sequence[Planner]) -> list[LearnedName]:
    """Returns the planners that need weights."""
    return [name for name in get_args(LearnedName) if name in planners]


def row_of(point: Mapping[str, Any]) -> tuple[Planner, Prediction]:
    """Returns planner and kind of prediction of an entry of run.json."""
    names: dict[str, Planner] = {NAMES[planner]: planner for planner in PLANNERS}
    kind: Prediction = point.get("prediction") or FORECASTS[point["forecast"]]
    return names[point["planner"]], kind
