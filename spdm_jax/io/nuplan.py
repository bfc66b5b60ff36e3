"""nuPlan logs and maps as `RawScenario`, read without the devkit."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from spdm_jax.io.map_query import MapQuery
from spdm_jax.io.nuplan_filter import (
    ScenarioFilter,
    Window,
    apply_filter,
    base_token,
    window_of,
)
from spdm_jax.io.nuplan_log import Boxes, Candidate, NuPlanLog
from spdm_jax.io.nuplan_map import MAP_INDEX, find_map, read_map
from spdm_jax.io.raw import RawMap, RawScenario, RawTracks, ScenarioError
from spdm_jax.types import ObjectType

ROWS_PER_STEP = 2
"""Rows of a log (20 Hz) per step of a scenario (10 Hz)."""
NUM_HISTORY = 22
"""Steps kept before iteration 0: 2 s of planner history and two to differentiate at its start."""
NUM_FUTURE = 80
"""Steps kept after the last iteration: the 8 s that a plan made there reaches."""
EXPERT_HORIZON = 60.0
"""How far the recorded drive is followed to derive a route, s (nuPlan)."""

_MOVING = (ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.BICYCLE)


class NuPlanReader:
    """Reads scenarios from nuPlan log databases; implements `spdm_jax.io.raw.Reader`.

    Every map is parsed once and shared by the scenarios on it.

    Args:
      data_root: a folder with `.db` files at any depth, or one such file.
      map_root: folder with `nuplan-maps-v1.0.json`; by default a folder `maps` beside or above
        the data.
      scenario_filter: which scenarios; by default every sweep that has history and future.
      window: part of the log a scenario takes, for all types; by default nuPlan's (15 s from 3 s
        before the tag; 20 s from the sweep for untagged ones).
      windows: the same for single types, before `window`.

    Attributes:
      notes: remarks about the selection (tokens that no log has, fields not followed).

    Raises:
      ScenarioError: no logs, nothing selected, one token twice, or a file that cannot be read.
    """

    def __init__(
        self,
        data_root: Path | str,
        map_root: Path | str | None = None,
        scenario_filter: ScenarioFilter | None = None,
        *,
        window: Window | None = None,
        windows: Mapping[str, Window] | None = None,
    ) -> None:
        self._filter = scenario_filter or ScenarioFilter()
        self._root = Path(data_root)
        self._logs = _find_logs(self._root, self._filter)
        self._map_root = Path(map_root) if map_root is not None else _beside(self._root)
        self._window, self._windows = window, windows
        self._maps: dict[str, tuple[RawMap, list[str]]] = {}
        self._log: NuPlanLog | None = None
        self._selected = self._select()
        self.notes = [*self._filter.notes, *self._missing()]

    def tokens(self) -> Sequence[str]:
        """Returns the selected tokens, sorted."""
        return list(self._selected)

    def candidate(self, token: str) -> Candidate:
        """Returns what the selection knows of a token: time, type, log and map.

        Raises:
          ScenarioError: the token is not selected.
        """
        if found := self._selected.get(base_token(token)):
            return found
        where = [log for log in self._logs if NuPlanLog(log).has_token(base_token(token))]
        reason = (
            f"it is in {where[0].name}, but the filter or its scene (one of the log's first two or "
            "last two) excludes it"
            if where
            else f"none of the {len(self._logs)} logs has it"
        )
        raise ScenarioError(f"{self._root}: scenario token {token!r} is not selected: {reason}")

    def window(self, token: str) -> Window:
        """Returns the window that applies to a selected token."""
        return window_of(self.candidate(token).scenario_type, self._window, self._windows)

    def map(self, token: str) -> RawMap:
        """Returns the map that a selected token lives in."""
        return self._map(self.candidate(token).map_name)[0]

    def read(self, token: str) -> RawScenario:
        """Reads one selected scenario.

        Raises:
          ScenarioError: not selected, or its log or map lacks something; names file and field.
        """
        chosen = self.candidate(token)
        log, own = self._open(chosen.log), self._iterations(chosen)
        raw_map, notes = self._map(chosen.map_name)
        before = np.arange(NUM_HISTORY, 0, -1) * -ROWS_PER_STEP + own[0]
        after = np.arange(1, NUM_FUTURE + 1) * ROWS_PER_STEP + own[-1]
        before, after = before[before >= 0], after[after < len(log.time_us)]
        rows = np.concatenate([before, own, after])
        tracks, track_notes = _tracks(log.boxes(rows), len(rows))
        ego = np.zeros((len(rows), 11))
        ego[:, :7] = log.ego(rows)
        route = log.route(chosen.token)
        notes = [*notes, *track_notes]
        if len(before) < NUM_HISTORY or len(after) < NUM_FUTURE:
            notes.append(
                f"the log covers {len(before)} of {NUM_HISTORY} steps before iteration 0 and "
                f"{len(after)} of {NUM_FUTURE} after the last"
            )
        if not route:
            notes.append("the scene has no route")
        return RawScenario(
            token=chosen.token,
            log_name=log.name,
            scenario_type=chosen.scenario_type,
            source="nuplan",
            map=raw_map,
            time_us=log.time_us[rows],
            num_history=len(before),
            num_iterations=len(own),
            ego=ego,
            ego_valid=np.ones(len(rows), bool),
            tracks=tracks,
            lights=log.lights(rows),
            route_roadblocks=route,
            mission_goal=log.mission_goal(chosen.token),
            notes=notes,
        )

    def step_tokens(self, token: str) -> list[str]:
        """Returns the sweep token of each iteration of a selected scenario."""
        chosen = self.candidate(token)
        tokens = self._open(chosen.log).tokens
        return [tokens[row] for row in self._iterations(chosen)]

    def expert_route(self, token: str) -> list[str]:
        """Derives the route in roadblocks from the recorded drive after iteration 0.

        It reaches `EXPERT_HORIZON` ahead, or as far as the log goes on after the tagged sweep.
        """
        chosen = self.candidate(token)
        log, start = self._open(chosen.log), self._iterations(chosen)[0]
        horizon = min((log.time_us[-1] - chosen.time_us) * 1e-6, EXPERT_HORIZON)
        count = int(horizon / 0.1)
        if horizon < 0.5:
            return []
        rows = start + np.arange(1, count + 1) * ROWS_PER_STEP
        points = log.ego(rows[rows < len(log.time_us)])[:, :2]
        return MapQuery(self._map(chosen.map_name)[0]).roadblocks_along(points)

    def _select(self) -> dict[str, Candidate]:
        wanted = self._filter
        found: list[Candidate] = []
        for path in self._logs:
            log = NuPlanLog(path)
            if wanted.map_names is None or log.map_name in wanted.map_names:
                found += log.candidates(
                    wanted.base_tokens, wanted.scenario_types, wanted.remove_invalid_goals
                )
        selected: dict[str, Candidate] = {}
        for candidate in apply_filter(found, wanted):
            if twin := selected.get(candidate.token):
                raise ScenarioError(
                    f"scenario token {candidate.token!r} is in {twin.log} and in {candidate.log}; "
                    "keep one copy of the log under the data root"
                )
            selected[candidate.token] = candidate
        if not selected:
            raise ScenarioError(
                f"{self._root}: the filter ({wanted.summary()}) selects nothing from "
                f"{len(self._logs)} log(s); loosen it (scenes without two scenes before and after "
                "them never count)"
            )
        return selected

    def _missing(self) -> list[str]:
        tokens = self._filter.base_tokens or ()
        missing = [token for token in tokens if token not in self._selected]
        if not missing:
            return []
        return [
            f"{len(missing)} of {len(tokens)} scenario_tokens were not found or excluded by other "
            f"fields, the first is {missing[0]}"
        ]

    def _open(self, path: Path) -> NuPlanLog:
        """Keeps the log used last: scenarios are read log by log more often than not."""
        if self._log is None or self._log.path != path:
            self._log = NuPlanLog(path)
        return self._log

    def _map(self, location: str) -> tuple[RawMap, list[str]]:
        if location not in self._maps:
            self._maps[location] = read_map(find_map(self._map_root, location), location)
        return self._maps[location]

    def _iterations(self, chosen: Candidate) -> np.ndarray:
        """Returns the rows of the scenario's own window: every second, both ends inclusive."""
        window = window_of(chosen.scenario_type, self._window, self._windows)
        start = int(chosen.time_us + window.offset * 1e6)
        end = int(start + window.duration * 1e6)
        time = self._open(chosen.log).time_us
        first, last = np.searchsorted(time, start), np.searchsorted(time, end, side="right")
        if first == last:
            raise ScenarioError(
                f"{chosen.log}: no lidar_pc within {window} of scenario token {chosen.token!r}; "
                "use a window that the log covers"
            )
        return np.arange(first, last, ROWS_PER_STEP)


