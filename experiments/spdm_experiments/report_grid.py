"""The grid of a sweep: what varies in it, names of its points, and lines along a parameter."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_NAMED = ("planner", "num_proposals")


@dataclass(frozen=True)
class Line:
    """Grid points that differ in one parameter only, in its order.

    Attributes:
      name: what they have in common, in words.
      points: numbers of the grid points.
      values: the parameter's values.
    """

    name: str
    points: list[int]
    values: list[float]


def varied(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the parameters that differ between grid points, in the order of the points."""
    keys = dict.fromkeys(key for point in points for key in point if key != "point")
    return [key for key in keys if len({frozen(point.get(key)) for point in points}) > 1]


def distinguishing(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns planner, number of proposals, and what else is needed to tell the points apart.

    A grid of speeds that follows from the number of proposals says nothing new.
    """
    kept = [key for key in varied(points) if key not in ("planner", "num_proposals")]
    tell = lambda keys: len({tuple(frozen(p.get(k)) for k in keys) for p in points})
    # Lists are the hardest to read, so they are the first to go.
    has_list = lambda key: any(isinstance(p.get(key), list) for p in points)
    for key in sorted(kept, key=has_list, reverse=True):
        rest = [other for other in kept if other != key]
        if tell(["planner", "num_proposals", *rest]) == len(points):
            kept = rest
    return ["planner", "num_proposals", *kept]


def label(point: Mapping[str, Any], keys: Iterable[str]) -> str:
    """Names a grid point by some of its parameters: "SPDM 60, idm.headway_time 1.5"."""
    keys = list(keys)
    names = [point[key] for key in ("planner", "num_proposals") if key in keys]
    words = [str(name) for name in names if name is not None]
    rest = [f"{key} {plain(point.get(key))}" for key in keys if key not in _NAMED]
    return ", ".join([*([" ".join(words)] if words else []), *rest])


def plain(value: Any) -> str:
    """Writes a parameter's value for people; a point lacks what all of its run leave alone."""
    if isinstance(value, list | tuple):
        return " ".join(plain(one) for one in value)
    if isinstance(value, float):
        return f"{value:g}"
    return "default" if value is None else str(value)


def axes(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the parameters that lines may run along: numbers that vary, N_p first.

    Some planners make no proposals; the others still have lines along N_p.
    """
    number = lambda value: isinstance(value, int | float) and not isinstance(value, bool)

    def numeric(key: str) -> bool:
        values = [point.get(key) for point in points]
        if key == "num_proposals":
            values = [value for value in values if value is not None]
        return bool(values) and all(number(value) for value in values)

    keys = [key for key in varied(points) if numeric(key)]
    keys.sort(key=lambda key: key != "num_proposals")
    return keys or ["num_proposals"]


def lines(points: Sequence[Mapping[str, Any]], axis: str) -> list[Line]:
    """Groups grid points into lines along a parameter.

    A point without N_p is the same all along that axis: its line is level.

    Args:
      points: of one run.
      axis: parameter, one of `axes`.
    """
    keys = [key for key in distinguishing(points) if key != axis]
    # The planner names every line, even if there is only one.
    names: dict[str, list[int]] = {}
    for number, point in enumerate(points):
        names.setdefault(label(point, keys), []).append(number)
    known = [float(p[axis]) for p in points if p[axis] is not None] or [0.0]
    found = []
    for name, members in names.items():
        if any(points[number][axis] is None for number in members):
            ends = sorted({min(known), max(known)})
            found += [Line(name, [number] * len(ends), ends) for number in members]
            continue
        members.sort(key=lambda number: points[number][axis])
        found.append(Line(name, members, [float(points[number][axis]) for number in members]))
    return found


def frozen(value: Any) -> str:
    """Returns a parameter's value as something that can be compared and hashed."""
    return json.dumps(value, sort_keys=True)
