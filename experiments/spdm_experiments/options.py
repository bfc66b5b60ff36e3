"""Command-line options: one frozen dataclass per verb, nothing that needs JAX.

The string below a field is its help text.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from spdm_experiments.navsim_options import NavsimScript, Profiled, WithPrevious
from spdm_experiments.option_bases import (
    Chunked,
    Common,
    Compute,
    Forecast,
    Format,
    OnDevice,
    OverGrid,
    Planner,
    PlannerName,
)
from spdm_experiments.simulate_options import Simulate

__all__ = [
    "Chunked",
    "Compute",
    "Convert",
    "Demo",
    "Doctor",
    "Format",
    "Label",
    "NavsimScript",
    "OnDevice",
    "Options",
    "OverGrid",
    "Pack",
    "Plan",
    "Planner",
    "Report",
    "Score",
    "Show",
    "Simulate",
    "Sweep",
    "Vocab",
]


@dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Turn a torch checkpoint of a learned model into a .safetensors file. Needs no torch.

    Every array is checked by name, shape and value. The file keeps torch's names and knows the
    model's sizes.
    """

    source: Annotated[Positional[Path], arg(metavar="SRC")]
    """A .pth, .pt, .ckpt, .npz or .safetensors file."""
    destination: Annotated[Positional[Path], arg(metavar="DST")]
    """The .safetensors file to write."""
    model: Literal["gameformer", "dtpp", "dipp"]
    """What the weights belong to."""
    prefix: str = ""
    """The part of SRC that holds the weights, if it holds more (model, state_dict, ...)."""
    variable_cost: bool = False
    """DTPP was trained with cost weights that depend on the scene."""


@dataclass(frozen=True, kw_only=True)
class Demo(Compute):
    """Plan the built-in scenes with SPDM (60) and PDM-Closed (15) and compare. Needs no data."""

    scenes: tuple[str, ...] = ()
    """These scenes only; an unknown one lists them all."""
    seed: int = 0
    """Seed of the scenes."""
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
    a comma-separated list of scene names, "all" for every one, or the name of a suite
    (synthetic)."""
    destination: Annotated[Positional[Path], arg(metavar="DST")]
    """Folder to write, one file per scenario."""
    format: Format = "auto"
    """What the source is; auto looks at the files."""
    maps: Path | None = None
    """nuPlan's maps folder, if it does not lie near the logs."""
    filter: Path | None = None
    """A nuPlan scenario filter, YAML."""
    interplan: Path | None = None
    """interPlan's modifications, YAML: changes the scenarios TOKEN-CODE that --filter or --token
    name, and takes 30 s of each."""
    token: tuple[str, ...] = ()
    """Take these scenarios only."""
    type: tuple[str, ...] = ()
    """Take these scenario types only (nuPlan; with --interplan those of interPlan)."""
    log: tuple[str, ...] = ()
    """Take these logs only (nuPlan)."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of each scene (synthetic); of a suite the numbers of its scenes, all if left out."""
    stride: float | None = None
    """Seconds between the scenarios of one log (Argoverse 2)."""
    limit: int | None = None
    """Take the first so many scenarios of what the other options select."""
    overwrite: bool = False
    """Write files anew that are there already."""


@dataclass(frozen=True, kw_only=True)
class Plan(Chunked, Planner):
    """Plan once per scenario, write the chosen trajectories and all proposals' scores.

    Ctrl-C ends the run after the chunk at hand. What is done is in the folder by then. A scenario
    that fails is listed with its reason; the exit code is then 1.
    """

    out: Path = Path("out/plan")
    """Folder to write: rows.parquet, trajectories.npz, run.json, and pictures."""
    html: int = 0
    """Draw the first so many scenarios, of the first chunk at most, on one HTML page."""
    png: int = 0
    """Draw the first so many scenarios, of the first chunk at most, as PNG files."""


