"""What the verbs say on the terminal besides tables: progress, failures, files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

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

MAX_REASONS = 20
"""Failed scenarios listed on the terminal; the report file has them all."""


def reasons(failed: dict[str, str], report: Path) -> list[str]:
    """Returns a line per failed scenario, and where the rest is if there are many.

    Args:
      failed: token -> reason.
      report: file that lists all.
    """
    lines = [f"  {token}: {reason}" for token, reason in list(failed.items())[:MAX_REASONS]]
    if len(failed) > MAX_REASONS:
        lines.append(f"  {len(failed) - MAX_REASONS} more in {report}")
    return lines


def print_files(files: list[Path]) -> None:
    """Names what a run has written."""
    print("written:")
    for path in files:
        print(f"  {path}")


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} scenarios/s")


@contextmanager
def progress_line(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Shows scenarios done on the error stream, their rate and the time left.

    Args:
      label: what is being done.
      total: number of scenarios.

    Yields:
      A function to call with the number done so far.
    """
    with Progress(
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TextColumn("eta"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done: bar.update(task, completed=done)
