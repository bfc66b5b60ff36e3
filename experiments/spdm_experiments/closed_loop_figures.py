"""Figures of the closed-loop page: score and run time over N_p, a difference type by type."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spdm_experiments.closed_loop_data import Panel, curve, differences
from spdm_experiments.closed_loop_lineup import COMPARED, PUBLISHED
from spdm_experiments.figures import STYLE, new_figure, save, settle, small_print
from spdm_experiments.report_page import LINE_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS: Final = ("svg", "png")
LOOKS: Final[dict[str, dict[str, Any]]] = {
    "PDM-Closed": {"color": LINE_COLORS[0], "marker": "o"},
    "SPDM": {"color": LINE_COLORS[1], "marker": "s"},
}
"""Planners with curves over N_p."""
_HOLLOW = {"PDM-Closed": 7.0, "SPDM": 4.0}
"""Sizes of marks for published scores: where two planners have the same, both are to be seen."""
_WIDTH, _HEIGHT = 7.2, 2.5  # inches


def write_figures(panels: Sequence[Panel], page: Path, note: str, seed: int = 0) -> list[Path]:
    """Writes every figure as SVG and PNG beside the page; equal rows give equal bytes.

    Args:
      panels: suites and traffic.
      page: the Markdown file; names of figures start with its own.
      note: below each figure, where its numbers come from.
      seed: of the bootstrap.

    Returns:
      The files.

    Raises:
      ImportError: matplotlib is not installed (`pip install "spdm-jax[plot]"`).
    """
    import matplotlib

    draw: dict[str, Callable[[], Figure]] = {
        "score": lambda: plot_score(panels),
        "difference": lambda: plot_difference(panels, seed),
        "runtime": lambda: plot_runtime(panels),
    }
    written = []
    with matplotlib.rc_context(STYLE):
        for name, make in draw.items():
            figure = make()
            small_print(figure, [note])
            settle(figure)
            for form in FORMATS:
                written.append(save(figure, page.with_name(f"{page.stem}_{name}.{form}")))
    return written


def plot_score(panels: Sequence[Panel]) -> Figure:
    """Draws mean scores over N_p with 95 % intervals, published scores as hollow marks."""
    figure, axes = _columns(panels)
    for axis, panel in zip(axes, panels, strict=True):
        for planner, look in LOOKS.items():
            if not (points := curve(panel, planner)):
                continue
            counts, names = zip(*points, strict=True)
            summaries = [panel.summaries[name] for name in names]
            mean = [100 * summary.means["total"] for summary in summaries]
            low, high = 100 * np.array([s.intervals["total"] for s in summaries]).T
            axis.fill_between(counts, low, high, color=look["color"], alpha=0.15, lw=0)
            axis.plot(counts, mean, label=planner, **look)
            quoted = [(n, PUBLISHED.get(name, {}).get(panel.benchmark or "")) for n, name in points]
            known = [(count, float(score[0])) for count, score in quoted if score is not None]
            if known:
                hollow = {**look, "ls": "none", "mfc": "none", "ms": _HOLLOW[planner]}
                label = f"{planner}, published"
                axis.plot(*zip(*known, strict=True), label=label, **hollow)
        below = "" if panel.benchmark is None else f"\nhollow: {panel.benchmark}"
        axis.set_title(panel.title + below, pad=3)
    axes[0].set_ylabel("Mean score")
    _legend_of(figure, axes)
    return figure


def plot_runtime(panels: Sequence[Panel]) -> Figure:
    """Draws the run time of a drive over its steps, over N_p."""
    figure, axes = _columns(panels)
    for axis, panel in zip(axes, panels, strict=True):
        for planner, look in LOOKS.items():
            if points := curve(panel, planner):
                counts, names = zip(*points, strict=True)
                axis.plot(counts, [panel.step_ms[name] for name in names], label=planner, **look)
        axis.set_title(panel.title, pad=3)
    # All share one scale: set sooner, it would end with the first panel's times.
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("Time per step (ms)")
    _legend_of(figure, axes)
    return figure


def plot_difference(panels: Sequence[Panel], seed: int = 0) -> Figure:
    """Draws the mean difference of two rows for each type of scenario, with 95 % intervals."""
    suites = list(dict.fromkeys(panel.suite for panel in panels))
    found = {id(panel): differences(panel, *COMPARED, seed) for panel in panels}
    kinds = {
        suite: sorted({d.kind for p in panels if p.suite == suite for d in found[id(p)]})
        for suite in suites
    }
    looks = {
        id(panel): {"color": color, "marker": marker}
        for panel, color, marker in zip(panels, LINE_COLORS, cycle("os^"), strict=False)
    }
    longest = max((len(names) for names in kinds.values()), default=0)
    figure = new_figure(_WIDTH, 0.9 + 0.19 * max(longest, 6))
    axes = figure.subplots(1, len(suites), squeeze=False)[0]
    for axis, suite in zip(axes, suites, strict=True):
        mine = [panel for panel in panels if panel.suite == suite]
        for number, panel in enumerate(mine):
            shift = 0.3 * (number - 0.5 * (len(mine) - 1))
            rows = [(kinds[suite].index(d.kind) + shift, d) for d in found[id(panel)]]
            look = looks[id(panel)]
            y, mean = [place for place, _ in rows], [d.mean for _, d in rows]
            low, high = [d.low for _, d in rows], [d.high for _, d in rows]
            axis.hlines(y, low, high, color=look["color"], lw=1.0)
            axis.plot(mean, y, label=panel.title, ls="none", ms=3.5, **look)
        axis.axvline(0, color="#6b7480", lw=0.7)
        axis.set_yticks(range(len(kinds[suite])), [name.replace("_", " ") for name in kinds[suite]])
        axis.set_ylim(len(kinds[suite]) - 0.4, -0.6)
        axis.grid(axis="x")
        axis.set_xlabel("Difference in score")
    _legend_of(figure, axes, title=f"{COMPARED[0]} minus {COMPARED[1]}")
    return figure


def _columns(panels: Sequence[Panel]) -> tuple[Figure, list[Axes]]:
    """Returns a figure with one panel beside the other, all with the same scale over N_p."""
    figure = new_figure(_WIDTH, _HEIGHT)
    axes = list(figure.subplots(1, len(panels), sharey=True, squeeze=False)[0])
    counts = sorted({n for p in panels for planner in LOOKS for n, _ in curve(p, planner)})
    for axis in axes:
        axis.set_xlabel("Number of proposals $N_p$")
        axis.set_xticks([n for n in counts if n >= 15 or n == min(counts)])
    return figure, axes


def _legend_of(figure: Figure, axes: Sequence[Axes], title: str | None = None) -> None:
    found: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    columns = max(1, len(found))
    figure.legend(found.values(), found, loc="outside upper center", ncols=columns, title=title)
