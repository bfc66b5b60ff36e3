"""The report as one HTML file that needs nothing else: no server, no network, no library."""

import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any, Final

import numpy as np
import polars

from spdm_experiments import report_data as numbers
from spdm_experiments import report_grid as grid
from spdm_experiments.report_data import PointSummary, Run
from spdm_experiments.report_terms import Terms

LINE_COLORS: Final = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#aa4499",
    "#946200",
    "#332288",
    "#4d4d4d",
    "#117733",
)
"""Colours of lines that stay apart under colour-vision deficiencies and on white paper."""
STAGES: Final = {
    "proposals": ("Proposal generation", "#0072b2"),
    "tracking": ("Tracking", "#e69f00"),
    "scoring": ("Scoring", "#56b4e9"),
}
"""Stages of a planning step with title and colour, bottom to top."""

MAX_DOTS = 3000
"""Scenarios in the scatter; more are neither told apart nor drawn at once."""
_MAX_FAILURES = 2000
_ABOUT = ("suite", "scenes", "seed", "commit", "device", "precision", "created")


@dataclass(frozen=True)
class Players:
    """The player for some scenes.

    Attributes:
      page: HTML of the player (`spdm_jax.viz`), or None.
      tokens: its scenes, in its order.
      notes: what the page says about it: which plans it shows, or why it is not there.
    """

    page: str | None = None
    tokens: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def render(
    runs: Sequence[Run], *, worst: int = 50, seed: int = 0, players: Players | None = None
) -> str:
    """Returns the page.

    Args:
      runs: one or two.
      worst: scenes listed per grid point.
      seed: of the bootstrap.
      players: scenes to be looked at.
    """
    players = players or Players(notes=["This report was made without a player (--players 0)."])
    data = page_data(runs, worst=worst, seed=seed, players=players)
    folder = files("spdm_experiments")
    read = lambda name: folder.joinpath(name).read_text(encoding="utf-8")
    parts = {
        "title": html.escape(data["title"]),
        "style": read("report.css"),
        "charts": read("report_charts.js"),
        "script": read("report.js"),
        "data": _json(data),
        "player": _json(players.page),
    }
    # One pass, so that what is put in is not searched for marks again.
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], read("report.html"))


def _json(value: Any) -> str:
    # No "<" at all: neither a closing tag nor a comment can start inside the data.
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def page_data(
    runs: Sequence[Run], *, worst: int = 50, seed: int = 0, players: Players | None = None
) -> dict[str, Any]:
    """Returns all that the page shows, ready for JSON; what is not finite is None.

    Args:
      runs: see `render`.
      worst: see `render`.
      seed: see `render`.
      players: see `render`.
    """
    players = players or Players()
    terms = numbers.common_terms(runs)
    names = run_names(runs)
    summaries = [numbers.summarise(run, seed) for run in runs]
    pairs = numbers.common_points(*runs) if len(runs) == 2 else []
    titles = [_titles(run) for run in runs]
    # Grid points of both runs stand in one list; `start` is where each run's begin.
    start = [0, len(runs[0].points)]
    dots, sampled = _dots(runs, list(terms.titles))
    keys = dict.fromkeys(key for run in runs for key in grid.distinguishing(run.points))
    return {
        "title": f"{terms.title}: " + " and ".join(names),
        "runs": [
            {"name": name, "about": _about(run), "notes": _notes(run)}
            for run, name in zip(runs, names, strict=True)
        ],
        "notes": _comparison_notes(runs, names),
        "terms": [{"key": k, "title": t, "short": terms.short[k]} for k, t in terms.titles.items()],
        "metres": terms.metres,
        "words": {"summary": terms.summary, "score": terms.score, "command": terms.command},
        "braking": terms.braking,
        "parameters": [{"key": key, "title": _title(key)} for key in keys],
        "points": [
            _point(run, summary, number, title, keys)
            for number, run in enumerate(runs)
            for summary, title in zip(summaries[number], titles[number], strict=True)
        ],
        "types": [_types(run) for run in runs],
        "axes": _axes(runs, names, start),
        "paired": [
            _paired(numbers.paired_difference(runs[0], runs[1], pair, seed), start)
            for pair in pairs
        ],
        "stageNames": [{"key": k, "title": t, "color": c} for k, (t, c) in STAGES.items()],
        "stages": [
            {**row, "run": number}
            for number, run in enumerate(runs)
            for row in stage_table(run).to_dicts()
        ],
        "scenes": dots,
        "sampled": sampled,
        "lists": _lists(runs, titles, pairs, worst),
        "failures": _failures(runs),
        "player": {"tokens": players.tokens, "notes": players.notes},
    }


def run_names(runs: Sequence[Run]) -> list[str]:
    """Names runs by their folders, told apart by letters where there are two."""
    plain = [run.folder.resolve().name for run in runs]
    return (
        plain if len(plain) == 1 else [f"{one} ({c})" for one, c in zip(plain, "AB", strict=True)]
    )