@dataclass(frozen=True, kw_only=True)
class Score(Chunked, WithPrevious):
    """Score given trajectories with the PDM sub-scores.

    Ctrl-C ends the run after the chunk at hand. What is done is in the folder by then. A scenario
    that fails is listed with its reason; the exit code is then 1.
    """

    trajectories: Annotated[Positional[Path], arg(metavar="TRAJ")]
    """Rear-axle poses x, y, heading in a .npy or .npz file: [S, P, T, 3], one set per scenario in
    the order of the file names, or [P, T, 3], the same in every scenario. A .npz file holds them as
    "trajectories"; "tokens" [S] beside them says which scenario each set belongs to."""
    out: Path = Path("out/score")
    """Folder to write: rows.parquet and run.json."""
    frame: Literal["ego", "local", "global"] = "ego"
    """Frame of the poses: the ego's current rear axle, the scenario's own, or the map's."""
    tracker: Literal["reference", "corrected", "none"] = "reference"
    """Track the trajectories first, as the planner does; none scores them as they are."""
    forecast: Forecast = "constant_velocity"
    """Where the other agents' future comes from."""
    progress_reference: Literal["auto", "centerline", "goal"] = "auto"
    """What progress is measured along: the centreline (auto, as published) or the way to the
    goal."""


@dataclass(frozen=True, kw_only=True)
class Show(Planner):
    """Draw one scenario with its plan: an HTML page, a PNG file, or both.

    Without --html and --png a page TOKEN.html is written.
    """

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    index: int = 0
    """Which one, in the order of the file names."""
    token: str | None = None
    """Which one, by its token."""
    html: Path | None = None
    """Page to write."""
    png: Path | None = None
    """Picture to write."""


@dataclass(frozen=True, kw_only=True)
class Sweep(OverGrid):
    """Plan every scenario at every point of a grid of settings, write a row for each.

    Each option below takes several values; the grid is their product. The same command goes on
    where an interrupted one stopped, also after a kill. A scenario that fails is a row with its
    reason; the exit code is then 1.
    """

    grid: Path | None = None
    """A TOML file with one or several grids; see docs/sweeps.md."""
    planner: tuple[PlannerName, ...] = ()
    """SPDM, the baseline PDM-Closed, or both."""
    num_proposals: tuple[int, ...] = ()
    """Proposals per scene: SPDM 15, 20, 25, ... (60 if left out); PDM-Closed 1, 3, 6, 15, 30 or 60
    (15 if left out)."""
    speeds: tuple[str, ...] = ()
    """Target speeds as fractions of the speed limit, between commas: 0.2,0.4,0.6,0.8,1."""
    offsets: tuple[str, ...] = ()
    """Lateral offsets in m, left positive, the first 0, between commas: 0,-1,1."""
    merge_times: tuple[str, ...] = ()
    """SPDM's merge distances in s at the current speed, between commas: 4,2,6."""
    horizon: tuple[float, ...] = ()
    """T_f: when SPDM's speed profiles reach their target, s."""
    forecast: tuple[Forecast, ...] = ()
    """Where the other agents' future comes from."""
    progress_reference: tuple[Literal["auto", "centerline", "goal"], ...] = ()
    """What progress is measured along; see spdm plan."""
    tracker: tuple[Literal["reference", "corrected"], ...] = ()
    """Velocity fit of the tracker: as published, or with its difference matrix repaired."""
    set: Annotated[tuple[tuple[str, ...], ...], UseAppendAction] = ()
    """Any other number of the planner: idm.headway_time=1,1.5 scoring.ttc_weight=5."""
    out: Path = Path("out/sweep")
    """Run folder to write or to go on with."""
    seed: int = 0
    """Picks the scenarios of --stage-times."""
    trajectories: bool = False
    """Also write the chosen proposals' poses, in map coordinates."""
    stage_times: bool = False
    """Also time proposal generation, tracking and scoring for each number of proposals."""


