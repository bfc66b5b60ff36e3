"""Command-line options of `spdm simulate`.

The string below a field is its help text.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from spdm_experiments.option_bases import Forecast, OverGrid

LearnedName = Literal["gameformer", "gameformer-path", "gameformer-dipp", "dipp", "dtpp"]
"""Planners that need weights."""
SimulatedPlanner = (
    Literal["spdm", "pdm-closed", "idm", "idm-mobil", "constant-velocity", "log-replay"]
    | LearnedName
)
Prediction = Literal["learned", "perfect", "none"]


@dataclass(frozen=True, kw_only=True)
class Simulate(OverGrid):
    """Drive whole scenarios in simulation and score the drives with nuPlan's metrics.

    Several values of an option make a product of runs; each scenario has a row for every one of
    them. The same command goes on where an interrupted one stopped, also after a kill. A scenario
    that fails is a row with its reason; the exit code is then 1.
    """

    scenes: Annotated[Positional[Path], arg(metavar="SUITE|SCENES")]
    """A built-in suite (common-14, interactive-8), a folder of scenario files (see spdm pack), or
    one file."""
    planner: tuple[SimulatedPlanner, ...] = ("spdm",)
    """Who drives the ego."""
    num_proposals: tuple[int, ...] = ()
    """Proposals per step: SPDM 15, 20, 25, ... (60 if left out); PDM-Closed 1, 3, 6, 15, 30 or 60
    (15 if left out)."""
    traffic: tuple[Literal["reactive", "replay"], ...] = ()
    """Vehicles that drive by IDM and react to the ego (if left out), or all objects as
    recorded."""
    mode: tuple[Literal["closed", "open"], ...] = ("closed",)
    """closed: the ego tracks its plans. open: the ego keeps to the record, and its plans are
    compared with what the recorded driver did next."""
    forecast: tuple[Forecast, ...] = ()
    """Where PDM-Closed and SPDM take the other agents' future from."""
    weights: Path | None = None
    """Weights of the learned planners (gameformer, gameformer-path, gameformer-dipp, dipp, dtpp): a
    file of spdm train or spdm convert, or a folder with PLANNER.safetensors, or the folder PLANNER
    of spdm train, for each (gameformer-path and gameformer-dipp take gameformer's where they have
    none); small: those that come with the package."""
    prediction: tuple[Prediction, ...] = ()
    """What learned planners take for the other agents' future: their own predictions (learned, if
    left out), the record or how the agents would react (perfect), or nothing (none)."""
    progress: tuple[Literal["auto", "centerline", "goal"], ...] = ()
    """What PDM-Closed and SPDM measure progress along; see spdm plan --progress-reference."""
    borrow_oncoming: tuple[Literal["no", "yes"], ...] = ()
    """Whether SPDM may pass a standing obstacle through the oncoming lane (no if left out)."""
    replan_every: int = 1
    """Steps of 0.1 s between two plans."""
    record: Literal["none", "history", "plans"] = "none"
    """Also write the drives, or the drives and the plan of every step, for the report's player."""
    types: tuple[str, ...] = ()
    """Take scenarios of these types only."""
    by_type: bool = False
    """Print the scores of each scenario type as well."""
    seed: int = 0
    """Seed of the bootstrap intervals."""
    out: Path = Path("out/simulate")
    """Run folder to write or to go on with."""