def _find_logs(root: Path, wanted: ScenarioFilter) -> list[Path]:
    if root.is_file():
        paths = [root]
    elif root.is_dir():
        paths = _walk(root)
    else:
        raise ScenarioError(f"{root}: no such file or folder; expected nuPlan logs (.db)")
    if not paths:
        raise ScenarioError(f"{root}: no .db file at any depth; expected nuPlan logs")
    if wanted.log_names is None:
        return paths
    kept = [path for path in paths if path.stem in wanted.log_names]
    if not kept:
        raise ScenarioError(
            f"{root}: none of the {len(wanted.log_names)} log_names is among its {len(paths)} "
            f"logs, the first of which is {paths[0].stem}"
        )
    return kept


def _walk(root: Path) -> list[Path]:
    """Returns all `.db` files below a folder; linked folders count, each real folder once."""
    found: list[Path] = []
    seen: set[str] = set()
    for folder, subfolders, files in os.walk(root, followlinks=True):
        if (real := os.path.realpath(folder)) in seen:
            subfolders.clear()
            continue
        seen.add(real)
        found += [Path(folder, name) for name in files if name.endswith(".db")]
    return sorted(found)


def _beside(root: Path) -> Path:
    """Returns the folder `maps` nearest to the data."""
    for folder in (root.resolve(), *root.resolve().parents):
        if (folder / "maps" / MAP_INDEX).is_file():
            return folder / "maps"
    raise ScenarioError(
        f"{root}: no folder maps/ with {MAP_INDEX} in it or beside a folder above; give map_root"
    )


