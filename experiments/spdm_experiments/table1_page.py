"""Writes the page of the table of predictions: scores beside the paper's, weights, a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spdm_experiments.figures import STYLE, new_figure, save, settle, small_print
from spdm_experiments.markdown import kept_part, markdown_table
from spdm_experiments.report_data import RESAMPLES, Run
from spdm_experiments.report_page import LINE_COLORS
from spdm_experiments.simulate_points import NAMES
from spdm_experiments.simulate_terms import CLOSED
from spdm_experiments.table1_data import Cell, pairs_of
from spdm_experiments.table1_lineup import COLUMNS, KINDS, PLANNERS, SOURCE, TITLES, published

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT: Final = "## What the runs show"
"""Written by people; a new page keeps it."""
FORMATS: Final = ("svg", "png")
_MARKERS: Final = dict(zip(CLOSED, ("o", "s", "^", "D", "v", "P", "X", "*"), strict=True))


def write_page(
    page: Path, cells: Sequence[Cell], runs: Sequence[Run], about: Mapping[str, Any]
) -> list[Path]:
    """Writes the page and its figure.

    Args:
      page: Markdown file.
      cells: of the table.
      runs: one per column, finished or not.
      about: `commands`, `machines` and `weights`, the facts of each planner's file.

    Returns:
      The files written.
    """
    kept = kept_part(page, KEPT)
    page.parent.mkdir(parents=True, exist_ok=True)
    figures = write_figure(page, cells, runs)
    name = f"{page.stem}_subscores"
    parts = [
        "# Learned, perfect and no predictions\n",
        _about(runs, about),
        "## Weights\n",
        _weights(about["weights"]),
        "## Scores\n",
        "Mean score from 0 to 100, 95 % bootstrap interval in brackets "
        f"({RESAMPLES} resamples over scenarios). Published scores are of other scenarios and of "
        "networks trained on nuPlan: only order and trend can be compared.\n",
        score_table(cells),
        f"Published: {SOURCE}.\n",
        "## Metrics beside learned and perfect predictions\n",
        "Above the diagonal a metric is better with learned predictions, below it with perfect "
        "ones. Reactive traffic.\n",
        f"![Metrics with learned against perfect predictions]({name}.svg)\n\n[PNG]({name}.png)\n",
        kept,
    ]
    page.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
    return [page, *figures]


def score_table(cells: Sequence[Cell]) -> str:
    """Returns the table in Markdown: our scores beside the published ones."""
    found = {(cell.planner, cell.kind, cell.column): cell for cell in cells}
    head = ["planner", "predictions"]
    for column in COLUMNS:
        head += [column.title, f"*{column.benchmark}*"]
    body = []
    for planner in PLANNERS:
        for kind in KINDS:
            row = [NAMES[planner], TITLES[kind]]
            for column in COLUMNS:
                quoted = published(planner, kind, column)
                row.append(_score(found.get((planner, kind, column))))
                row.append("*N/A*" if quoted is None else f"*{quoted:.2f}*")
            body.append(row)
    return markdown_table(head, body)


def _score(cell: Cell | None) -> str:
    if cell is None:
        return ""
    failed = f" ({cell.failed} failed)" if cell.failed else ""
    if not cell.scenarios:
        return failed.strip()
    around = "" if np.isnan(cell.low) else f" ({cell.low:.1f} – {cell.high:.1f})"
    return f"{cell.mean:.2f}{around}{failed}"


def _about(runs: Sequence[Run], about: Mapping[str, Any]) -> str:
    def done(run: Run) -> str:
        whole = run.about["num_scenarios"]
        return str(whole) if not run.missing else f"{whole - run.missing} of {whole}: goes on"

    keys = ("precision", "commit", "device", "created")
    head = ["", *(str(run.folder.name) for run in runs)]
    body = [["scenarios", *(done(run) for run in runs)]]
    body += [[key, *(str(run.about.get(key) or "unknown") for run in runs)] for key in keys]
    commands = " and ".join(f"`{command}`" for command in about["commands"])
    return (
        markdown_table(head, body)
        + f"\nWritten by {commands}. Machine: {'; '.join(about['machines'])}. Suites, "
        "traffic and metrics are those of [spdm simulate](simulate.md); how each planner is made "
        "and what takes the place of its predictions is said in [Learned models](models.md).\n"
    )


def _weights(weights: Mapping[str, Mapping[str, Any]]) -> str:
    """What is known of each planner's weights, from the headers of their files."""
    if not weights:
        return "No learned planner was driven.\n"
    head = ["planner", "file", "network", "trained"]
    body = []
    for name, facts in weights.items():
        training = {key: value for key, value in facts["training"].items() if key != "cost_weights"}
        said = ", ".join(f"{key} {_plain(value)}" for key, value in training.items())
        body.append(
            [
                NAMES[name],
                f"`{facts['file']}` ({facts['digest']})",
                f"{facts['model']}, {facts['sizes']}",
                said or "nothing is known: the file's header says nothing of a training",
            ]
        )
    text = (
        "None of these networks has seen nuPlan unless its row says so. A network that nobody has "
        "trained, or that was trained for minutes on generated scenarios, says nothing of what the "
        "method can do.\n"
    )
    return markdown_table(head, body) + "\n" + text


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{key} {_plain(one)}" for key, one in value.items())
    if isinstance(value, list):
        return " ".join(_plain(one) for one in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_figure(page: Path, cells: Sequence[Cell], runs: Sequence[Run]) -> list[Path]:
    """Writes the figure as SVG and PNG beside the page.

    Raises:
      ImportError: matplotlib is not installed (`pip install "spdm-jax[plot]"`).
    """
    import matplotlib

    commits = ", ".join(dict.fromkeys(str(run.about.get("commit") or "unknown") for run in runs))
    counts = ", ".join(
        dict.fromkeys(
            f"{run.folder.name} ({run.about['num_scenarios'] - run.missing} scenarios)"
            for run in runs
        )
    )
    with matplotlib.rc_context(STYLE):
        figure = plot_pairs(cells)
        small_print(figure, [counts, f"commit {commits}"])
        settle(figure)
        return [save(figure, page.with_name(f"{page.stem}_subscores.{form}")) for form in FORMATS]


def plot_pairs(cells: Sequence[Cell]) -> Figure:
    """Draws each closed-loop metric of each learned planner: learned over perfect predictions.

    A column that has no such pair is left out.
    """
    columns = [c for c in COLUMNS if c.traffic == "reactive"]
    columns = [c for c in columns if pairs_of(cells, c)] or columns
    figure = new_figure(7.2, 3.9)
    axes = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    planners = [planner for planner in PLANNERS if planner != "pdm-closed"]
    colors = dict(zip(planners, LINE_COLORS, strict=False))
    for axis, column in zip(axes, columns, strict=True):
        axis.plot([0, 100], [0, 100], color="#6b7480", lw=0.7, zorder=0)
        for pair in pairs_of(cells, column):
            axis.plot(
                pair.perfect,
                pair.learned,
                ls="none",
                marker=_MARKERS[pair.metric],
                ms=5,
                mfc="none",
                color=colors[pair.planner],
                clip_on=False,
            )
        axis.set_title(column.title, pad=3)
        axis.set_xlabel("Perfect predictions")
        axis.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
        axis.grid(True, axis="both")
    axes[0].set_ylabel("Learned predictions")
    draw = lambda axis, **look: axis.plot([], [], ls="none", **look)[0]
    kinds = [draw(axes[0], marker="o", color=colors[name]) for name in planners]
    marks = [draw(axes[0], marker=m, color="#3c4450", mfc="none") for m in _MARKERS.values()]
    labels = [NAMES[name] for name in planners] + [CLOSED[name][0] for name in _MARKERS]
    figure.legend([*kinds, *marks], labels, loc="outside upper center", ncols=4)
    return figure
