"""Compares the nuPlan reader with recorded answers of nuPlan's own classes.

Two layouts are understood, wherever they lie:

- `expected.json` and `expected_map.json` beside `maps/` and `nuplan-v1.1/`;
- `golden_devkit.json` beside the same two folders.

Windows of scenario types are found from the recorded time stamps, since the recordings use other
ones than nuPlan's defaults. Not compared, because the library does not keep them: tokens of single
boxes, box heights.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from spdm_jax.config import VehicleParams
from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.nuplan import NuPlanReader
from spdm_jax.io.nuplan_filter import OTHER_WINDOW, TAGGED_WINDOW, ScenarioFilter, Window
from spdm_jax.io.nuplan_log import UNTAGGED
from spdm_jax.io.nuplan_map import find_map, line_headings, read_layers
from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawScenario
from spdm_jax.types import LightStatus, ObjectType

TOLERANCE = 1e-6  # m, rad, m/s; both sides compute in float64 from the same files
AREA_TOLERANCE = 1e-3  # m^2, areas of outlines at 4e6 m from the origin
CURVATURE_TOLERANCE = 1e-6  # 1/m

_WINDOWS = (TAGGED_WINDOW, OTHER_WINDOW, Window(8.0, 0.0))
_POINT_LAYERS = {
    "LANE": MapLayer.LANE,
    "LANE_CONNECTOR": MapLayer.LANE_CONNECTOR,
    "ROADBLOCK": MapLayer.ROADBLOCK,
    "ROADBLOCK_CONNECTOR": MapLayer.ROADBLOCK_CONNECTOR,
    "INTERSECTION": MapLayer.INTERSECTION,
    "CROSSWALK": MapLayer.CROSSWALK,
    "WALKWAYS": MapLayer.WALKWAY,
    "CARPARK_AREA": MapLayer.CAR_PARK,
    "STOP_LINE": MapLayer.STOP_LINE,
    "DRIVABLE_AREA": MapLayer.DRIVABLE,
}


@dataclass
class Row:
    """One compared quantity.

    Attributes:
      name: the recording's name of it.
      deviation: largest absolute difference of its numbers.
      mismatches: discrete differences: ids, texts, counts, shapes.
      tolerance: bound on `deviation`.
      count: values compared.
    """

    name: str
    tolerance: float
    deviation: float = 0.0
    mismatches: int = 0
    count: int = 0

    @property
    def ok(self) -> bool:
        """Whether numbers are within the tolerance and nothing discrete differs."""
        return self.deviation <= self.tolerance and not self.mismatches and self.count > 0


@dataclass
class Table:
    """Rows by name."""

    rows: dict[str, Row] = field(default_factory=dict)

    def _row(self, name: str, tolerance: float) -> Row:
        return self.rows.setdefault(name, Row(name, tolerance))

    def equal(self, name: str, ours: Any, theirs: Any) -> None:
        """Compares something discrete."""
        row = self._row(name, 0.0)
        row.count += 1
        row.mismatches += ours != theirs

    def close(self, name: str, ours: Any, theirs: Any, tolerance: float = TOLERANCE) -> None:
        """Compares numbers; None equals None, a difference of shape is a mismatch."""
        row = self._row(name, tolerance)
        row.count += 1
        if ours is None or theirs is None:
            row.mismatches += ours is not theirs
            return
        a, b = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
        if a.shape != b.shape or not np.isfinite(a).all() or not np.isfinite(b).all():
            row.mismatches += 1
        elif a.size:
            row.deviation = max(row.deviation, float(np.abs(a - b).max()))

    def poses(self, name: str, ours: Any, theirs: Any) -> None:
        """Compares `[..., 3]` poses, headings modulo a full turn."""
        if ours is None or theirs is None or np.shape(ours) != np.shape(theirs):
            return self.close(name, ours, theirs)
        a, b = np.asarray(ours, np.float64), np.array(theirs, np.float64)
        b[..., 2] += 2 * np.pi * np.round((a[..., 2] - b[..., 2]) / (2 * np.pi))
        return self.close(name, a, b)

    def same_keys(self, name: str, ours: Iterable[str], theirs: Iterable[str]) -> None:
        """Compares two sets of ids and counts the ids that only one side has."""
        row = self._row(name, 0.0)
        row.count += 1
        row.mismatches += len(set(ours) ^ set(theirs))


def check_loader_golden(folder: Path) -> list[Row]:
    """Compares everything recorded in a folder, or in each of its sub-folders.

    Raises:
      ValueError: neither layout is found.
    """
    if (folder / "expected.json").is_file() or (folder / "golden_devkit.json").is_file():
        folders = [folder]
    else:
        found = [*folder.rglob("expected.json"), *folder.rglob("golden_devkit.json")]
        folders = sorted({path.parent for path in found if (path.parent / "maps").is_dir()})
    if not folders:
        raise ValueError(f"{folder}: no expected.json and no golden_devkit.json beside a maps/")
    rows = []
    for place in folders:
        table = Table()
        for name, check in (("expected", _check_expected), ("golden_devkit", _check_devkit)):
            if (place / f"{name}.json").is_file():
                check(table, place, _json(place / f"{name}.json"))
        for row in table.rows.values():
            row.name = f"{place.name}/{row.name}"
        rows += table.rows.values()
    return rows


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


# ---------------------------------------------------------------------------------- scenarios


def _check_expected(table: Table, folder: Path, golden: Mapping[str, Any]) -> None:
    records = golden["scenarios"]
    windows = _windows(folder, records)
    for query in golden["queries"]:
        reader = NuPlanReader(folder, None, ScenarioFilter(**query["filter"]), windows=windows)
        result = []
        for token in reader.tokens():
            scenario = reader.read(token)
            interval = round(float(np.median(np.diff(scenario.time_us))) * 1e-6, 1)
            kind, steps = scenario.scenario_type, scenario.num_iterations
            result.append([token, kind, steps, interval])
        table.equal("queries", result, query["result"])
    reader = _reader(folder, records, windows)
    for record in records:
        _Scenario(table, reader, record).check(_EXPECTED)
    maps = {location: token for token in reader.tokens()
            if (location := reader.candidate(token).map_name)}  # fmt: skip
    for token in maps.values():
        _check_map(table, reader.map(token), _json(folder / "expected_map.json"))


def _check_devkit(table: Table, folder: Path, golden: Mapping[str, Any]) -> None:
    records = golden["scenarios"]
    windows = _windows(folder, records)
    everything = NuPlanReader(folder, windows=windows)
    found = [[t, everything.candidate(t).scenario_type] for t in everything.tokens()]
    with_goal = NuPlanReader(folder, None, ScenarioFilter(remove_invalid_goals=True))
    table.equal("n_scenarios_unfiltered", len(found), golden["n_scenarios_unfiltered"])
    table.equal("unfiltered_tokens", found, golden["unfiltered_tokens"])
    table.equal(
        "n_scenarios_valid_goal", len(with_goal.tokens()), golden["n_scenarios_valid_goal"]
    )
    types = sorted({kind for _, kind in golden["tagged"]})
    tagged = NuPlanReader(folder, None, ScenarioFilter(scenario_types=types))
    pairs = [[t, tagged.candidate(t).scenario_type] for t in tagged.tokens()]
    table.equal("tagged", pairs, golden["tagged"])
    for name, ours in _vehicle().items():
        table.close("ego_parameters", ours, golden["ego_parameters"][name])
    reader = _reader(folder, records, windows)
    for record in records:
        _Scenario(table, reader, record).check(_DEVKIT)
    route = golden["devkit_route_from_trajectory"]
    # The recording is that of its first scenario.
    table.equal("devkit_route_from_trajectory", reader.expert_route(records[0]["token"]), route)
    location = golden["map"]["map_name"]
    table.equal("map_name", reader.candidate(records[0]["token"]).map_name, location)
    raw_map = reader.map(records[0]["token"])
    _check_layer_sizes(table, folder, location, raw_map, golden["map"]["layer_sizes"])
    _check_map(table, raw_map, golden["map"])
    _check_points(table, MapQuery(raw_map), golden["map"]["points"])


def _windows(folder: Path, records: Sequence[Mapping[str, Any]]) -> dict[str, Window]:
    """Finds, for each scenario type, the window that reproduces the recorded time stamps."""
    windows = {}
    for record in records:
        stamps = record["times_us"]
        steps = record.get("n", record.get("iterations"))
        duration = float(np.ceil((stamps[-1] - stamps[0]) * 1e-6))
        for window in (*_WINDOWS, Window(duration, TAGGED_WINDOW.offset), Window(duration, 0.0)):
            scenario = _reader(folder, [record], {record["type"]: window}).read(record["token"])
            own = scenario.time_us[scenario.num_history :][: scenario.num_iterations]
            if [own[0], own[-1], len(own)] == [stamps[0], stamps[-1], steps]:
                windows[record["type"]] = window
                break
    return windows


def _reader(
    folder: Path, records: Sequence[Mapping[str, Any]], windows: Mapping[str, Window]
) -> NuPlanReader:
    types = sorted({record["type"] for record in records})
    return NuPlanReader(
        folder,
        None,
        ScenarioFilter(
            scenario_tokens=tuple(record["token"] for record in records),
            scenario_types=None if UNTAGGED in types else tuple(types),
        ),
        windows=windows,
    )


def _vehicle() -> dict[str, float]:
    p = VehicleParams()
    length, width, center = float(p.length), float(p.width), float(p.rear_axle_to_center)
    return {
        "width": width,
        "length": length,
        "half_width": width / 2,
        "half_length": length / 2,
        "front_length": length / 2 + center,
        "rear_length": length / 2 - center,
        "wheel_base": float(p.wheel_base),
        "rear_axle_to_center": center,
    }


class _Scenario:
    """One recorded scenario against what the reader gives."""

    def __init__(self, table: Table, reader: NuPlanReader, record: Mapping[str, Any]) -> None:
        self.table, self.reader, self.record = table, reader, record
        self.token: str = record["token"]
        self.ours = reader.read(self.token)
        self.start, self.count = self.ours.num_history, self.ours.num_iterations

    def check(self, checks: Mapping[str, Callable[["_Scenario", Any], None]]) -> None:
        """Compares every recorded field; one that no check knows is a mismatch."""
        for name, value in self.record.items():
            key = next((pattern for pattern in checks if re.fullmatch(pattern, name)), None)
            if key is None:
                self.table.equal(f"{name} (no check)", None, value)
            else:
                checks[key](self, value) if "(" not in key else self.ranked(checks[key], name)

    def ranked(self, check: Callable[..., None], name: str) -> None:
        """Calls a check of samples before or after iteration 0, as nuPlan ranks them."""
        check(self, name, self.record[name], self.samples(name))

    def samples(self, name: str) -> np.ndarray:
        """Returns the steps of `..._past_2s_20`-like names: ranks of rows, ascending in time."""
        direction, horizon, number = re.fullmatch(r".*_(past|future)\w*_(\d+)s_(\d+)", name).groups()  # type: ignore[union-attr]
        step = (int(int(horizon) / 0.05) + 1) // int(number)
        offsets = np.arange(1, int(number) + 1) * step
        if (offsets % 2).any():
            raise ValueError(f"{name}: samples lie between the steps of 0.1 s")
        offsets = -offsets[::-1] // 2 if direction == "past" else offsets // 2
        steps = self.start + offsets
        return steps[(steps >= 0) & (steps < len(self.ours.time_us))]

    def equal(self, name: str, ours: Any) -> None:
        """Compares a discrete field."""
        self.table.equal(name, ours, self.record[name])

    def own_times(self) -> list[int]:
        """Time stamps of the iterations, us."""
        return self.ours.time_us[self.start : self.start + self.count].tolist()

    def iteration_tokens(self, theirs: Sequence[str]) -> None:
        """The recordings keep the first few and, in one layout, the last."""
        ours = self.reader.step_tokens(self.token)
        picked = ours[: len(theirs)]
        if picked != list(theirs):
            picked = [*ours[: len(theirs) - 1], ours[-1]]
        self.table.equal("iteration_tokens", picked, list(theirs))

    def times(self, theirs: Sequence[int]) -> None:
        """All time stamps, or the first two and the last."""
        ours = self.own_times()
        picked = ours if len(theirs) == len(ours) else [*ours[: len(theirs) - 1], ours[-1]]
        self.table.equal("times_us", picked, list(theirs))

    def ego_rows(self, name: str, rows: Sequence[Sequence[float]], steps: np.ndarray) -> None:
        """Rows of time, pose, velocity, acceleration, centre; or of pose and time."""
        if len(rows) != len(steps):
            self.table.equal(f"{name} count", len(steps), len(rows))
            return
        ego, stamps = self.ours.ego[steps], self.ours.time_us[steps].tolist()
        values = np.array(rows, np.float64).reshape(len(steps), -1)
        if values.shape[1] == 4:
            self.table.poses(name, ego[:, :3], values[:, :3])
            self.table.equal(f"{name} time", stamps, [int(row[3]) for row in rows])
            return
        self.table.equal(f"{name} time", stamps, [int(row[0]) for row in rows])
        self.table.poses(name, ego[:, :3], values[:, 1:4])
        self.table.close(name, ego[:, 3:7], values[:, 4:8])
        self.table.close(name, _center(ego)[:, :2], values[:, 8:10])

    def ego_every_ten(self, rows: Sequence[Sequence[float]]) -> None:
        """Ego at every tenth iteration."""
        self.ego_rows("ego", rows, self.start + np.arange(0, self.count, 10))

    def ego_details(self, details: Mapping[str, Mapping[str, Any]]) -> None:
        """Ego with its outline and velocities, by iteration."""
        for iteration, theirs in details.items():
            step = self.start + int(iteration)
            ego = self.ours.ego[step]
            self.table.equal("ego time_us", int(self.ours.time_us[step]), theirs["time_us"])
            self.table.poses("ego rear", ego[:3], theirs["rear"])
            self.table.poses("ego center", _center(ego[None])[0], theirs["center"])
            self.table.close("ego corners", _corners(ego), theirs["corners"])
            for name, ours in {
                "v_rear": ego[3:5],
                "v_center": ego[3:5],
                "a_rear": ego[5:7],
                "speed": np.hypot(*ego[3:5]),
                "steering": ego[7],
                "yaw_rate": ego[9],
            }.items():
                self.table.close(f"ego {name}", ours, theirs[name])

    def tracks(self, name: str, theirs: Sequence[Mapping[str, Any]], step: int) -> None:
        """All objects of one step, in the recording's order."""
        tracks = self.ours.tracks
        row_of = {token: row for row, token in enumerate(tracks.ids)}
        present = [tracks.ids[row] for row in np.flatnonzero(tracks.valid[:, step])]
        listed = [entry["track_token"] for entry in theirs]
        self.table.same_keys(f"{name} tokens", present, listed)
        self.table.equal(f"{name} order", present, listed)
        rows = [row_of[token] for token in listed if token in row_of]
        if len(rows) != len(theirs):
            return
        kinds = [ObjectType(tracks.type[row]).name for row in rows]
        self.table.equal(f"{name} types", kinds, [entry["type"] for entry in theirs])
        get = lambda *names: [next(e[n] for n in names if n in e) for e in theirs]
        velocity = np.array([v or [0.0, 0.0] for v in get("v", "velocity")], np.float64)
        pose, size = get("pose"), [lwh[:2] for lwh in get("size_lwh")]
        if theirs:
            self.table.poses(f"{name} pose", tracks.pose[rows, step], pose)
            self.table.close(f"{name} size", tracks.size[rows, step], size)
            velocity = np.nan_to_num(velocity, nan=0.0)
            self.table.close(f"{name} velocity", tracks.velocity[rows, step], velocity)
        stamps = {entry["time_us"] for entry in theirs if "time_us" in entry}
        self.table.equal(f"{name} time", stamps <= {int(self.ours.time_us[step])}, True)

    def track_samples(
        self, name: str, theirs: Sequence[Sequence[Mapping[str, Any]]], steps: np.ndarray
    ) -> None:
        """Objects of several steps."""
        self.table.equal(f"{name} count", len(steps), len(theirs))
        for step, objects in zip(steps, theirs, strict=False):
            self.tracks(name, objects, int(step))

    def track_iterations(self, by_iteration: Mapping[str, Any]) -> None:
        """Objects by iteration."""
        for iteration, objects in by_iteration.items():
            self.tracks("objects", objects, self.start + int(iteration))

    def object_counts(self, theirs: Sequence[int]) -> None:
        """Number of objects at each iteration."""
        own = slice(self.start, self.start + self.count)
        self.table.equal("object_counts", self._present(own).tolist(), list(theirs))

    def sample_counts(self, name: str, theirs: Sequence[int], steps: np.ndarray) -> None:
        """Number of objects at samples."""
        self.table.equal(name, self._present(steps).tolist(), list(theirs))

    def _present(self, steps: Any) -> np.ndarray:
        return self.ours.tracks.valid[:, steps].sum(axis=0)

    def time_samples(self, name: str, theirs: Sequence[int], steps: np.ndarray) -> None:
        """Time stamps of samples."""
        self.table.equal(name, self.ours.time_us[steps].tolist(), list(theirs))

    def lights(self, entries: Sequence[Sequence[Any]], iteration: int) -> None:
        """Lights of an iteration, by connector; the record's order of fields differs."""
        step, theirs = self.start + iteration, {}
        for entry in entries:
            status = next(x for x in entry if isinstance(x, str))
            theirs[str(next(x for x in entry if isinstance(x, int)))] = int(LightStatus[status])
            if len(entry) > 2:
                self.table.equal("lights time", int(self.ours.time_us[step]), entry[2])
        self.table.equal("lights", self.ours.lights[step], theirs)


_COMMON: dict[str, Callable[..., None]] = {
    "token": lambda s, _: s.equal("token", s.ours.token),
    "type": lambda s, _: s.equal("type", s.ours.scenario_type),
    "iteration_tokens": _Scenario.iteration_tokens,
    "times_us": _Scenario.times,
    "route_roadblock_ids": lambda s, _: s.equal("route_roadblock_ids", s.ours.route_roadblocks),
    "mission_goal": lambda s, v: s.table.poses("mission_goal", s.ours.mission_goal, v),
    "expert_goal": lambda s, v: s.table.poses(
        "expert_goal", s.ours.ego[s.start + s.count - 1, :3], v
    ),
    r"ego_(past|future)_\d+s_\d+": _Scenario.ego_rows,
    r"(past|future)_timestamps_\d+s_\d+": _Scenario.time_samples,
    r"_?(past|future)_object_counts_\d+s_\d+": _Scenario.sample_counts,
    r"tracks_(past|future)_\d+s_\d+": _Scenario.track_samples,
}
