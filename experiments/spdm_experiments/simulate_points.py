"""Points of `spdm simulate`: a planner, its proposals, the traffic, and how the loop is closed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, get_args

from spdm_experiments.options import Simulate
from spdm_experiments.simulate_options import LearnedName
from spdm_experiments.sweep_grid import point_of
from spdm_jax import PlannerConfig, PlannerParams
from spdm_models import drivers
from spdm_models.drivers import LearnedPlanner, Weights
from spdm_models.weights import SMALL_WEIGHTS

NAMES = {
    "spdm": "SPDM",
    "pdm-closed": "PDM-Closed",
    "idm": "IDM",
    "idm-mobil": "IDM + MOBIL",
    "constant-velocity": "Constant velocity",
    "log-replay": "Log replay",
    **drivers.TITLES,
}
"""Planners of the command line, and how tables call them."""
_PROPOSERS = ("spdm", "pdm-closed")
_SETTINGS: tuple[str, ...] = ("forecast", "progress_reference", "borrow_oncoming")
"""What PDM-Closed and SPDM can be asked for; the other planners have no such thing."""
_LEARNED: tuple[LearnedName, ...] = get_args(LearnedName)


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
      params: traced settings of the planner: numbers, or a learned planner's weights.
      learned: static settings of a learned planner; None for the others.
    """

    planner: str
    num_proposals: int | None
    traffic: str
    mode: str
    settings: Mapping[str, Any]
    config: PlannerConfig
    params: Any
    learned: LearnedPlanner | None = None

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


def entries_of(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Returns points as run.json holds them, all with the same entries."""
    entries = [point.entry(number) for number, point in enumerate(points)]
    names = dict.fromkeys(name for entry in entries for name in entry)
    return [{**dict.fromkeys(names), **entry} for entry in entries]


def learned_planners(options: Simulate) -> list[LearnedName]:
    """Returns the planners of the options that need weights."""
    return [name for name in _LEARNED if name in options.planner]


def make_points(options: Simulate) -> list[Point]:
    """Returns the product of planners and kinds of simulation, every point once.

    Raises:
      ValueError: a number of proposals that a planner cannot make, traffic that reacts to an ego in
        open loop and no other, or weights that are missing or of another model.
    """
    if options.mode == ("open",) and options.traffic == ("reactive",):
        raise ValueError(
            "--mode open repeats the recorded drive, and its traffic is the recorded one; leave "
            "--traffic out or add --mode closed"
        )
    _check_learned(options)
    points: dict[str, Point] = {}
    for mode, traffic in product(options.mode, options.traffic or ("reactive",)):
        # In open loop nothing reacts: the point is the same for every kind of traffic.
        shown = "replay" if mode == "open" else traffic
        for planner in options.planner:
            for point in _of_planner(options, planner, shown, mode):
                points.setdefault(repr(point.entry(0)), point)
    return list(points.values())


def _check_learned(options: Simulate) -> None:
    learned = learned_planners(options)
    for given, name in ((options.weights, "--weights"), (options.prediction, "--prediction")):
        if given and not learned:
            raise ValueError(f"{name} is for learned planners: {', '.join(_LEARNED)}")
    if learned and options.weights is None:
        raise ValueError(
            f"{learned[0]} needs --weights: a file of spdm train or spdm convert, or small"
        )
    if learned and options.replan_every != 1:
        raise ValueError(
            f"{learned[0]} has to see every step of the last 2 s; leave --replan-every out"
        )


def _of_planner(options: Simulate, planner: str, traffic: str, mode: str) -> Iterator[Point]:
    if planner in _LEARNED:
        assert options.weights is not None
        weights = _weights(options.weights, planner)
        for prediction in options.prediction or ("learned",):
            settings = {
                **dict.fromkeys(_SETTINGS),
                "prediction": prediction,
                "weights": f"{weights.model} {weights.digest[:8]}",
            }
            learned = drivers.learned_planner(planner, weights, prediction)
            config, arrays = PlannerConfig(), weights.arrays
            yield Point(planner, None, traffic, mode, settings, config, arrays, learned)
        return
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


def weights_folder(given: Path) -> Path:
    """Returns what --weights names; "small" is the folder that comes with the package."""
    return SMALL_WEIGHTS if given == Path("small") and not given.exists() else given


def weights_file(given: Path, planner: LearnedName) -> Path:
    """Returns where a planner's weights are: the file itself, or the folder's file of its name."""
    given = weights_folder(given)
    if not given.is_dir():
        return given
    # Planners on GameFormer share its weights where they have none of their own.
    names = (planner, "gameformer") if planner.startswith("gameformer") else (planner,)
    kinds = ("{}/weights.safetensors", "{}.safetensors")
    found = [given / kind.format(name) for name in names for kind in kinds]
    return next((path for path in found if path.is_file()), given / f"{planner}.safetensors")


def _weights(given: Path, planner: LearnedName) -> Weights:
    path = weights_file(given, planner)
    return _read(path, planner, path.stat().st_mtime_ns if path.is_file() else 0)


@cache
def _read(path: Path, planner: LearnedName, changed: int) -> Weights:
    """Reads a file once, however many points it drives."""
    return drivers.read_weights(path, planner)
