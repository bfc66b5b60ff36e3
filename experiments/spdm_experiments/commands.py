"""The verbs of `spdm`: each takes its options and returns whether all went well.

Heavy imports happen inside the verbs. An error that ends a verb is raised (`ValueError` with a
text for the user); what went wrong for single scenarios is printed and makes the verb return False.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from spdm_experiments.options import Demo, Doctor, Pack, Plan, Score, Show

if TYPE_CHECKING:
    from spdm_jax.io.pack import PackReport

MAX_REASONS = 20
"""Failed scenarios listed on the terminal; the report file has them all."""


def doctor(options: Doctor) -> bool:
    """Prints versions, devices and the self-test; False if a check fails."""
    from spdm_experiments.doctor import report
    from spdm_experiments.runtime import configure_jax

    lines, passed = report(configure_jax(options, x64=True))
    print("\n".join(lines))
    return passed


def pack(options: Pack) -> bool:
    """Packs a source into scenario files; False if a scenario failed."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    from spdm_experiments.sources import open_source
    from spdm_jax.io.pack import pack as pack_reader

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.1f} scenarios/s")

    reader, notes = open_source(options)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    with Progress(
        TextColumn("packing"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TextColumn("eta"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as bar:
        task = bar.add_task("packing", total=len(reader.tokens()))

        def advance(done: int, total: int, token: str, outcome: str) -> None:
            bar.update(task, completed=done, total=total)

        report = pack_reader(
            reader, options.destination, overwrite=options.overwrite, progress=advance
        )
    print(summary(report, options.destination))
    return not report.failed


def summary(report: "PackReport", destination: Path) -> str:
    """Returns the outcome of a pack in words, with the reason of each failed scenario."""
    lines = [
        f"{destination}: {report.total} scenarios, {len(report.written)} written, "
        f"{len(report.skipped)} there already, {len(report.failed)} failed"
    ]
    failed = list(report.failed.items())
    lines += [f"  {token}: {reason}" for token, reason in failed[:MAX_REASONS]]
    if len(failed) > MAX_REASONS:
        from spdm_jax.io.pack import REPORT_NAME

        lines.append(f"  {len(failed) - MAX_REASONS} more in {destination / REPORT_NAME}")
    return "\n".join(lines)


def demo(options: Demo) -> bool:
    """Plans and scores one built-in scene and writes a page that shows it."""
    raise ValueError("spdm demo is not part of this version yet")


def plan(options: Plan) -> bool:
    """Plans once per scenario."""
    raise ValueError("spdm plan is not part of this version yet")


def score(options: Score) -> bool:
    """Scores given trajectories."""
    raise ValueError("spdm score is not part of this version yet")


def show(options: Show) -> bool:
    """Writes a page that draws one scenario."""
    raise ValueError("spdm show is not part of this version yet")
