"""`python -m spdm_experiments.closed_loop`: the page of closed-loop results.

`run` drives every planner of the line-up through the built-in suites, as `spdm simulate` does;
`precision` drives two of them in float64 as well and compares; `page` only writes the page. Each
suite and precision has a run folder below --out: the same command goes on where it was stopped.
Run times can be those of another run, of fewer scenarios (--limit) on a quiet machine: --times.
"""

import argparse
import json
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from spdm_experiments.bench import processor
from spdm_experiments.closed_loop_lineup import PRECISION_LINEUP, SUITES, Suite
from spdm_experiments.closed_loop_page import write_page
from spdm_experiments.closed_loop_precision import Pair, compare
from spdm_experiments.inventory import Shard
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import Run, load_run
from spdm_experiments.sequence import go_on
from spdm_experiments.simulate import SimulateRun
from spdm_jax.batching import usable_cores
from spdm_jax.io.scenario_file import write_atomically

ABOUT, PRECISION = "about.json", "precision.json"
CHUNK = 4
"""Scenarios of a chunk: each is driven by every planner, and a chunk is what a stop can cost."""
EXIT_FAILED, EXIT_ERROR, EXIT_INTERRUPTED = 1, 2, 130


def drive(suite: Suite, options: Simulate, limit: int | None) -> bool:
    """Drives what the run folder of a suite still lacks; returns False if a scenario failed.

    Args:
      suite: scenarios and who drives.
      options: run folder, precision, device.
      limit: scenarios of each type at most.

    Raises:
      ValueError: the folder holds another run.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    scenes = suite.find(options, limit)
    return go_on(SimulateRun(options, scenes, suite.points()), scenes.inventory, Shard(1, 1))


def drive_in_double(
    suites: Sequence[Suite], options: Simulate, limit: int | None
) -> tuple[bool, dict[str, Any]]:
    """Drives two planners in float64 and compares them with their runs in float32.

    Args:
      suites: those of the runs in float32.
      options: `out` is the folder of all runs.
      limit: scenarios of each type at most, as in the runs in float32.

    Returns:
      Whether no scenario failed, and what `compare` found.

    Raises:
      ValueError: a run in float32 is not there, or of other scenarios.
    """
    good, pairs = True, []
    for suite in suites:
        single = load_run(options.out / suite.name)
        own = replace(suite, lineup=PRECISION_LINEUP)
        folder = options.out / f"{suite.name}-f64"
        double = replace(options, out=folder, precision="f64")
        good &= drive(own, double, limit)
        entries = own.find(double, limit).inventory.entries
        pairs.append(Pair(single, load_run(folder), own.points(), entries))
    return good, compare(pairs)


def main(argv: Sequence[str] | None = None, suites: Sequence[Suite] = SUITES) -> int:
    """Runs the command and returns the exit code.

    Args:
      argv: arguments without the program's name; those of the process by default.
      suites: what to drive through.
    """
    given = _options(argv)
    # The folder of each run, and its precision, are set where it is known.
    options = Simulate(scenes=Path(), out=given.out, chunk=given.chunk, device=given.device)

    def work() -> bool:
        good = True
        if given.step == "run":
            selected = "" if given.limit is None else f" --limit {given.limit}"
            note_machine(given.out, f"python -m spdm_experiments.closed_loop{selected}")
            for suite in suites:
                good &= drive(suite, replace(options, out=given.out / suite.name), given.limit)
        elif given.step == "precision":
            good, found = drive_in_double(suites, options, given.limit)
            write_atomically(given.out / PRECISION, (json.dumps(found, indent=1) + "\n").encode())
        if given.page:
            for path in _write(given.page, given.out, suites, given.times):
                print(f"written: {path}")
        return good

    return exit_code("closed_loop", work)


def exit_code(name: str, work: Callable[[], bool]) -> int:
    """Does the work of a command that can be gone on with, and says how it ended.

    Args:
      name: of the command, in front of errors.
      work: returns False if a scenario failed.
    """
    try:
        return 0 if work() else EXIT_FAILED
    except KeyboardInterrupt:
        print("interrupted; the same command goes on where it stopped", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (ValueError, OSError, ImportError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_ERROR


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m spdm_experiments.closed_loop",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    steps = ("run", "precision", "page")
    parser.add_argument("step", nargs="?", choices=steps, default="run", help="what to do")
    parser.add_argument("--out", type=Path, default=Path("out/closed_loop"), help="run folders")
    parser.add_argument("--times", type=Path, help="another --out, whose run times the page shows")
    options = parse_page_options(parser, argv)
    if options.times and not options.page:
        parser.error("--times needs --page, the Markdown file that shows them")
    return options


def parse_page_options(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None
) -> argparse.Namespace:
    """Adds what every command that drives suites and writes a page has, parses, and checks it.

    Args:
      parser: has `step`, one of whose choices is "page".
      argv: arguments without the program's name; those of the process by default.
    """
    parser.add_argument("--page", type=Path, help="Markdown page to write, with figures beside it")
    parser.add_argument("--limit", type=int, help="take so many scenarios of each type only")
    parser.add_argument("--chunk", type=int, default=CHUNK, help="scenarios between two stops")
    parser.add_argument("--device", choices=("auto", "cpu", "gpu"), default="auto")
    options = parser.parse_args(argv)
    for name in ("limit", "chunk"):
        value = getattr(options, name)
        if value is not None and value < 1:
            parser.error(f"--{name} is {value}; it must be at least 1")
    if options.page and options.page.suffix != ".md":
        parser.error(f"--page {options.page} must end in .md")
    if options.step == "page" and not options.page:
        parser.error("page needs --page, the Markdown file to write")
    return options


def note_machine(out: Path, command: str) -> None:
    """Keeps, in `about.json`, what run folders do not say of the machines that worked on them.

    Args:
      out: folder of all runs.
      command: what the page says they were made by.
    """
    path = out / ABOUT
    before = json.loads(path.read_text(encoding="utf-8"))["machines"] if path.is_file() else []
    here = f"{processor()}, {usable_cores()} core(s), Python {platform.python_version()}"
    content = {"command": command, "machines": list(dict.fromkeys([*before, here]))}
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def _write(page: Path, out: Path, suites: Sequence[Suite], times: Path | None) -> list[Path]:
    """Writes the page of the runs that are there.

    Raises:
      ValueError: there is none, or the run times are not those of the same planners.
    """
    if not (runs := _load(out, suites)) or not (out / ABOUT).is_file():
        raise ValueError(f"{out}: no rows yet; run first: python -m spdm_experiments.closed_loop")
    read = lambda name: json.loads((out / name).read_text(encoding="utf-8"))
    precision = read(PRECISION) if (out / PRECISION).is_file() else None
    timed = None if times is None else _load(times, suites)
    return write_page(page, runs, read(ABOUT), precision, timed=timed)


def _load(out: Path, suites: Sequence[Suite]) -> list[Run]:
    """Reads the runs of the suites that have rows."""
    folders = [out / suite.name for suite in suites]
    return [load_run(folder) for folder in folders if any(folder.glob("rows/*"))]


if __name__ == "__main__":
    sys.exit(main())
