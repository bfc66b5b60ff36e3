"""Figures for papers from the rows of a sweep: score and runtime over N_p, sub-scores.

One column wide, text of 8 points and less, fonts inside the files. The small print below each
figure says what the numbers come from.
"""

from __future__ import annotations

import functools
import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spdm_experiments import report_data as numbers
from spdm_experiments import report_grid as grid
from spdm_experiments.report_data import PointSummary, Run
from spdm_experiments.report_page import (
    LINE_COLORS,
    STAGES,
    axis_title,
    run_names,
    stage_table,
)
from spdm_experiments.report_terms import TERMS
from spdm_jax.io.scenario_file import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS: Final = ("svg", "pdf", "png")
_COLUMN = 3.4  # inches, one column of a two-column paper
_DPI = 300
_LETTERS = 32
"""Letters of the small print per inch."""
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
STYLE: Final[dict[Any, Any]] = {
    "font.size": 8.0,
    "font.family": ["DejaVu Sans"],  # comes with matplotlib: the same on every machine
    "axes.linewidth": 0.6,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": "#e1e5ea",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "pdf.fonttype": 42,  # real fonts, which editors and publishers accept
    "svg.fonttype": "path",
    "svg.hashsalt": "spdm",
}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Gives a function's figure the look above, whatever the caller's settings are."""

    @functools.wraps(draw)
    def drawn(*args: Any, **settings: Any) -> Figure:
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return draw(*args, **settings)

    return drawn


@dataclass(frozen=True)
class Curve:
    """One line of a figure.

    Attributes:
      name: for the legend.
      look: colour, marker and dashes.
      values: the parameter.
      points: what was found there.
    """

    name: str
    look: dict[str, Any]
    values: list[float]
    points: list[PointSummary]


def write_figures(runs: Sequence[Run], folder: Path, *, seed: int = 0) -> list[Path]:
    """Writes every figure as SVG, PDF and PNG.

    Args:
      runs: one or two; the second one's lines are dashed.
      folder: made if absent.
      seed: of the bootstrap.

    Returns:
      The files.

    Raises:
      ImportError: matplotlib is not installed (`pip install "spdm-jax[plot]"`).
    """
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    axis = grid.axes(runs[0].points)[0]
    short = "np" if axis == "num_proposals" else axis.replace(".", "_")
    timed = any(len(stage_table(run)) for run in runs)  # those are always over N_p
    found = curves(runs, axis, seed)
    written = []
    with matplotlib.rc_context(STYLE):
        figures = {
            f"score_over_{short}": plot_score(found, axis),
            f"runtime_over_{'np' if timed else short}": plot_runtime(runs, found, axis),
            "subscores": plot_subscores(found, axis, numbers.common_terms(runs).titles),
        }
        for name, figure in figures.items():
            _footer(figure, runs)
            settle(figure)
            for form in FORMATS:
                written.append(save(figure, folder / f"{name}.{form}"))
    return written


def curves(runs: Sequence[Run], axis: str, seed: int = 0) -> list[Curve]:
    """Returns the lines of all runs along a parameter.

    Args:
      runs: one or two.
      axis: parameter, one of `report_data.axes`.
      seed: of the bootstrap.
    """
    found: list[Curve] = []
    order: dict[str, int] = {}
    for number, run in enumerate(runs):
        if not all(axis in point for point in run.points):
            continue
        summaries = numbers.summarise(run, seed)
        for line in grid.lines(run.points, axis):
            at = order.setdefault(line.name, len(order))
            look = {
                "color": LINE_COLORS[at % len(LINE_COLORS)],
                "marker": _MARKERS[at % len(_MARKERS)],
                "linestyle": "--" if number else "-",
                "markerfacecolor": "white" if number else None,
            }
            name = line.name if len(runs) == 1 else f"{line.name}, {run_names(runs)[number]}"
            points = [summaries[point] for point in line.points]
            found.append(Curve(name, look, line.values, points))
    return found


@styled
def plot_score(found: Sequence[Curve], axis: str = "num_proposals") -> Figure:
    """Draws the mean total score with its 95 % intervals.

    Args:
      found: from `curves`.
      axis: the parameter below.
    """
    figure = new_figure(_COLUMN, 2.5)
    axes = figure.subplots()
    _draw_curves(axes, found, "total")
    axes.set_xlabel(_math(axis_title(axis)))
    axes.set_ylabel("Mean total score")
    _legend(figure, axes, len(found))
    return figure


@styled
def plot_subscores(
    found: Sequence[Curve],
    axis: str = "num_proposals",
    titles: Mapping[str, str] = TERMS,
) -> Figure:
    """Draws each sub-score in a panel of its own; see `plot_score`.

    Args:
      found: from `curves`.
      axis: the parameter below.
      titles: scores of the run, see `Run.terms`; the first, their sum, has no panel.
    """
    _, *terms = titles
    columns = 3 if len(terms) <= 6 else 4
    rows = -(-len(terms) // columns)
    figure = new_figure(2.1 * _COLUMN, 1.85 * rows)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for panel, term in zip(panels.flat, terms, strict=False):
        _draw_curves(panel, found, term)
        panel.set_title(titles[term], pad=3)
    for panel in panels.flat[len(terms) :]:
        panel.set_visible(False)
    panels[-1, 1].set_xlabel(_math(axis_title(axis)))
    _legend(figure, panels.flat[0], len(found), outside=True)
    return figure


@styled
def plot_runtime(
    runs: Sequence[Run], found: Sequence[Curve], axis: str = "num_proposals"
) -> Figure:
    """Draws the time of each stage over N_p; without times of stages, that per scenario.

    Args:
      runs: one or two.
      found: from `curves`, used where no run has times of stages.
      axis: their parameter.
    """
    from matplotlib.ticker import MaxNLocator

    tables = [
        (run, name, table.filter(table["planner"] == planner))
        for run, name in zip(runs, run_names(runs), strict=True)
        if len(table := stage_table(run))
        for planner in table["planner"].unique(maintain_order=True)
    ]
    if not tables:
        figure = new_figure(_COLUMN, 2.5)
        axes = figure.subplots()
        for curve in found:
            axes.plot(curve.values, [point.ms for point in curve.points], **_known(curve.look))
        axes.set_ylim(bottom=0)
        axes.set_xlabel(_math(axis_title(axis)))
        axes.set_ylabel("Time per scenario (ms)")
        _places(axes, found)
        _legend(figure, axes, len(found), names=[curve.name for curve in found])
        return figure
    figure = new_figure(_COLUMN * max(1.0, 0.62 * len(tables)), 2.6)
    shares = {"width_ratios": [len(table) + 0.5 for *_, table in tables]}  # bars of one width
    panels = figure.subplots(1, len(tables), sharey=True, squeeze=False, gridspec_kw=shares)[0]
    for axes, (_, name, table) in zip(panels, tables, strict=True):
        places, below = np.arange(len(table)), np.zeros(len(table))
        for stage, (title, color) in STAGES.items():
            times = table[stage].fill_null(0).to_numpy()
            axes.bar(places, times, 0.68, below, color=color, label=title, ec="white", lw=0.4)
            below = below + times
        total = table["total"].to_numpy()
        axes.plot(places, total, "D", color="#1b1f24", ms=3.2, label="Whole step")
        axes.set_xlim(-0.75, len(table) - 0.25)
        axes.set_xticks(places, [str(count) for count in table["num_proposals"]])
        planner = table["planner"][0]
        axes.set_title(planner if len(runs) == 1 else f"{planner}, {name}", pad=3)
        axes.set_xlabel(_math(axis_title("num_proposals")) if len(tables) == 1 else "$N_p$")
    panels[0].set_ylabel("Time per step (ms)")
    panels[0].yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    _legend(figure, panels[0], 4, outside=True)
    return figure


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty figure, inches."""
    # A figure of its own instead of pyplot: no window system, nothing left open.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw_curves(axes: Axes, found: Sequence[Curve], term: str) -> None:
    # Curves over one value only would lie on each other.
    alone = len({value for curve in found for value in curve.values}) == 1
    for number, curve in enumerate(found):
        shift = 0.02 * (number - 0.5 * (len(found) - 1)) if alone else 0.0
        x = np.array(curve.values) * (1 + shift) + (shift if alone else 0.0)
        mean = np.array([point.means[term] for point in curve.points])
        low, high = np.array([point.intervals[term] for point in curve.points]).T
        color = curve.look["color"]
        axes.fill_between(x, low, high, color=color, alpha=0.15, lw=0)
        axes.vlines(x, low, high, color=color, alpha=0.6, lw=0.7)
        axes.plot(x, mean, label=curve.name, **_known(curve.look))
    _places(axes, found)


