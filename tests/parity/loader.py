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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spdm_jax.config import VehicleParams
from spdm_jax.io.map_query import MapQuery
from spdm_jax.io.nuplan import ROWS_PER_STEP, NuPlanReader
from spdm_jax.io.nuplan_filter import OTHER_WINDOW, TAGGED_WINDOW, ScenarioFilter, Window
from spdm_jax.io.nuplan_log import UNTAGGED
from spdm_jax.io.raw import ScenarioError
from spdm_jax.types import LightStatus, ObjectType
from tests.parity.loader_map import check_layer_sizes, check_map, check_points
from tests.parity.loader_table import Row, Table

_WINDOWS = (TAGGED_WINDOW, OTHER_WINDOW, Window(8.0, 0.0))


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
        wanted = ScenarioFilter.from_mapping(query["filter"])
        table.equal("queries", _answer(folder, wanted, windows), query["result"])
    reader = _reader(folder, records, windows)
    for record in records:
        _Scenario(table, reader, record).check(_FIELDS)
    # The recorded map is the one of the recorded log.
    check_map(table, reader.map(records[0]["token"]), _json(folder / "expected_map.json"))


def _answer(folder: Path, wanted: ScenarioFilter, windows: Mapping[str, Window]) -> list[list[Any]]:
    """Returns what a query selects: token, type, iterations, interval."""
    try:
        reader = NuPlanReader(folder, None, wanted, windows=windows)
    except ScenarioError:
        return []  # nuPlan answers with an empty list where the reader complains
    return [
        [
            token,
            reader.candidate(token).scenario_type,
            len(reader.step_tokens(token)),
            0.05 * ROWS_PER_STEP,
        ]
        for token in reader.tokens()
    ]


def _check_devkit(table: Table, folder: Path, golden: Mapping[str, Any]) -> None:
    records = golden["scenarios"]
    windows = _windows(folder, records)
    everything = NuPlanReader(folder, windows=windows)
    found = [[t, everything.candidate(t).scenario_type] for t in everything.tokens()]
    with_goal = NuPlanReader(folder, None, ScenarioFilter(remove_invalid_goals=True))
    table.equal("n_scenarios_unfiltered", len(found), golden["n_scenarios_unfiltered"])
    table.equal("unfiltered_tokens", found, golden["unfiltered_tokens"])
    table.equal("n_scenarios_valid_goal", len(with_goal.tokens()), golden["n_scenarios_valid_goal"])
    types = sorted({kind for _, kind in golden["tagged"]})
    tagged = NuPlanReader(folder, None, ScenarioFilter(scenario_types=tuple(types)))
    pairs = [[t, tagged.candidate(t).scenario_type] for t in tagged.tokens()]
    table.equal("tagged", pairs, golden["tagged"])
    for name, ours in _vehicle().items():
        table.close("ego_parameters", ours, golden["ego_parameters"][name])
    reader = _reader(folder, records, windows)
    for record in records:
        _Scenario(table, reader, record).check(_FIELDS)
    # The recorded trajectory is that of the first scenario's own iterations.
    first = reader.read(records[0]["token"])
    driven = first.ego[first.num_history :][: first.num_iterations, :2]
    route = MapQuery(first.map).roadblocks_along(driven)
    table.equal("devkit_route_from_trajectory", route, golden["devkit_route_from_trajectory"])
    location = golden["map"]["map_name"]
    table.equal("map_name", first.map.name, location)
    check_layer_sizes(table, folder / "maps", location, golden["map"]["layer_sizes"])
    check_map(table, first.map, golden["map"])
    check_points(table, first.map, golden["map"]["points"])