def _title(key: str) -> str:
    return {"planner": "Planner", "num_proposals": "N_p"}.get(key, key)


def _titles(run: Run) -> list[str]:
    keys = grid.distinguishing(run.points)
    return [grid.label(point, keys) for point in run.points]


def _about(run: Run) -> list[list[str]]:
    about = {key: run.about.get(key) for key in _ABOUT}
    about["input_hash"] = str(run.about.get("input_hash"))[:12]
    versions = run.about.get("versions") or {}
    text = ", ".join(f"{name} {version}" for name, version in versions.items())
    entries = {**about, "versions": text, "scenarios": run.about["num_scenarios"]}
    fixed = [key for key in run.points[0] if key not in grid.varied(run.points)]
    for key in fixed:
        if key not in ("point", *entries):
            entries[key] = _parameter(run.points[0], key)
    return [[key.replace("_", " "), str(v)] for key, v in entries.items() if v not in (None, "")]


def _notes(run: Run) -> list[str]:
    notes = []
    if run.missing:
        total = run.about["num_scenarios"]
        notes.append(
            f"Not finished: {run.missing} of {total} scenarios are missing. The same spdm "
            f"{run.terms.command} command goes on where it stopped; this page shows what is there."
        )
    counts = {len(run.usable(point)) for point in range(len(run.points))}
    if len(counts) > 1:
        notes.append(
            "Grid points have scores of different numbers of scenarios, so their means are over "
            "different scenes."
        )
    return notes


