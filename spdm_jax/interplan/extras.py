"""What a simulation of an interPlan scenario needs beyond the scenario itself.

Everything is in map coordinates and refers to tracks by identifier, so that it can stand beside a
packed scenario as a small JSON file.
"""

import dataclasses
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spdm_jax.interplan.config import ObstacleKind, Policy
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.scenario_file import write_atomically

EXTRAS_SUFFIX = ".interplan.json"
"""Of the file beside `<name>.npz`."""

_CODED = re.compile(r"[0-9a-f]{16}-[a-z0-9]+")
Point = tuple[float, float]
Pose = tuple[float, float, float]


@dataclass(frozen=True)
class ScriptedPedestrian:
    """A pedestrian that the simulation moves.

    It walks evenly from start to end in `min(begin + 150, iterations)` iterations from its
    beginning on, and stands before and after. Its recorded velocity is 0.

    Attributes:
      track: its track; that of a triggered one is nowhere valid in the scenario.
      start, end: x, y, m.
      begins_at: iteration at which it starts; None: it appears when the ego is within 50 m of it
        along the ego's lane.
    """

    track: str
    start: Point
    end: Point
    begins_at: int | None


@dataclass(frozen=True)
class InterplanExtras:
    """The part of an interPlan scenario that a recording cannot hold.

    Attributes:
      name: `<token>-<code>`.
      base_token: the recorded scenario.
      scenario_type: interPlan's name of the type.
      policy: how the agents treat an ego that moves into their lane.
      stopped: tracks of vehicles that never move and stay where they are put.
      cautious: tracks of vehicles that treat the ego as standing.
      pedestrians: those that the simulation moves.
      obstacle_kind: what the ego has to get past, None for types that do not ask for it.
      obstacles: centres of these obstacles (for pedestrians: where they go).
      goal: x, y, heading.
      course: polyline along which the way to the goal is measured, m.
      end: arc length on `course` m; the run ends once the ego's centre has passed it.
    """

    name: str
    base_token: str
    scenario_type: str
    policy: Policy
    stopped: tuple[str, ...]
    cautious: tuple[str, ...]
    pedestrians: tuple[ScriptedPedestrian, ...]
    obstacle_kind: ObstacleKind | None
    obstacles: tuple[Point, ...]
    goal: Pose
    course: tuple[Point, ...]
    end: float


def extras_path(scenario_file: Path) -> Path:
    """Returns where the extras of a scenario file lie."""
    return scenario_file.with_name(scenario_file.stem + EXTRAS_SUFFIX)


def has_code(token: str) -> bool:
    """Says whether a token names a changed scenario (`<token>-<code>`)."""
    return _CODED.fullmatch(token) is not None


def write_extras(path: Path | str, extras: InterplanExtras) -> None:
    """Writes them as JSON; a reader sees the old file or the whole new one."""
    write_atomically(Path(path), json.dumps(dataclasses.asdict(extras), indent=1).encode())


def read_extras(path: Path | str) -> InterplanExtras:
    """Reads what `write_extras` wrote.

    Raises:
      ScenarioError: the file holds something else.
      OSError: it cannot be opened.
    """
    try:
        entries: dict[str, Any] = json.loads(Path(path).read_bytes())
        kind = entries.pop("obstacle_kind")
        pedestrians = tuple(
            ScriptedPedestrian(**entry | {key: tuple(entry[key]) for key in ("start", "end")})
            for entry in entries.pop("pedestrians")
        )
        points = {key: tuple(map(tuple, entries.pop(key))) for key in ("obstacles", "course")}
        if (kind is None) != (not points["obstacles"]) or not points["course"]:
            raise ValueError(f"obstacle_kind {kind!r} without obstacles, or no course")
        names = {key: tuple(entries.pop(key)) for key in ("stopped", "cautious")}
        return InterplanExtras(
            policy=Policy(entries.pop("policy")),
            obstacle_kind=None if kind is None else ObstacleKind(kind),
            pedestrians=pedestrians,
            goal=tuple(entries.pop("goal")),
            **points,
            **names,
            **entries,
        )
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ScenarioError(
            f"{path}: no record of an interPlan scenario ({error}); apply the modifications again"
        ) from error