def _windows(folder: Path, records: Sequence[Mapping[str, Any]]) -> dict[str, Window]:
    """Finds, for each scenario type, the window that reproduces the recorded time stamps."""
    windows = {}
    for record in records:
        stamps = record["times_us"]
        steps = record.get("n", record.get("iterations"))
        duration = float(np.ceil((stamps[-1] - stamps[0]) * 1e-6))
        for window in (*_WINDOWS, Window(duration, TAGGED_WINDOW.offset), Window(duration, 0.0)):
            tokens = _reader(folder, [record], {record["type"]: window}).step_tokens(
                record["token"]
            )
            if (len(tokens), tokens[0]) == (steps, record["iteration_tokens"][0]):
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

    def check(self, checks: Mapping[str, Callable[..., None]]) -> None:
        """Compares every recorded field; one that no check knows is a mismatch."""
        for name, value in self.record.items():
            pattern = next((key for key in checks if re.fullmatch(key, name)), None)
            if pattern is None:
                self.table.equal(f"{name} (no check)", None, value)
                continue
            numbers = [int(group) for group in re.findall(r"\d+", name)]
            if "past|future" in pattern:
                steps = self.samples("past" in name, *numbers)
                checks[pattern](self, name, value, steps)
            else:
                checks[pattern](self, value, *numbers)

    def samples(self, past: bool, horizon: int, number: int) -> np.ndarray:
        """Returns the steps of `number` samples of `horizon` s, as nuPlan ranks the log's rows."""
        rank = (int(horizon / 0.05) + 1) // number * np.arange(1, number + 1)
        if (rank % 2).any():
            raise ValueError(f"{number} samples in {horizon} s lie between the steps of 0.1 s")
        steps = self.start + (-rank[::-1] if past else rank) // 2
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

    def interval(self) -> float:
        """Nominal spacing of the steps, s."""
        return round(float(np.median(np.diff(self.ours.time_us))) * 1e-6, 1)

    def ego(self, recorded: Any) -> None:
        """Rows at every tenth iteration, or outline and velocities by iteration."""
        if isinstance(recorded, list):
            self.ego_rows("ego", recorded, self.start + np.arange(0, self.count, 10))
            return
        for iteration, theirs in recorded.items():
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
        if listed != sorted(listed):
            # nuPlan sorts by type and keeps the file's order within; a list sorted by token was
            # sorted for the recording and says nothing about order.
            by_type = sorted(present, key=lambda token: tracks.type[row_of[token]])
            self.table.equal(f"{name} order", by_type, listed)
        rows = [row_of[token] for token in listed if token in row_of]
        if len(rows) != len(theirs):
            return
        kinds = [ObjectType(tracks.type[row]).name for row in rows]
        self.table.equal(f"{name} types", kinds, [entry["type"] for entry in theirs])
        for row, entry in zip(rows, theirs, strict=True):
            self.table.poses(f"{name} pose", tracks.pose[row, step], entry["pose"])
            self.table.close(f"{name} size", tracks.size[row, step], entry["size_lwh"][:2])
            # Static objects have no velocity in the recording; an unknown one is NaN.
            velocity = entry.get("velocity", entry.get("v")) or [0.0, 0.0]
            self.table.close(
                f"{name} velocity", tracks.velocity[row, step], np.nan_to_num(velocity)
            )
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

    def light_iterations(self, by_iteration: Mapping[str, Any]) -> None:
        """Lights by iteration."""
        for iteration, entries in by_iteration.items():
            self.lights(entries, int(iteration))

    def lights(self, entries: Sequence[Sequence[Any]], iteration: int) -> None:
        """Lights of an iteration, by connector; the record's order of fields differs."""
        step, theirs = self.start + iteration, {}
        for entry in entries:
            status = next(x for x in entry if isinstance(x, str))
            theirs[str(next(x for x in entry if isinstance(x, int)))] = int(LightStatus[status])
            if len(entry) > 2:
                self.table.equal("lights time", int(self.ours.time_us[step]), entry[2])
        self.table.equal("lights", self.ours.lights[step], theirs)


def _center(ego: np.ndarray) -> np.ndarray:
    """Returns box-centre poses `[N, 3]` of rear-axle states."""
    shift = float(VehicleParams().rear_axle_to_center)
    direction = np.stack([np.cos(ego[:, 2]), np.sin(ego[:, 2])], axis=1)
    return np.column_stack([ego[:, :2] + shift * direction, ego[:, 2]])


def _corners(ego: np.ndarray) -> np.ndarray:
    """Returns the ego's corners: front left, rear left, rear right, front right."""
    x, y, heading = _center(ego[None])[0]
    half_length, half_width = VehicleParams().length / 2, VehicleParams().width / 2
    offsets = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [half_length, half_width]
    c, s = np.cos(heading), np.sin(heading)
    return [x, y] + offsets @ np.array([[c, s], [-s, c]])


# Patterns with "past|future" get the steps of their samples, others the numbers in their name.
_FIELDS: dict[str, Callable[..., None]] = {
    "token": lambda s, _: s.equal("token", s.ours.token),
    "log|log_name": lambda s, v: s.table.equal("log_name", s.ours.log_name, v),
    "type": lambda s, _: s.equal("type", s.ours.scenario_type),
    "map|map_name": lambda s, v: s.table.equal("map_name", s.ours.map.name, v),
    "n|iterations": lambda s, v: s.table.equal("iterations", s.count, v),
    "interval|database_interval": lambda s, v: s.table.close("interval", s.interval(), v),
    "start_time_us": lambda s, _: s.equal("start_time_us", s.own_times()[0]),
    # The recording's durations went through seconds in floating point and lost up to 1 us.
    "duration_us": lambda s, v: s.table.close(
        "duration_us", s.own_times()[-1] - s.own_times()[0], v, 1.0
    ),
    "duration_s": lambda s, v: s.table.close(
        "duration_s", (s.own_times()[-1] - s.own_times()[0]) * 1e-6, v, 1.1e-6
    ),
    "iteration_tokens": _Scenario.iteration_tokens,
    "times_us": _Scenario.times,
    "ego": _Scenario.ego,
    r"ego_(past|future)_\d+s_\d+": _Scenario.ego_rows,
    r"(past|future)_timestamps_\d+s_\d+": _Scenario.time_samples,
    r"tracks_iter\d+": lambda s, v, i: s.tracks("tracks", v, s.start + i),
    r"tracks_(past|future)_\d+s_\d+": _Scenario.track_samples,
    "objects": _Scenario.track_iterations,
    "object_counts": _Scenario.object_counts,
    r"(past|future)_object_counts_\d+s_\d+": _Scenario.sample_counts,
    r"lights_iter\d+": _Scenario.lights,
    "traffic_lights": _Scenario.light_iterations,
    "route_roadblock_ids": lambda s, _: s.equal("route_roadblock_ids", s.ours.route_roadblocks),
    "roadblocks_from_expert": lambda s, _: s.equal(
        "roadblocks_from_expert", s.reader.expert_route(s.token)
    ),
    "mission_goal": lambda s, v: s.table.poses("mission_goal", s.ours.mission_goal, v),
    "expert_goal": lambda s, v: s.table.poses(
        "expert_goal", s.ours.ego[s.start + s.count - 1, :3], v
    ),
}