def _comparison_notes(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    """Says what two runs differ in besides their rows."""
    if len(runs) < 2:
        return []
    first, second = (run.about for run in runs)
    notes = []
    changed = [
        f"{key} {grid.plain(a)} (A), {grid.plain(b)} (B)"
        for key in ("suite", "commit", "device", "precision", "seed")
        if (a := first.get(key)) != (b := second.get(key))
    ]
    varied = {key for run in runs for key in grid.varied(run.points)}
    one, other = (run.points[0] for run in runs)
    changed += [
        f"{key} {grid.plain(one.get(key))} (A), {grid.plain(other.get(key))} (B)"
        for key in dict.fromkeys([*one, *other])
        if key not in varied and one.get(key) != other.get(key)
    ]
    if changed:
        notes.append(f"The runs differ in: {'; '.join(changed)}.")
    if first.get("input_hash") != second.get("input_hash"):
        notes.append(
            "The runs read different scenario files. Differences are over scenarios of one name."
        )
    return notes


def _point(
    run: Run, summary: PointSummary, number: int, title: str, keys: Mapping[str, Any]
) -> dict[str, Any]:
    point = run.points[summary.point]
    return {
        "run": number,
        "title": title,
        "parameters": {key: _parameter(point, key) for key in keys},
        "scenarios": summary.scenarios,
        "failed": summary.failed,
        "means": {key: _number(value) for key, value in summary.means.items()},
        "intervals": {key: [_number(v) for v in ends] for key, ends in summary.intervals.items()},
        "braking": _number(summary.braking),
        "ms": _number(summary.ms),
    }


def _types(run: Run) -> list[dict[str, Any]]:
    """Mean scores of scenario types, if there are several."""
    found = numbers.by_type(run)
    return [
        {"type": kind, "scenarios": count, "means": [_number(mean) for mean in means]}
        for kind, (count, means) in found.items()
        if len(found) > 1
    ]


def _parameter(point: Mapping[str, Any], key: str) -> str:
    # A point of another run may lack a setting; a planner may have no such thing.
    return "–" if key in point and point[key] is None else grid.plain(point.get(key))


def _paired(found: numbers.PairedDifference, start: Sequence[int]) -> dict[str, Any]:
    return {
        "points": [found.points[0] + start[0], found.points[1] + start[1]],
        "scenarios": found.scenarios,
        "mean": _number(found.mean),
        "interval": [_number(value) for value in found.interval],
        "wins": found.wins,
        "ties": found.ties,
        "losses": found.losses,
    }


def _axes(runs: Sequence[Run], names: Sequence[str], start: Sequence[int]) -> list[dict[str, Any]]:
    """Lines along every parameter that varies; the same line of two runs has one colour."""
    found = []
    for axis in dict.fromkeys(axis for run in runs for axis in grid.axes(run.points)):
        colors: dict[str, str] = {}
        group = []
        for number, run in enumerate(runs):
            if not all(axis in point for point in run.points):
                continue
            for line in grid.lines(run.points, axis):
                at = len(colors)
                color = colors.setdefault(line.name, LINE_COLORS[at % len(LINE_COLORS)])
                group.append(
                    {
                        "name": line.name + (f" ({'AB'[number]})" if len(runs) > 1 else ""),
                        "run": number,
                        "color": color,
                        "points": [point + start[number] for point in line.points],
                        "values": line.values,
                    }
                )
        found.append({"key": axis, "title": axis_title(axis), "lines": group})
    return found


def axis_title(key: str) -> str:
    """Names a parameter below an axis."""
    return "Number of proposals N_p" if key == "num_proposals" else key


def stage_table(run: Run) -> polars.DataFrame:
    """Returns mean times over the timed scenes, one row per planner and number of proposals.

    Columns: planner, num_proposals, scenes, total and one per stage, ms. Empty where the run has
    no times of stages.
    """
    if run.stages is None or not len(run.stages):
        return polars.DataFrame()
    value = lambda stage: polars.col("median_ms").filter(polars.col("stage") == stage).mean()
    means = {stage: value(stage) for stage in (*STAGES, "total")}
    return (
        run.stages.group_by("planner", "num_proposals")
        .agg(scenes=polars.col("token").n_unique(), **means)
        .sort("planner", "num_proposals")
    )


def _dots(runs: Sequence[Run], names: list[str]) -> tuple[list[dict[str, Any]], int]:
    """Returns scores per scenario for the scatter, and how many scenarios there are in all.

    `values[p][t]` is the score of term t at point p of the page's list, None where there is none.
    """
    tokens = np.array(sorted({token for run in runs for token in run.rows["token"].unique()}))
    total = len(tokens)
    if total > MAX_DOTS:
        picked = np.random.default_rng(0).choice(total, MAX_DOTS, replace=False)
        tokens = tokens[np.sort(picked)]
    place = {token: number for number, token in enumerate(tokens.tolist())}
    kinds = [""] * len(tokens)
    count = sum(len(run.points) for run in runs)
    values = np.full((len(tokens), count, len(names)), np.nan)
    point = 0
    for run in runs:
        for number in range(len(run.points)):
            rows = run.usable(number).filter(polars.col("token").is_in(tokens.tolist()))
            at = [place[token] for token in rows["token"]]
            values[at, point] = rows.select(names).cast(polars.Float64).to_numpy()
            for where, kind in zip(at, _column(rows, "scenario_type"), strict=True):
                kinds[where] = kind or ""
            point += 1
    rounded = np.round(values, 6).tolist()
    return [
        {
            "token": token,
            "type": kind,
            "values": [[_number(v) for v in row] for row in rows],
        }
        for token, kind, rows in zip(tokens.tolist(), kinds, rounded, strict=True)
    ], total


def _column(rows: polars.DataFrame, name: str) -> list[Any]:
    return rows[name].to_list() if name in rows.columns else [None] * len(rows)


def _lists(
    runs: Sequence[Run],
    titles: Sequence[Sequence[str]],
    pairs: Sequence[tuple[int, int]],
    count: int,
) -> list[dict[str, Any]]:
    """Worst scenes: first what the first run loses against the second, then each grid point's."""
    found = []
    for pair in reversed(pairs):
        rows = numbers.largest_losses(runs[0], runs[1], pair, count)
        name = f"Largest losses of A against B: {titles[0][pair[0]]}"
        found.append(
            {
                "name": name,
                "compared": True,
                "rows": [_scene(r, runs[0].terms) for r in rows.to_dicts()],
            }
        )
    for number, run in enumerate(runs):
        # The last point is the largest of the last planner: what most people look for first.
        for point in reversed(range(len(run.points))):
            letter = f"{'AB'[number]}: " if len(runs) > 1 else ""
            rows = numbers.worst(run, point, count)
            found.append(
                {
                    "name": f"Worst of {letter}{titles[number][point]}",
                    "compared": False,
                    "rows": [_scene(row, run.terms) for row in rows.to_dicts()],
                }
            )
    return found


def _scene(row: Mapping[str, Any], terms: Terms) -> dict[str, Any]:
    term, reason = terms.first_lost(row)
    return {
        "token": row["token"],
        "type": row.get("scenario_type") or "",
        "log": row.get("log_name") or "",
        "total": _number(row["total"]),
        "other": _number(row.get("other")),
        "difference": _number(row.get("difference")),
        "term": terms.titles.get(term, ""),
        "reason": reason,
        "braking": bool(row.get("emergency_brake")),
    }


def _failures(runs: Sequence[Run]) -> list[dict[str, Any]]:
    found = []
    for number, run in enumerate(runs):
        rows = [{**row, "run": number, "of": len(run.points)} for row in numbers.failures(run)]
        found.append({"total": len({row["token"] for row in rows}), "rows": rows[:_MAX_FAILURES]})
    return found


def _number(value: float | None) -> float | None:
    """A number as JSON has it: rounded, None where it is not finite."""
    return None if value is None or not math.isfinite(value) else round(value, 5)
