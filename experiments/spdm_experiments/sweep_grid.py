"""Grids of settings: from flags or a TOML file to points, and from points to planner runs.

A point is one planner with all its settings. A run is one scored set of proposals: SPDM's sets
nest, so one run of the largest N_p serves every point that differs in N_p alone.
"""

import dataclasses
import itertools
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from flax import struct

from spdm_experiments.options import Sweep
from spdm_jax import PlannerConfig, PlannerParams, PlannerSpec, pdm_closed, spdm
from spdm_jax.nested import progress_by_goal

NAMES = {"spdm": "SPDM", "pdm-closed": "PDM-Closed"}
STAGE2 = ("merge_times", "horizon")
"""Settings of SPDM's second stage, besides those of `--set spline.*`."""
_AXES: dict[str, type] = {
    "planner": str,
    "num_proposals": int,
    "speeds": tuple,
    "offsets": tuple,
    "merge_times": tuple,
    "horizon": float,
    "forecast": str,
    "progress_reference": str,
    "tracker": str,
}
"""Axes of a grid in the order in which points are numbered, and what one value is."""
_SWITCHES = ("tracker", "forecast", "progress_reference", "borrow_oncoming")
_OWN_OPTION = {
    "speed_fractions": "--speeds",
    "lateral_offsets": "--offsets",
    "spline.merge_times": "--merge-times",
    "spline.horizon": "--horizon",
}


@dataclass(frozen=True)
class Point:
    """One planner with all its settings.

    Attributes:
      planner: "SPDM" or "PDM-Closed".
      num_proposals: N_p asked for.
      settings: further entries of run.json, in its order.
      spec: the planner.
    """

    planner: str
    num_proposals: int
    settings: Mapping[str, Any]
    spec: PlannerSpec

    def entry(self, number: int) -> dict[str, Any]:
        """Returns the point as run.json holds it."""
        first = {"point": number, "planner": self.planner, "num_proposals": self.num_proposals}
        return {**first, **self.settings}


@dataclass(frozen=True)
class Run:
    """One scored set of proposals and the points that are read from it.

    Attributes:
      config: static settings, of the largest N_p.
      params: traced settings.
      points: numbers of the points.
      num_proposals: N_p of each.
      by_goal: for each, whether progress is measured along the way to the goal.
      num_stage1: offsets x fractions.
    """

    config: PlannerConfig
    params: PlannerParams
    points: tuple[int, ...]
    num_proposals: tuple[int, ...]
    by_goal: tuple[bool, ...]
    num_stage1: int


def make_points(options: Sweep) -> list[Point]:
    """Returns the points that flags and grid file ask for.

    Raises:
      ValueError: an axis is given twice, a name or value is unknown, or does not fit its planner.
    """
    flags = _from_flags(options)
    grids = [flags]
    if options.grid is not None:
        grids = []
        for grid in read_grids(options.grid):
            for axis in flags:
                if axis in grid:
                    option = axis if axis.startswith("--") else f"--{axis.replace('_', '-')}"
                    if axis not in _AXES:
                        option = f"--set {axis}"
                    raise ValueError(
                        f"{axis} is given by {option} and in {options.grid}; drop one of them"
                    )
            grids.append({**grid, **flags})
    swept = sorted({axis for grid in grids for axis in grid if axis not in _AXES})
    points: dict[str, Point] = {}
    for grid in grids:
        for point in _product(grid, swept):
            points.setdefault(repr(point.entry(0)), point)
    return list(points.values())


def runs_of(points: Sequence[Point]) -> list[Run]:
    """Joins points that one scored set serves.

    PDM-Closed's grids do not nest: the leaders of its policies depend on one another.
    """
    families: dict[str, list[int]] = {}
    for number, point in enumerate(points):
        same = {**point.entry(0), "num_proposals": None}
        alone = None if point.planner == "SPDM" else point.num_proposals
        families.setdefault(repr((same, alone)), []).append(number)
    runs = []
    for numbers in families.values():
        largest = max((points[i] for i in numbers), key=lambda p: p.num_proposals)
        params, config = largest.spec.params, largest.spec.config
        stage1 = len(params.speed_fractions) * len(params.lateral_offsets)
        counts = tuple(points[i].num_proposals for i in numbers)
        by_goal = tuple(progress_by_goal(config.progress_reference, n, stage1) for n in counts)
        runs.append(Run(config, params, tuple(numbers), counts, by_goal, stage1))
    return runs


