"""What the verbs say on the terminal besides tables: progress, failures, files."""

import sys
import time
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


class RateLine:
    """One line on the error stream: scenes done, rate, compilation apart, time left.

    On a terminal it is rewritten in place; elsewhere a new one appears every few seconds.
    """

    def __init__(self, total: int, before: int = 0):
        """Starts the clock.

        Args:
          total: scenes.
          before: of them, those that were done already.
        """
        self._total, self._before = total, before
        self._started = time.perf_counter()
        self._shown = 0.0
        self._terminal = sys.stderr.isatty()
        self._pause = 0.1 if self._terminal else 10.0

    def text(self, done: int, compile_s: float, programs: int, working: float) -> str:
        """Returns the line.

        Args:
          done: scenes done, those before included.
          compile_s: seconds of compilation.
          programs: compiled programs.
          working: seconds in which scenes were computed.
        """
        here, working = done - self._before, max(working, 1e-3)
        line = f"{done}/{self._total} scenes"
        if here:
            line += f"  {here / working:.1f} scenes/s"
        line += f"  compile {compile_s:.1f} s ({programs} program{'s' * (programs != 1)})"
        if here:
            left = round((self._total - done) * working / here)
            line += f"  eta {left // 60}:{left % 60:02d}"
        return line

    def show(self, done: int, compile_s: float, programs: int, waited: float) -> None:
        """Shows the line, where it is time for one; always after the last scene.

        Args:
          done: scenes done, those before included.
          compile_s: seconds of compilation, of all processes together.
          programs: compiled programs.
          waited: seconds in which no scene could be computed because of that.
        """
        now = time.perf_counter()
        if done < self._total and now - self._shown < self._pause:
            return
        self._shown = now
        line = self.text(done, compile_s, programs, now - self._started - waited)
        sys.stderr.write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
        sys.stderr.flush()

    def close(self) -> None:
        """Leaves the line."""
        if self._terminal:
            sys.stderr.write("\n")