def _tracks(boxes: Boxes, num_steps: int) -> tuple[RawTracks, list[str]]:
    """Lays boxes out by track and step; returns remarks about repairs.

    Tracks are ordered by their first box in the file. A file may list boxes sweep by sweep or
    track by track; either way, tracks of one sweep keep the order in which nuPlan lists them.
    """
    row_of = {track: row for row, track in enumerate(dict.fromkeys(boxes.track))}
    row = np.array([row_of[track] for track in boxes.track], np.int64)
    shape = (len(row_of), num_steps)
    tracks = RawTracks(
        ids=list(row_of),
        type=np.zeros(len(row_of), np.int64),
        pose=np.zeros((*shape, 3)),
        velocity=np.zeros((*shape, 2)),
        size=np.zeros((*shape, 2)),
        valid=np.zeros(shape, bool),
    )
    moving = np.isin(boxes.type, _MOVING)
    unknown = moving & ~np.isfinite(boxes.velocity).all(axis=1)
    at = (row, boxes.frame)
    tracks.type[row] = boxes.type
    tracks.pose[at] = boxes.pose
    tracks.velocity[at] = np.where((moving & ~unknown)[:, None], boxes.velocity, 0.0)
    tracks.size[at] = boxes.size
    tracks.valid[at] = True
    notes = []
    if unknown.any():
        notes.append(f"{unknown.sum()} boxes have no velocity: taken as standing")
    if repeated := len(row) - int(tracks.valid.sum()):
        notes.append(f"{repeated} boxes repeat a track within a frame: the last one counts")
    return tracks, notes
