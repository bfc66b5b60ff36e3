"""Writes the page of closed-loop results: tables, figures, and what people add."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.closed_loop_data import (
    TRAFFIC,
    Panel,
    panels_of,
    rows_of,
    scenarios_by_type,
    scores_by_type,
)
from spdm_experiments.closed_loop_figures import write_figures
from spdm_experiments.closed_loop_lineup import COMPARED, PUBLISHED, SOURCES
from spdm_experiments.markdown import kept_part, markdown_table
from spdm_experiments.report_data import RESAMPLES, PointSummary, Run
from spdm_experiments.simulate_terms import CLOSED

KEPT = "## What the runs show"
"""Written by people; a new page keeps it."""


def write_page(
    page: Path,
    runs: Sequence[Run],
    about: Mapping[str, Any],
    precision: Mapping[str, Any] | None = None,
    seed: int = 0,
    timed: Sequence[Run] | None = None,
) -> list[Path]:
    """Writes the page and its figures.

    Args:
      page: Markdown file.
      runs: one per suite, finished or not.
      about: `command`, and `machines` that worked on the runs.
      precision: what `closed_loop_precision.compare` found, or None.
      seed: of the bootstrap.
      timed: runs whose run times are shown, see `panels_of`.

    Returns:
      The files written.

    Raises:
      ValueError: `timed` does not go with `runs`.
    """
    kept = kept_part(page, KEPT)
    panels = panels_of(runs, seed, timed)
    page.parent.mkdir(parents=True, exist_ok=True)
    figures = write_figures(panels, page, _origin(runs, about), seed)
    parts = [
        "# Closed loop\n",
        _about(runs, about, seed),
        "## Scores\n",
        _scores(panels),
        _picture(page, "score", "Score over the number of proposals"),
        *_types(panels),
        f"## {COMPARED[0]} against {COMPARED[1]}\n\n"
        "Mean difference over the scenarios of a type, each scenario driven by both; lines are "
        "95 % bootstrap intervals.\n",
        _picture(page, "difference", f"{COMPARED[0]} minus {COMPARED[1]} by type"),
        "## What costs points\n",
        _metrics(panels),
        "## Run time per planning step\n",
        _runtime(panels, runs if timed is None else timed, about),
        _picture(page, "runtime", "Run time per step over the number of proposals"),
        *([] if precision is None else [_precision(precision)]),
        kept,
    ]
    page.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
    return [page, *figures]


def _picture(page: Path, name: str, title: str) -> str:
    file = f"{page.stem}_{name}"
    return f"![{title}]({file}.svg)\n\n[PNG]({file}.png)\n"


def _origin(runs: Sequence[Run], about: Mapping[str, Any]) -> str:
    suites = ", ".join(f"{run.about['suite']} ({_done(run)} scenarios)" for run in runs)
    commits = ", ".join(_every(runs, "commit"))
    devices = ", ".join(_every(runs, "device"))
    machines, dates = "; ".join(about["machines"]), ", ".join(_every(runs, "created"))
    return f"{suites}, commit {commits}, {devices}, {machines}, {dates}"


def _every(runs: Sequence[Run], key: str) -> list[str]:
    """Returns the values of an entry of run.json, each once."""
    return list(dict.fromkeys(str(run.about.get(key) or "unknown") for run in runs))


def _done(run: Run) -> int:
    return run.about["num_scenarios"] - run.missing


def _about(runs: Sequence[Run], about: Mapping[str, Any], seed: int) -> str:
    def scenarios(run: Run) -> str:
        whole = run.about["num_scenarios"]
        return str(whole) if not run.missing else f"{_done(run)} of {whole}: the run goes on"

    versions = lambda run: ", ".join(f"{k} {v}" for k, v in run.about["versions"].items())
    sessions = {run.folder: _sessions(run) for run in runs}
    facts = {
        "scenarios": scenarios,
        "precision": lambda run: str(run.about["precision"]),
        "commit": lambda run: _joined(sessions[run.folder], "commit") or "unknown",
        "device": lambda run: _joined(sessions[run.folder], "device") or str(run.about["device"]),
        "versions": versions,
        "begun": lambda run: str(run.about["created"]),
        "ended": lambda run: _last(sessions[run.folder]),
    }
    head = ["", *(str(run.about["suite"]) for run in runs)]
    body = [[name, *(fact(run) for run in runs)] for name, fact in facts.items()]
    text = (
        f"Written by `{about['command']}`. Machine: {'; '.join(about['machines'])}. Intervals are "
        f"95 % bootstrap intervals over scenarios, {RESAMPLES} resamples, seed {seed}. Suites, "
        "traffic, metrics and rows are those of [spdm simulate](simulate.md).\n"
    )
    return markdown_table(head, body) + "\n" + text


def _sessions(run: Run) -> list[dict[str, Any]]:
    """Returns what the processes that worked on a run say of themselves."""
    found: list[dict[str, Any]] = []
    for path in sorted(run.folder.glob("progress-*.json")):
        found += json.loads(path.read_text(encoding="utf-8"))["sessions"]
    return found


def _joined(sessions: Sequence[Mapping[str, Any]], key: str) -> str:
    return ", ".join(dict.fromkeys(str(session[key]) for session in sessions if session.get(key)))


def _last(sessions: Sequence[Mapping[str, Any]]) -> str:
    return max((str(session["ended"]) for session in sessions), default="")


def _scores(panels: Sequence[Panel]) -> str:
    head, used = ["planner"], set()
    for panel in panels:
        head.append(f"{panel.suite}, {TRAFFIC[panel.traffic]}")
        if panel.benchmark:
            head.append(f"*{panel.benchmark}, published*")
    body = []
    for name in rows_of(panels):
        cells = [name]
        for panel in panels:
            cells.append(_mean(panel.summaries.get(name)))
            if panel.benchmark:
                quoted = PUBLISHED.get(name, {}).get(panel.benchmark)
                cells.append("" if quoted is None else f"*{quoted[0]}* [{quoted[1]}]")
                used |= set() if quoted is None else {quoted[1]}
        body.append(cells)
    text = "Mean score from 0 to 100, interval in brackets."
    if shown := [panel.benchmark for panel in panels if panel.benchmark]:
        text += (
            f" {', '.join(shown)}: published scores of other scenarios; order and trend can be "
            "compared and nothing else."
        )
    sources = "".join(f"\n[{key}] {SOURCES[key]}.\n" for key in sorted(used))
    return text + "\n\n" + markdown_table(head, body) + sources


def _mean(summary: PointSummary | None) -> str:
    """A mean score and its interval, and how many scenarios have none."""
    if summary is None:
        return ""
    failed = f" ({summary.failed} failed)" if summary.failed else ""
    if not summary.scenarios:
        return failed.strip()
    low, high = summary.intervals["total"]
    around = "" if np.isnan(low) else f" ({100 * low:.1f} – {100 * high:.1f})"
    return f"{100 * summary.means['total']:.2f}{around}{failed}"


def _types(panels: Sequence[Panel]) -> list[str]:
    """Tables by type of scenario; those of suites with several kinds of traffic are folded."""
    parts = ["## Scores by type of scenario\n\nMean score from 0 to 100.\n"]
    suites = [panel.suite for panel in panels]
    for panel in sorted(panels, key=lambda panel: suites.count(panel.suite)):
        scores, counts = scores_by_type(panel), scenarios_by_type(panel)
        head = ["planner", *(f"{kind.replace('_', ' ')} ({counts[kind]})" for kind in scores)]
        body = [
            [name, *(f"{each[name]:.1f}" if name in each else "" for each in scores.values())]
            for name in panel.points
        ]
        table = markdown_table(head, body)
        if suites.count(panel.suite) > 1:
            parts.append(f"<details><summary>{panel.title}</summary>\n\n{table}\n</details>\n")
        else:
            parts.append(f"### {panel.title}\n\n{table}")
    return parts


def _metrics(panels: Sequence[Panel]) -> str:
    legend = ", ".join(f"{short} {title[0].lower()}{title[1:]}" for title, short in CLOSED.values())
    parts = [f"Mean of each metric, 100 where nothing was lost. {legend}.\n"]
    for panel in panels:
        head = ["planner", "score", *(short for _, short in CLOSED.values())]
        body = []
        for name, summary in panel.summaries.items():
            means = [summary.means[key] for key in ("total", *CLOSED)]
            body.append([name, *("" if np.isnan(mean) else f"{100 * mean:.1f}" for mean in means)])
        parts.append(f"### Metrics: {panel.title}\n\n{markdown_table(head, body)}")
    return "\n".join(parts)


def _runtime(panels: Sequence[Panel], timed: Sequence[Run], about: Mapping[str, Any]) -> str:
    devices = ", ".join(_every(timed, "device"))
    counts = {panel.suite: panel.timed for panel in panels}
    text = (
        "Wall time of a drive over its steps, ms: planner, traffic, vehicle and metrics, without "
        "compilation. All rows of a suite took turns on the same scenarios ("
        f"{', '.join(f'{count} of {suite}' for suite, count in counts.items())}), on "
        f"{devices}; {'; '.join(about['machines'])}; as many scenarios at a time as there are "
        "cores.\n"
    )
    body = [[name, *(_ms(panel.step_ms.get(name)) for panel in panels)] for name in rows_of(panels)]
    return text + "\n" + markdown_table(["planner", *(panel.title for panel in panels)], body)


def _ms(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else f"{value:.2f}"


def _precision(found: Mapping[str, Any]) -> str:
    """The section on float32 against float64."""
    within = found["within"]
    head = ["planner", "suite", "scenarios", f"differ by at most {within:g}", "share", "mean"]
    body = [
        [
            one["name"],
            f"{one['suite']}, {TRAFFIC[one['traffic']]}",
            str(one["scenarios"]),
            str(one["scenarios"] - len(one["others"])),
            f"{1 - len(one['others']) / one['scenarios']:.1%}" if one["scenarios"] else "",
            f"{one['mean_difference']:+.4f}" if one["scenarios"] else "",
        ]
        for one in found["rows"]
    ]
    parts = [
        "## Single and double precision\n",
        "Scores from 0 to 1 of the same drives in float32 and in float64 (commit "
        f"{found['commit']}); mean: float32 minus float64.\n",
        markdown_table(head, body),
    ]
    others = [(one, other) for one in found["rows"] for other in one["others"]]
    if others:
        head = ["scenario", "planner", "traffic", "float32", "float64"]
        head += ["first other choice", "what", "margin", "apart"]
        lines = [_other(one, other) for one, other in others]
        parts += [
            "The others, driven once more in both precisions with every choice recorded. First "
            "other choice: time of the first step at which the two choose differently; margin: how "
            "much the float64 scores set the proposal chosen there above the one that float32 "
            "chose; apart: distance of the two egos at that step. The recorded drives got the "
            f"scores of the table again in {sum(other['repeats'] for _, other in others)} of "
            f"{len(others)}.\n",
            markdown_table(head, lines),
        ]
    return "\n".join(parts)


def _other(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    cells = [other["token"], one["name"], TRAFFIC[one["traffic"]]]
    cells += [f"{other['f32']:.4f}", f"{other['f64']:.4f}"]
    first = other["first"]
    if first is None:
        return [*cells, "none", "the same choices at every step", "", ""]
    if first["brake"]:
        what, margin = f"brakes in {first['brake']} only", ""
    else:
        what = f"proposal {first['f64']} in float64, {first['f32']} in float32"
        margin = f"{first['margin']:.1e}"
    return [*cells, f"{first['time']:.1f} s", what, margin, f"{1e3 * first['apart']:.2g} mm"]