@dataclass(frozen=True, kw_only=True)
class Report(OnDevice):
    """Write one HTML page for a run of spdm sweep or spdm simulate, or for two side by side.

    The page needs no server and no network, and may be moved. It has tables with bootstrap
    intervals, score and runtime over the number of proposals, two grid points scenario by
    scenario, the worst scenes with a player, and the failed scenarios with reasons.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """A folder that spdm sweep or spdm simulate has written, finished or not."""
    run2: Annotated[Positional[Path | None], arg(metavar="RUN2")] = None
    """Another one; differences are RUN minus RUN2."""
    out: Path = Path("report.html")
    """Page to write."""
    worst: int = 50
    """Scenes in each list of worst scenes."""
    players: int = 12
    """Scenes in the player, at most: planned anew for a sweep, as recorded for a simulation
    (--record). 0 for none."""
    scenes: Path | None = None
    """The folder of the scenario files, if it is no longer where the run found it."""
    figures: Path | None = None
    """Also write figures for papers (SVG, PDF, PNG) into this folder."""
    seed: int = 0
    """Seed of the bootstrap."""


@dataclass(frozen=True, kw_only=True)
class Label(Compute, Profiled):
    """Score the same vocabulary in every scenario and write labels to train from.

    The same command goes on where an interrupted one stopped, also after a kill. A scenario that
    fails has no labels and a reason; the exit code is then 1. Read with spdm_jax.open_labels.
    """

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    vocabulary: Annotated[Positional[Path], arg(metavar="VOCAB")]
    """Rear-axle poses x, y, heading in the ego frame, a .npy file [V, T, 3] (see spdm vocab)."""
    out: Path = Path("out/label")
    """Folder to write or to go on with."""
    components: str = "all"
    """Sub-scores to keep, between commas, or all: total, no_at_fault_collision, drivable_area,
    driving_direction, time_to_collision, comfort, progress, progress_raw; with NAVSIM's profiles
    also traffic_light and lane_keeping."""
    dtype: Literal["f16", "f32"] = "f16"
    """Type of the labels; computation is in --precision."""
    tracker: Literal["reference", "corrected", "none"] = "reference"
    """Track the trajectories first, as the planner does; none scores them as they are."""
    forecast: Forecast = "constant_velocity"
    """Where the other agents' future comes from."""
    progress_reference: Literal["auto", "centerline", "goal"] = "auto"
    """What progress is measured along: the centreline (auto, as published) or the way to the
    goal."""
    limit: int | None = None
    """Take the first so many scenarios, in the order of their file names."""
    chunk: int = 64
    """Scenarios per file of labels, and what a kill can cost at most."""
    shard: str = "1/1"
    """I/N: take every scenario that falls into part I of N. Parts need no contact with each other
    and may share a folder."""


@dataclass(frozen=True, kw_only=True)
class Vocab(Compute):
    """Build a vocabulary: cluster many trajectories by k-means.

    OUT.npy holds the centres [V, 41, 3] (x, y, heading in the ego frame, every 0.1 s), the most
    frequent first; OUT.json says what they were made from. The same scenarios and seed give the
    same bytes.
    """

    action: Annotated[Positional[Literal["build"]], arg(metavar="{build}")]
    """What to do."""
    source: Annotated[Positional[Path], arg(metavar="SCENES")]
    """A folder of scenario files (see spdm pack), or one file."""
    destination: Annotated[Positional[Path], arg(metavar="OUT.npy")]
    """File to write."""
    size: int = 4096
    """V, trajectories of the vocabulary."""
    seed: int = 0
    """Of the first centres, and of --sample."""
    origin: Annotated[Literal["logs", "proposals"], arg(name="from")] = "logs"
    """What to cluster: the recorded ego's next 4 s at every step of the logs, or SPDM's tracked
    proposals at each scenario's start."""
    num_proposals: int = 60
    """Proposals per scenario."""
    sample: int = 200_000
    """Cluster at most so many trajectories, drawn at random."""
    limit: int | None = None
    """Take the first so many scenarios, in the order of their file names."""


Options = (
    Convert
    | Demo
    | Doctor
    | Label
    | NavsimScript
    | Pack
    | Plan
    | Report
    | Score
    | Show
    | Simulate
    | Sweep
    | Vocab
)