def _known(look: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in look.items() if value is not None}


def _places(axes: Axes, found: Sequence[Curve]) -> None:
    """Puts a tick at every value, where they are few and not too close."""
    values = sorted({value for curve in found for value in curve.values})
    if not 1 < len(values) <= 10:
        return
    room = (values[-1] - values[0]) / 22
    kept = [values[0]]
    for value in values[1:]:
        if value - kept[-1] >= room:
            kept.append(value)
    axes.set_xticks(kept, [f"{value:g}" for value in kept])


def _legend(
    figure: Figure,
    axes: Axes,
    count: int,
    *,
    outside: bool = False,
    names: Sequence[str] | None = None,
) -> None:
    from matplotlib.lines import Line2D

    handles, labels = axes.get_legend_handles_labels()
    if names is not None:
        handles, labels = list(axes.get_lines()), list(names)
    # Beside bars the marker comes last, as it lies on top of them.
    order = sorted(range(len(handles)), key=lambda i: isinstance(handles[i], Line2D))
    handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    longest = max(map(len, labels), default=0)
    if outside or count > 4 or longest > 24:
        each = 0.55 + 0.058 * longest  # inches that an entry takes
        columns = max(1, min(count, 4, int(figure.get_figwidth() / each)))
        # Entries beyond the first line get room of their own.
        figure.set_figheight(figure.get_figheight() + 0.14 * (-(-count // columns) - 1))
        figure.legend(handles, labels, loc="outside upper center", ncols=columns)
    else:
        axes.legend(handles, labels, loc="best")


def _math(text: str) -> str:
    return text.replace("N_p", "$N_p$")


def _footer(figure: Figure, runs: Sequence[Run]) -> None:
    """Says below the figure where its numbers come from."""
    texts = []
    for run, name in zip(runs, run_names(runs), strict=True):
        about = run.about
        most = max(len(run.usable(point)) for point in range(len(run.points)))
        words = [
            str(about.get("suite")),
            f"{most} scenarios",
            f"seed {about.get('seed')}",
            f"commit {about.get('commit') or 'unknown'}",
            str(about.get("device")),
        ]
        texts.append(("" if len(runs) == 1 else f"{name}: ") + ", ".join(words))
    small_print(figure, texts)


def small_print(figure: Figure, texts: Sequence[str]) -> None:
    """Adds lines below a figure, wrapped to its width."""
    width = int(_LETTERS * figure.get_figwidth())
    lines = [line for text in texts for line in textwrap.wrap(text, width)]
    text = "\n".join(lines).replace("$", r"\$")
    # The room below is kept free by the layout, so that nothing is drawn over.
    room = 0.085 * len(lines) + 0.03
    height = figure.get_figheight() + room
    figure.set_figheight(height)
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.set(rect=(0, room / height, 1, 1 - room / height))  # pyright: ignore[reportCallIssue]
    figure.text(0.01, 0.02 / height, text, fontsize=4.6, color="#6b7480", va="bottom", ha="left")


def settle(figure: Figure) -> None:
    """Lays a figure out once, so that it is the same in every format and at every time.

    The layout's solver does not repeat its last bits, and SVG names are made from all of them.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        left, bottom, width, height = (round(v, 6) for v in axes.get_position().bounds)
        axes.set_position((left, bottom, width, height))


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure in the format that the name ends in; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    # No date inside: the same rows give the same file.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}[path.suffix[1:]]
    figure.savefig(buffer, format=path.suffix[1:], dpi=_DPI, metadata=metadata)
    write_atomically(path, buffer.getvalue())
    return path