def varying(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the names of settings that differ between points, planner and N_p apart.

    A planner that has no such setting (None) does not make it one that differs.
    """
    names = [n for n in entries[0] if n not in ("point", "planner", "num_proposals")]
    values = lambda name: {repr(entry[name]) for entry in entries if entry[name] is not None}
    return [name for name in names if len(values(name)) > 1]


def read_grids(path: Path) -> list[dict[str, list[Any]]]:
    """Reads a grid file: `[grid]`, or several `[[grid]]` whose points come one after the other.

    Raises:
      ValueError: not TOML, or an entry is unknown.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a TOML file ({error})") from error
    tables = content.pop("grid", None)
    tables = [tables] if isinstance(tables, dict) else tables
    if content or not isinstance(tables, list) or not tables:
        extra = f"unknown entry {next(iter(content))!r}" if content else "no [grid]"
        raise ValueError(f"{path}: {extra}; a grid file holds [grid], or several [[grid]]")
    return [_from_table(path, table) for table in tables]


def _from_table(path: Path, table: dict[str, Any]) -> dict[str, list[Any]]:
    grid: dict[str, list[Any]] = {}
    sets = table.pop("set", {})
    if not isinstance(sets, dict):
        raise ValueError(f'{path}: set is {sets!r}; write [grid.set] and "idm.headway_time" = [1]')
    for axis, values in table.items():
        if axis not in _AXES:
            raise ValueError(f"{path}: unknown axis {axis!r}; there are {', '.join(_AXES)} and set")
        values = values if isinstance(values, list) else [values]
        if _AXES[axis] is tuple and values and not isinstance(values[0], list):
            values = [values]
        grid[axis] = [_value(f"{path}: {axis}", axis, value) for value in values]
    for name, values in _flat(sets).items():
        check_name(name)
        values = values if isinstance(values, list) else [values]
        grid[name] = [_number(f"{path}: {name}", value) for value in values]
    for axis, values in grid.items():
        if not values:
            raise ValueError(f"{path}: {axis} is empty; give it a value or leave it out")
    return grid


def _flat(sets: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted names, whether written "idm.headway_time" = or as a table [grid.set.idm]."""
    flat: dict[str, Any] = {}
    for name, value in sets.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _from_flags(options: Sweep) -> dict[str, list[Any]]:
    grid: dict[str, list[Any]] = {}
    for axis, kind in _AXES.items():
        values = getattr(options, axis)
        if not values:
            continue
        if kind is tuple:
            option = f"--{axis.replace('_', '-')}"
            values = [_numbers(option, value) for value in values]
        grid[axis] = [_value(f"--{axis}", axis, value) for value in values]
    for text in itertools.chain.from_iterable(options.set):
        name, sign, values = text.partition("=")
        if not sign or not values:
            raise ValueError(f"--set {text}: write NAME=VALUE or NAME=VALUE,VALUE,...")
        check_name(name)
        if name in grid:
            raise ValueError(f"--set {name} is given twice; write --set {name}=VALUE,VALUE,...")
        grid[name] = _numbers(f"--set {name}", values)
    return grid


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [_number(option, float(part)) for part in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} {text}: needs numbers between commas") from error


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{where} is {value!r}; it must be a number")
    return float(value)


def _value(where: str, axis: str, value: Any) -> Any:
    kind = _AXES[axis]
    if kind is tuple:
        if not isinstance(value, list) or not value:
            raise ValueError(f"{where} is {value!r}; it must be a list of numbers")
        return tuple(_number(where, number) for number in value)
    if kind is float:
        return _number(where, value)
    if isinstance(value, bool) or not isinstance(value, kind):
        raise ValueError(f"{where} is {value!r}; it must be of type {kind.__name__}")
    if axis == "planner" and value not in NAMES:
        raise ValueError(f"{where} is {value!r}; it must be one of {', '.join(NAMES)}")
    return value


def settable() -> dict[str, float]:
    """Returns what `--set` takes: dotted name -> default."""
    found: dict[str, float] = {}
    defaults = PlannerParams()
    for field in dataclasses.fields(defaults):  # type: ignore[arg-type]
        value = getattr(defaults, field.name)
        if isinstance(value, struct.PyTreeNode):
            for inner in dataclasses.fields(value):  # type: ignore[arg-type]
                found[f"{field.name}.{inner.name}"] = getattr(value, inner.name)
        else:
            found[field.name] = value
    return {
        name: float(value)
        for name, value in found.items()
        if name not in _OWN_OPTION and np.ndim(value) == 0
    }


def check_name(name: str) -> None:
    """Raises ValueError where `--set` has no such name."""
    if name in _OWN_OPTION:
        raise ValueError(f"--set {name}: this has an option of its own, {_OWN_OPTION[name]}")
    names = settable()
    if name not in names:
        group = [known for known in names if known.startswith(name.partition(".")[0] + ".")]
        raise ValueError(f"--set {name}: unknown; there are {', '.join(group or names)}")


def _product(grid: Mapping[str, list[Any]], swept: Sequence[str]) -> Iterable[Point]:
    names = list(grid)
    for values in itertools.product(*grid.values()):
        yield point_of(dict(zip(names, values, strict=True)), swept)


def point_of(chosen: Mapping[str, Any], swept: Sequence[str] = ()) -> Point:
    """Makes one point.

    Args:
      chosen: axis or settable name -> value; the rest is the planner's own.
      swept: settable names that the point's entry is to hold.

    Raises:
      ValueError: planner and settings do not fit.
    """
    short = chosen.get("planner", "spdm")
    config = PlannerConfig(**{n: chosen[n] for n in _SWITCHES if n in chosen})
    asked = chosen.get("num_proposals")
    own = {"speeds": "speed_fractions", "offsets": "lateral_offsets"}
    lists = {own[name]: chosen[name] for name in own if name in chosen}
    count = {} if asked is None else {"num_proposals": asked}
    spec = (spdm if short == "spdm" else pdm_closed)(config=config, **count, **lists)
    speeds, offsets = (
        np.asarray(values).tolist()
        for values in (spec.params.speed_fractions, spec.params.lateral_offsets)
    )
    made = len(speeds) * (len(offsets) + spec.config.num_route_paths)
    if asked is not None and asked != made:
        raise ValueError(
            f"num_proposals is {asked}, but {NAMES[short]} with {len(offsets)} offsets and "
            f"{len(speeds)} speeds makes {made}; leave num_proposals out, or give it a [[grid]] of "
            "its own in a grid file"
        )
    # PDM-Closed has no second stage: values of it would only repeat its points.
    unused = () if short == "spdm" else tuple(n for n in chosen if n.startswith("spline.")) + STAGE2
    used = {name: value for name, value in chosen.items() if name not in unused}
    params = _with(spec.params, {n: v for n, v in used.items() if n in settable()})
    spline = params.spline
    if "merge_times" in used:
        spline = spline.replace(merge_times=np.asarray(used["merge_times"], float))
    if "horizon" in used:
        spline = spline.replace(horizon=used["horizon"])
    if np.min(spline.merge_times) <= 0 or spline.horizon <= 0:
        raise ValueError("merge_times and horizon must be positive")
    params = params.replace(spline=spline)
    settings = {
        "speed_fractions": speeds,
        "lateral_offsets": offsets,
        "merge_times": np.asarray(spline.merge_times).tolist(),
        "horizon": float(spline.horizon),
        "forecast": config.forecast,
        "progress_reference": config.progress_reference,
        "tracker": config.tracker,
        **{name: _get(params, name) for name in swept},
    }
    return Point(NAMES[short], made, settings, dataclasses.replace(spec, params=params))


def _with(params: PlannerParams, values: Mapping[str, float]) -> PlannerParams:
    for name, value in values.items():
        group, dot, field = name.partition(".")
        changed = getattr(params, group).replace(**{field: value}) if dot else value
        params = params.replace(**{group: changed})
    return params


def _get(params: PlannerParams, name: str) -> float:
    for part in name.split("."):
        params = getattr(params, part)
    return float(params)  # type: ignore[arg-type]
