"""Points of `spdm simulate`: a planner, its proposals, the traffic, and how the loop is closed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from spdm_experiments.options import Simulate
from spdm_experiments.sweep_grid import point_of
from spdm_jax import PlannerConfig, PlannerParams

NAMES = {
    "spdm": "SPDM",
    "pdm-closed": "PDM-Closed",
    "idm": "IDM",
    "idm-mobil": "IDM + MOBIL",
    "constant-velocity": "Constant velocity",
    "log-replay": "Log replay",
}
"""Planners of the command line, and how tables call them."""
_PROPOSERS = ("spdm", "pdm-closed")
_SETTINGS: tuple[str, ...] = ("forecast", "progress_reference", "borrow_oncoming")
"""What PDM-Closed and SPDM can be asked for; the other planners have no such thing."""


@dataclass(frozen=True)
class Point:
    """One planner in one kind of simulation.

    Attributes:
      planner: name on the command line.
      num_proposals: N_p, None for planners that make no proposals.
      traffic: "reactive" or "replay".
      mode: "closed" or "open".
      settings: of the planner, as run.json holds them.
      config: static settings of the planner.
      params: traced settings of the planner.
    """

    planner: str
    num_proposals: int | None
    traffic: str
    mode: str
    settings: Mapping[str, Any]
    config: PlannerConfig
    params: PlannerParams

    def entry(self, number: int) -> dict[str, Any]:
        """Returns the point as run.json holds it."""
        return {
            "point": number,
            "planner": NAMES[self.planner],
            "num_proposals": self.num_proposals,
            "traffic": self.traffic,
            "mode": self.mode,
            **self.settings,
        }


def make_points(options: Simulate) -> list[Point]:
    """Returns the product of planners and kinds of simulation, every point once.

    Raises:
      ValueError: a number of proposals that a planner cannot make, or traffic that reacts to an
        ego in open loop and no other.
    """
    if options.mode == ("open",) and options.traffic == ("reactive",):
        raise ValueError(
            "--mode open repeats the recorded drive, and its traffic is the recorded one; leave "
            "--traffic out or add --mode closed"
        )
    points: dict[str, Point] = {}
    for mode, traffic in product(options.mode, options.traffic or ("reactive",)):
        # In open loop nothing reacts: the point is the same for every kind of traffic.
        shown = "replay" if mode == "open" else traffic
        for planner in options.planner:
            for point in _of_planner(options, planner, shown, mode):
                points.setdefault(repr(point.entry(0)), point)
    return list(points.values())


def _of_planner(options: Simulate, planner: str, traffic: str, mode: str) -> Iterator[Point]:
    if planner not in _PROPOSERS:
        none: dict[str, Any] = dict.fromkeys(_SETTINGS)
        yield Point(planner, None, traffic, mode, none, PlannerConfig(), PlannerParams())
        return
    axes = {
        "num_proposals": options.num_proposals,
        "forecast": options.forecast,
        "progress_reference": options.progress,
        # PDM-Closed has no paths that could.
        "borrow_oncoming": [v == "yes" for v in options.borrow_oncoming if planner == "spdm"],
    }
    given = {name: values for name, values in axes.items() if values}
    for values in product(*given.values()):
        made = point_of({"planner": planner, **dict(zip(given, values, strict=True))})
        spec = made.spec
        settings = {name: made.settings.get(name) for name in _SETTINGS}
        if planner == "spdm":
            settings["borrow_oncoming"] = "yes" if spec.config.borrow_oncoming else "no"
        yield Point(planner, made.num_proposals, traffic, mode, settings, spec.config, spec.params)
