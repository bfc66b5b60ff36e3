"""Options that several verbs have in common, and what they may be set to; nothing here needs JAX.

The string below a field is its help text.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

Format = Literal["auto", "nuplan", "av2", "synthetic"]
PlannerName = Literal["spdm", "pdm-closed"]
Forecast = Literal["constant_velocity", "perfect", "none"]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every verb."""

    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class OnDevice(Common):
    """Options of every verb that uses JAX."""

    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to compute; auto takes the fastest kind present."""
    compile_cache: bool = True
    """Keep compiled programs between runs in a private folder (SPDM_COMPILE_CACHE names it)."""


@dataclass(frozen=True, kw_only=True)
class Compute(OnDevice):
    """Options of every verb that runs the planner or the scorer."""

    precision: Literal["f32", "f64"] = "f32"
    """Floating-point type of all computation."""


@dataclass(frozen=True, kw_only=True)
class Planner(Compute):
    """Options of every verb that makes proposals."""

    planner: PlannerName = "spdm"
    """SPDM or the baseline PDM-Closed."""
    num_proposals: int | None = None
    """Proposals per scene: SPDM 15, 20, 25, ... (60 if left out); PDM-Closed 1, 3, 6, 15, 30 or 60
    (15 if left out)."""
    speeds: tuple[float, ...] = ()
    """Target speeds as fractions of the speed limit; the planner's own grid if left out."""
    offsets: tuple[float, ...] = ()
    """Lateral offsets in m, left positive, the first 0; the planner's own grid if left out."""
    tracker: Literal["reference", "corrected"] = "reference"
    """Velocity fit of the tracker: as published, or with its difference matrix repaired."""
    forecast: Forecast = "constant_velocity"
    """Where the other agents' future comes from."""
    progress_reference: Literal["auto", "centerline", "goal"] = "auto"
    """What progress is measured along: the centreline (as published), the way to the goal, or the
    first for PDM-Closed and the second for SPDM (auto)."""
    borrow_oncoming: bool = False
    """Let SPDM pass a standing obstacle through the oncoming lane."""


@dataclass(frozen=True, kw_only=True)
class Chunked(Compute):
    """Options of every verb that goes through a folder of scenarios."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    limit: int | None = None
    """Take the first so many scenarios, in the order of their file names."""
    chunk: int = 16
    """Scenarios per device call: smaller needs less memory and reports more often."""


@dataclass(frozen=True, kw_only=True)
class OverGrid(Compute):
    """Options of every verb that computes many scenarios at every point of a grid."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    out: Path = Path("out/run")
    """Run folder to write or to go on with."""
    limit: int | None = None
    """Take the first so many scenarios, in the order of their file names."""
    chunk: int | Literal["auto"] = "auto"
    """Scenarios per part of the run folder; auto goes by memory."""
    shard: str = "1/1"
    """I/N: take every scenario that falls into part I of N. Parts need no contact with each other
    and may share a folder."""
    cluster: str | None = None
    """Spread the work with Ray: "local" (or local:4, with four processes), "auto" for the cluster
    this machine is part of, or an address."""
