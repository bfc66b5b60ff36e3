"""Command-line options: one frozen dataclass per verb, nothing that needs JAX.

The string below a field is its help text.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

Format = Literal["auto", "nuplan", "av2", "synthetic"]
PlannerName = Literal["spdm", "pdm-closed"]


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
    num_proposals: int = 60
    """Proposals per scene: SPDM 15, 20, 25, ...; PDM-Closed 1, 3, 6, 15, 30 or 60."""
    speeds: tuple[float, ...] = ()
    """Target speeds as fractions of the speed limit; the planner's own grid if left out."""
    offsets: tuple[float, ...] = ()
    """Lateral offsets in m, left positive, the first 0; the planner's own grid if left out."""
    tracker: Literal["reference", "corrected"] = "reference"
    """Velocity fit of the tracker: as published, or with its difference matrix repaired."""
    forecast: Literal["constant_velocity", "perfect", "none"] = "constant_velocity"
    """Where the other agents' future comes from."""


@dataclass(frozen=True, kw_only=True)
class Demo(Planner):
    """Plan and score a built-in scene, write a page to look at. Needs no data."""

    scene: str = "parked_car"
    """Name of the scene; an unknown one lists them all."""
    seed: int = 0
    """Seed of the scene's traffic."""
    out: Path = Path("demo")
    """Folder to write."""


@dataclass(frozen=True, kw_only=True)
class Doctor(OnDevice):
    """Print versions, devices and the compile cache, and test the numerics of this machine.

    The exit code is 1 if a check fails.
    """


@dataclass(frozen=True, kw_only=True)
class Pack(Common):
    """Turn recorded or generated scenarios into scenario files, once.

    Files that are there already are kept, so an interrupted run goes on where it stopped. A
    scenario that cannot be used is listed with its reason; the exit code is then 1.
    """

    source: Annotated[Positional[str], arg(metavar="SRC")]
    """A .db file or a folder of them (nuPlan), a log folder or a folder of logs (Argoverse 2), or
    a comma-separated list of scene names, "all" for every one (synthetic)."""
    destination: Annotated[Positional[Path], arg(metavar="DST")]
    """Folder to write, one file per scenario."""
    format: Format = "auto"
    """What the source is; auto looks at the files."""
    maps: Path | None = None
    """nuPlan's maps folder, if it does not lie near the logs."""
    filter: Path | None = None
    """A nuPlan scenario filter, YAML."""
    token: tuple[str, ...] = ()
    """Take these scenarios only."""
    type: tuple[str, ...] = ()
    """Take these scenario types only (nuPlan)."""
    log: tuple[str, ...] = ()
    """Take these logs only (nuPlan)."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of each scene (synthetic)."""
    stride: float | None = None
    """Seconds between the scenarios of one log (Argoverse 2)."""
    limit: int | None = None
    """Take the first so many scenarios of what the other options select."""
    overwrite: bool = False
    """Write files anew that are there already."""


@dataclass(frozen=True, kw_only=True)
class Plan(Planner):
    """Plan once per scenario, write the chosen trajectories with all proposals' scores."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    out: Path = Path("out/plan")
    """Folder to write."""
    limit: int | None = None
    """Take the first so many scenarios."""
    chunk: int = 32
    """Scenarios per device call; smaller needs less memory."""


@dataclass(frozen=True, kw_only=True)
class Score(Compute):
    """Score given trajectories with the PDM sub-scores."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    trajectories: Annotated[Positional[Path], arg(metavar="TRAJECTORIES")]
    """A .npy file: [S, P, T, 3] x, y, heading of the rear axle in each scene's local frame."""
    out: Path = Path("out/score")
    """Folder to write."""
    dt: float = 0.1
    """Spacing of the trajectories' states, s."""
    shared: bool = False
    """The file holds one set [P, T, 3] for all scenes, relative to the ego's pose."""
    tracker: Literal["reference", "corrected", "none"] = "reference"
    """Track the trajectories first, as the planner does; none scores them as they are."""
    forecast: Literal["constant_velocity", "perfect", "none"] = "constant_velocity"
    """Where the other agents' future comes from."""
    limit: int | None = None
    """Take the first so many scenarios."""
    chunk: int = 32
    """Scenarios per device call; smaller needs less memory."""


@dataclass(frozen=True, kw_only=True)
class Show(Common):
    """Write one HTML page that draws a scenario, with its plan if there is one."""

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """A scenario file, or a folder of them together with --token."""
    token: str | None = None
    """The scenario of the folder to draw; the first one if left out."""
    plans: Path | None = None
    """Output folder of spdm plan."""
    out: Path = Path("scene.html")
    """File to write."""


Options = Demo | Doctor | Pack | Plan | Score | Show
