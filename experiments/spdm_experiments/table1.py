"""`python -m spdm_experiments.table1`: planners beside learned, perfect and no predictions.

`run` drives PDM-Closed, DTPP, GameFormer, GameFormer + DIPP and DIPP through the built-in suites,
as `spdm simulate` does, and prints their scores beside the paper's; `page` only writes the page.
Each column has a run folder below --out: the same command goes on where it was stopped. Planners
driven apart (--planner) come together on a page: --also names the other --out.
"""

import argparse
import io
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from spdm_experiments.closed_loop import (
    ABOUT,
    drive,
    exit_code,
    note_machine,
    parse_page_options,
)
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import load_run
from spdm_experiments.runtime import configure_jax
from spdm_experiments.simulate_points import weights_file, weights_folder
from spdm_experiments.table1_data import cells_of, frame_of
from spdm_experiments.table1_lineup import COLUMNS, PLANNERS, Planner, learned, suite_of
from spdm_experiments.table1_page import score_table, write_page
from spdm_jax.io.scenario_file import write_atomically

WEIGHTS, TABLE = "weights.json", "table1.parquet"


def main(argv: Sequence[str] | None = None, scenes: Path | None = None) -> int:
    """Runs the command and returns the exit code.

    Args:
      argv: arguments without the program's name; those of the process by default.
      scenes: scenarios to drive through instead of the built-in suites.
    """
    given = _options(argv)
    options = Simulate(scenes=Path(), out=given.out, chunk=given.chunk, device=given.device)

    def work() -> bool:
        good = True
        if given.step == "run":
            configure_jax(options)
            weights = given.weights and weights_folder(given.weights)
            _check_weights(weights, given.planner)
            # All files are read before the first drive.
            _note_weights(given.out, weights, given.planner)
            note_machine(given.out, _command(given))
            for column in (column for column in COLUMNS if column.key in given.column):
                suite = suite_of(column, given.planner, weights, scenes)
                good &= drive(suite, replace(options, out=given.out / suite.name), given.limit)
        for path in _write(given.page, [given.out, *given.also]):
            print(f"written: {path}")
        return good

    return exit_code("table1", work)


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m spdm_experiments.table1",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("step", nargs="?", choices=("run", "page"), default="run", help="what to do")
    add("--weights", type=Path, help="folder with PLANNER.safetensors or PLANNER/, or small")
    add("--out", type=Path, default=Path("out/table1"), help="run folders and table1.parquet")
    add("--also", type=Path, nargs="+", default=[], help="more --out, for the table and the page")
    add("--planner", choices=PLANNERS, nargs="+", default=PLANNERS, help="these rows only")
    keys = tuple(column.key for column in COLUMNS)
    add("--column", choices=keys, nargs="+", default=keys, help="these columns only")
    return parse_page_options(parser, argv)


def _command(given: argparse.Namespace) -> str:
    parts = ["python -m spdm_experiments.table1 run"]
    if given.weights:
        parts.append(f"--weights {given.weights}")
    if tuple(given.planner) != PLANNERS:
        parts.append(f"--planner {' '.join(given.planner)}")
    if len(given.column) < len(COLUMNS):
        parts.append(f"--column {' '.join(given.column)}")
    if given.limit is not None:
        parts.append(f"--limit {given.limit}")
    return " ".join(parts)


def _check_weights(weights: Path | None, planners: Sequence[Planner]) -> None:
    names = learned(planners)
    if names and weights is None:
        raise ValueError(
            f"--weights is missing: a folder with {names[0]}.safetensors, ..., or small"
        )
    if names and weights is not None and not weights.is_dir():
        raise ValueError(f"--weights {weights}: no such folder; it holds PLANNER.safetensors files")


def _note_weights(out: Path, folder: Path | None, planners: Sequence[Planner]) -> None:
    """Keeps what the headers of the weights say.

    Raises:
      ValueError: a file is missing, damaged, or of another model.
    """
    from spdm_models.drivers import read_weights

    facts: dict[str, Any] = {}
    for name in learned(planners):
        assert folder is not None
        weights = read_weights(weights_file(folder, name), name)
        facts[name] = {
            "file": str(weights.path.relative_to(folder)),
            "digest": weights.digest,
            "model": weights.model,
            "sizes": weights.sizes,
            "training": dict(weights.training),
        }
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / WEIGHTS, (json.dumps(facts, indent=1) + "\n").encode())


def _write(page: Path | None, outs: Sequence[Path]) -> list[Path]:
    """Writes table and page of the runs that are there, and prints the table.

    Args:
      page: Markdown file, if wanted.
      outs: folders of runs; the table is written to the first.

    Raises:
      ValueError: a folder has none.
    """
    runs, notes = [], []
    for out in outs:
        folders = [out / column.folder for column in COLUMNS]
        there = [folder for folder in folders if any(folder.glob("rows/*.parquet"))]
        if not there or not (out / ABOUT).is_file():
            raise ValueError(
                f"{out}: no rows yet; run first: python -m spdm_experiments.table1 run"
            )
        runs += [load_run(folder) for folder in there]
        notes.append([json.loads((out / name).read_bytes()) for name in (ABOUT, WEIGHTS)])
    cells = cells_of(runs)
    print(score_table(cells))
    buffer = io.BytesIO()
    frame_of(cells).write_parquet(buffer)
    write_atomically(outs[0] / TABLE, buffer.getvalue())
    written = [outs[0] / TABLE]
    if page is not None:
        about = {
            "commands": [about["command"] for about, _ in notes],
            "machines": list(dict.fromkeys(m for about, _ in notes for m in about["machines"])),
            "weights": {name: facts for _, weights in notes for name, facts in weights.items()},
        }
        written += write_page(page, cells, runs, about)
    return written


if __name__ == "__main__":
    sys.exit(main())
