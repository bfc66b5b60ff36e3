"""The player of a report: the worst scenes of a run, planned anew from their files."""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments import report_data as numbers
from spdm_experiments import report_grid as grid
from spdm_experiments.chunks import scenario_files
from spdm_experiments.inventory import Inventory, take_inventory
from spdm_experiments.report_data import Run
from spdm_experiments.report_page import Players
from spdm_experiments.runtime import provenance_text
from spdm_jax import PlannerConfig, PlannerSpec, PlanSet, load, pdm_closed, plan, spdm
from spdm_jax.viz.html import render

_SWITCHES = ("forecast", "progress_reference", "tracker")
_MAX_PLANNERS = 4
_SAME = 2e-3
"""Totals of the run and of the plan made anew that differ by more are mentioned."""


def make_players(runs: Sequence[Run], count: int, moved: Path | None = None) -> Players:
    """Plans the worst scenes of the runs again and returns the player for them.

    One run: every planner with its most proposals. Two runs: the largest grid point that they have
    in common, of both. The scenes are those of the first run.

    Args:
      runs: one or two.
      count: scenes at most.
      moved: folder of the scenario files, if it is not where run.json says.

    Returns:
      The player, or why there is none.
    """
    chosen = shown_points(runs)
    tokens = _interesting(runs, chosen, count)
    if not tokens:
        return Players(notes=["No player: no scenario has scores at the grid points shown."])
    source = moved or Path(runs[0].about["scenes"])
    try:
        inventory = take_inventory(scenario_files(source, _limit(runs[0])))
        if inventory.digest != runs[0].about["input_hash"]:
            return Players(notes=[_changed(source)])
        paths = _paths(inventory, tokens)
        scenes = load(paths)
        plans = [_plan(runs[number], point, scenes) for number, point in chosen]
    except (ValueError, OSError) as error:
        return Players(notes=[f"No player: {error}. {_MOVED}"])
    names = [_name(runs, *one) for one in chosen]
    plans = [dataclasses.replace(p, name=name) for p, name in zip(plans, names, strict=True)]
    about = {key: runs[0].about.get(key) for key in ("suite", "precision")}
    page = render(scenes, plans, provenance=provenance_text(about), title="Worst scenes")
    notes = [
        f"{len(scenes)} scenes, planned anew by {', '.join(names)}. Every proposal is drawn in the "
        "colour of its score; what breaks a rule, and when, is outlined in red.",
        *_disagreements(runs, chosen, names, plans),
    ]
    return Players(page, [info.token for info in scenes.infos], notes)


_MOVED = "If the scenario files have moved, name their folder with --scenes."


def _changed(source: Path) -> str:
    return (
        f"No player: the scenario files in {source} are not those of the run; some were added, "
        f"removed or changed. {_MOVED}"
    )


def _limit(run: Run) -> int | None:
    return (run.about.get("config") or {}).get("limit")


def shown_points(runs: Sequence[Run]) -> list[tuple[int, int]]:
    """Returns whose plans the player shows, as (run, grid point)."""
    if len(runs) == 2 and (common := numbers.common_points(*runs)):
        most = max(common, key=lambda pair: runs[0].points[pair[0]]["num_proposals"])
        return [(0, most[0]), (1, most[1])]
    found = []
    for number, run in enumerate(runs):
        largest: dict[str, int] = {}
        for at, point in enumerate(run.points):
            best = largest.get(point["planner"])
            if best is None or point["num_proposals"] >= run.points[best]["num_proposals"]:
                largest[point["planner"]] = at
        # SPDM first where both planners were run.
        found += [(number, at) for _, at in sorted(largest.items(), reverse=True)]
    return found[:_MAX_PLANNERS]


def _interesting(runs: Sequence[Run], chosen: Sequence[tuple[int, int]], count: int) -> list[str]:
    """Picks scenes in turn from the lists of the shown points, the largest losses first.

    All of them have scores at every shown point of the first run.
    """
    lists = []
    if len(runs) == 2 and len(chosen) == 2:
        pair = (chosen[0][1], chosen[1][1])
        lists.append(numbers.largest_losses(runs[0], runs[1], pair, count)["token"].to_list())
    lists += [numbers.worst(runs[r], p, count)["token"].to_list() for r, p in chosen]
    usable = [set(runs[r].usable(p)["token"]) for r, p in chosen]
    in_turn = (token for turn in zip_longest(*lists) for token in turn if token is not None)
    good = (token for token in in_turn if all(token in tokens for tokens in usable))
    return list(dict.fromkeys(good))[:count]


def _paths(inventory: Inventory, tokens: Sequence[str]) -> list[Path]:
    by_token = {entry.token: entry.path for entry in inventory.entries}
    if missing := [token for token in tokens if token not in by_token]:
        raise ValueError(f"no scenario file for {missing[0]!r}")
    return [by_token[token] for token in tokens]


def _plan(run: Run, point: int, scenes: Any) -> PlanSet:
    return plan(scenes, planner_of(run.points[point]), precision=run.about["precision"])


def planner_of(point: Mapping[str, Any]) -> PlannerSpec:
    """Returns the planner that a grid point of run.json describes.

    Raises:
      ValueError: the point has a setting that this version does not know.
    """
    known = {"point", "planner", "num_proposals", "speed_fractions", "lateral_offsets"}
    known |= {"merge_times", "horizon", *_SWITCHES}
    config = PlannerConfig(**{name: point[name] for name in _SWITCHES if name in point})
    grids = {
        name: tuple(point[name]) for name in ("speed_fractions", "lateral_offsets") if name in point
    }
    make = spdm if point["planner"] == "SPDM" else pdm_closed
    spec = make(point["num_proposals"], config=config, **grids)
    values = {name: value for name, value in point.items() if name not in known}
    if "merge_times" in point:
        values["spline.merge_times"] = np.array(point["merge_times"], float)
    if "horizon" in point:
        values["spline.horizon"] = point["horizon"]
    params = spec.params
    for name, value in values.items():
        group, dot, inner = name.partition(".")
        try:
            changed = getattr(params, group).replace(**{inner: value}) if dot else value
            params = params.replace(**{group: changed})
        except (AttributeError, TypeError) as error:
            raise ValueError(f"run.json has a setting {name!r} of another version") from error
    return dataclasses.replace(spec, params=params)


def _name(runs: Sequence[Run], run: int, point: int) -> str:
    points = runs[run].points
    keys = grid.distinguishing(points)
    return ("" if len(runs) == 1 else f"{'AB'[run]}: ") + grid.label(points[point], keys)


def _disagreements(
    runs: Sequence[Run],
    chosen: Sequence[tuple[int, int]],
    names: Sequence[str],
    plans: Sequence[PlanSet],
) -> list[str]:
    """Says where the plans made now score other than those of the run."""
    found = []
    for (run, point), name, result in zip(chosen, names, plans, strict=True):
        stored = dict(runs[run].usable(point).select("token", "total").iter_rows())
        total = np.asarray(result.scores.total)[np.arange(len(result)), result.best]
        off = [
            f"{info.token} {value:.3f} instead of {stored[info.token]:.3f}"
            for info, value in zip(result.infos, total.tolist(), strict=True)
            if not abs(value - stored[info.token]) <= _SAME
        ]
        if off:
            found.append(
                f"Planned now, {len(off)} of these scenes score other than in the run, by another "
                f"version, device or scenario file: {name}: {'; '.join(off[:5])}."
            )
    return found
