"""Benchmark rows of whole drives: SPDM in closed loop, one scenario and batches of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from spdm_experiments.bench_scenes import scene_files
from spdm_experiments.bench_watch import Stopwatch
from spdm_experiments.inventory import Entry, take_inventory
from spdm_experiments.loading import LoadedScenes
from spdm_experiments.options import Simulate
from spdm_experiments.simulate_points import make_points
from spdm_experiments.simulate_together import together
from spdm_experiments.simulate_work import SimulateEngine
from spdm_experiments.sources import Selection
from spdm_jax.batching import Precision
from spdm_jax.config import DT
from spdm_jax.io.pack import pack
from spdm_jax.io.raw import ScenarioError
from spdm_jax.synthetic.suites import SuiteReader

if TYPE_CHECKING:
    from spdm_experiments.bench_rows import Child

Traffic = Literal["replay", "reactive"]
TRAFFIC: Final[tuple[Traffic, ...]] = ("replay", "reactive")
SUITE: Final = "common-14"
TYPES: Final = (
    "behind_long_vehicle",
    "changing_lane",
    "following_lane_with_lead",
    "high_magnitude_speed",
    "starting_left_turn",
    "starting_right_turn",
    "stopping_with_lead",
    "traversing_pickup_dropoff",
)
"""Types of the scenarios: as many of each in every batch, so that batches are comparable."""
NUM_PROPOSALS: Final = 60
REPETITIONS: Final = 3
"""Timed calls of each row; a drive is long enough to need no more."""


def drive_tokens(count: int) -> list[str]:
    """Returns scenarios: the first of each type, the second of each, and so on."""
    numbers = range(-(-count // len(TYPES)))
    return [f"{kind}-{number:02d}" for number in numbers for kind in TYPES][:count]


def pack_drives(folder: Path, count: int) -> None:
    """Packs the first scenarios into `drives`; files that are there already are kept."""
    reader = SuiteReader(SUITE, range(count))
    report = pack(Selection(reader, drive_tokens(count), None), folder / "drives")
    if report.failed:
        raise ScenarioError(f"drives: {report.failed}")


class Drives:
    """Scenarios of one shape, in one kind of traffic, that SPDM drives through as `spdm simulate`.

    Attributes:
      seconds: length of a drive.

    Args:
      files: scenarios; all are padded as the largest needs, so that one program drives any of them.
      traffic: how the others move.
      precision: of all computation.
    """

    def __init__(self, files: Sequence[Path], traffic: Traffic, precision: Precision):
        options = Simulate(
            scenes=files[0].parent,
            planner=("spdm",),
            num_proposals=(NUM_PROPOSALS,),
            traffic=(traffic,),
            precision=precision,
        )
        self._entries: list[Entry] = take_inventory(files).entries
        self.seconds = DT * (self._entries[0].num_iterations - 1)
        self._job = together(options, self._entries, make_points(options))

    def load(self, count: int) -> tuple[SimulateEngine, LoadedScenes]:
        """Returns what drives, in one call, and the first so many scenarios."""
        (group,) = self._job.groups
        job = replace(self._job, groups=[replace(group, chunk=count)])
        return job.engine(), job.loader().load(self._entries[:count], group.padding)


def check(rows: Sequence[Mapping[str, Any]], alone: Mapping[str, Any] | None) -> dict[str, Any]:
    """Compares a batch with its first scenario driven alone.

    Args:
      rows: one per scenario.
      alone: the row of the first scenario; None where there was no such drive.

    Returns:
      What goes into the benchmark's row.

    Raises:
      RuntimeError: a drive failed, or depends on its batch.
    """
    for row in rows:
        if row["status"] != "ok":
            raise RuntimeError(f"{row['token']}: {row['reason']}")
    untimed = lambda row: {name: value for name, value in row.items() if name != "run_ms"}
    if alone is not None and untimed(rows[0]) != untimed(alone):
        raise RuntimeError(f"a drive depends on the {len(rows)} scenarios of its batch")
    return {"mean_score": sum(row["score"] for row in rows) / len(rows)}


def drives(child: Child) -> None:
    """Adds a row for each kind of traffic and number of scenarios to a child's."""
    child.watch = Stopwatch(REPETITIONS, warmups=0)
    for traffic in TRAFFIC:
        files = scene_files(child.folder, "drives")[: max(child.size.drives)]
        prepared = Drives(files, traffic, child.precision)
        alone: list[Mapping[str, Any]] = []
        for count in child.size.drives:
            engine, scenes = prepared.load(count)

            def same(rows: list[Mapping[str, Any]], alone=alone) -> dict[str, Any]:
                found = check(rows, alone[0] if alone else None)
                alone[:] = alone or rows[:1]
                return found

            child.add(
                f"{count} drive(s), {traffic}",
                lambda engine=engine, scenes=scenes: engine.compute(scenes, 0)[0],
                same,
                drives=count,
                seconds=prepared.seconds,
                suite=SUITE,
                kinds=len(TYPES),
                traffic=traffic,
                num_proposals=NUM_PROPOSALS,
            )
