"""Reader of the Argoverse 2 sensor data set (boxes, ego poses and vector maps; no sensor data)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spdm_jax.io.av2_log import STEP_NS, AV2Motion, grid_times, read_motion
from spdm_jax.io.av2_map import read_map
from spdm_jax.io.av2_route import SnappedRoute, snap_route
from spdm_jax.io.raw import RawMap, RawScenario, RawTracks, ScenarioError

_STEP_S = STEP_NS / 1e9


@dataclass(frozen=True)
class _Log:
    road_map: RawMap
    motion: AV2Motion
    route: SnappedRoute


class AV2Reader:
    """Scenarios from one log folder or from a folder of log folders.

    A log of the sensor data set lasts about 15.5 s; several start times make several scenarios of
    it. Their windows overlap and share the map. A scenario keeps what the log has: the window, the
    history and the future end with the log, and the scenario's notes say so.

    Derived: velocities, accelerations and steering (see `av2_log`), roadblocks, connectors and
    intersections (`av2_map`), the route (`av2_route`). Unknown in the source, and left so: speed
    limits, traffic lights.

    Tokens are `<first characters of the log id>_<index of the start time>`.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        starts: Sequence[float] | None = None,
        stride_s: float = 0.5,
        duration_s: float = 15.0,
        min_duration_s: float = 6.0,
        num_history: int = 22,
        future_s: float = 8.0,
        wheel_base: float = 3.089,
    ):
        """Finds the logs; reads none of them yet.

        Args:
          root: a folder with `city_SE3_egovehicle.feather`, or a folder of such folders.
          starts: start times, s after the first sweep (rounded to 0.1 s); None for one every
            `stride_s` while `min_duration_s` are left.
          stride_s: see `starts`.
          duration_s: length of a scenario's own window, s.
          min_duration_s: shortest window, where the log ends early, s.
          num_history: steps of 0.1 s before the window.
          future_s: time kept after the window, s.
          wheel_base: of the vehicle that shall plan, m (default: nuPlan's); gives the initial
            steering angle.

        Raises:
          ScenarioError: there is no log at `root`.
          ValueError: a setting is out of range.
        """
        for name, value, least in (
            ("stride_s", stride_s, _STEP_S),
            ("min_duration_s", min_duration_s, _STEP_S),
            ("duration_s", duration_s, min_duration_s),
            ("num_history", num_history, 0),
            ("future_s", future_s, 0.0),
            ("start", min(starts, default=0.0) if starts is not None else 0.0, 0.0),
        ):
            if not value >= least:
                raise ValueError(f"{name} is {value}; it must be at least {least}")
        self._starts = None if starts is None else [_steps(s) for s in starts]
        self._stride = _steps(stride_s)
        self._duration = _steps(duration_s)
        self._min_duration = _steps(min_duration_s)
        self._num_history = num_history
        self._future = _steps(future_s)
        self._wheel_base = wheel_base
        self._logs = _find_logs(Path(root).resolve())
        self._loaded: tuple[str, _Log] | None = None

    def tokens(self) -> list[str]:
        """Returns the tokens of all logs and start times.

        Raises:
          ScenarioError: a log's tables cannot be read, or it is shorter than `min_duration_s`.
        """
        return [
            f"{short}_{index:03d}"
            for short, path in self._logs.items()
            for index in range(len(self._log_starts(path)))
        ]

    def read(self, token: str) -> RawScenario:
        """Reads one scenario; the log is parsed once for tokens that follow each other.

        Raises:
          ScenarioError: no such token, a file of the log is missing or malformed, the log is too
            short for the start time, or the ego is on no lane of the map.
        """
        short, _, index = token.rpartition("_")
        if short not in self._logs or not index.isdecimal():
            raise ScenarioError(
                f"token {token!r} is of none of the logs {', '.join(self._logs)}; "
                "use one of tokens()"
            )
        path = self._logs[short]
        starts = self._log_starts(path)
        if int(index) >= len(starts):
            raise ScenarioError(
                f"token {token!r}: log {path.name} has {len(starts)} start times; "
                "use one of tokens()"
            )
        if self._loaded is None or self._loaded[0] != short:
            self._loaded = (short, _load(path, self._wheel_base))
        return self._cut(token, path, self._loaded[1], starts[int(index)])

    def _log_starts(self, path: Path) -> list[int]:
        if self._starts is not None:
            return self._starts
        last = len(grid_times(path)) - self._min_duration
        if last < 0:
            raise ScenarioError(
                f"{path}: the log has {last + self._min_duration} steps of 0.1 s, "
                f"min_duration_s asks for {self._min_duration}; lower it or drop the log"
            )
        return list(range(0, last + 1, self._stride))

    def _cut(self, token: str, path: Path, log: _Log, start: int) -> RawScenario:
        motion, total = log.motion, len(log.motion.time_ns)
        num_iterations = min(self._duration, total - start)
        if num_iterations < self._min_duration:
            raise ScenarioError(
                f"{path}: start {start * _STEP_S:.1f} s leaves {max(num_iterations, 0)} steps of "
                f"0.1 s, min_duration_s asks for {self._min_duration}; choose an earlier start"
            )
        first = max(start - self._num_history, 0)
        end = start + num_iterations
        last = min(end + self._future, total)
        notes = [*motion.notes, *log.route.notes]
        for name, have, want in (
            ("window", num_iterations, self._duration),
            ("history", start - first, self._num_history),
            ("future", last - end, self._future),
        ):
            if have < want:
                notes.append(f"{name} has {have} of {want} steps: the log has no more")
        if log.route.off_lanes[start]:
            notes.append("route: the ego is on no lane at iteration 0; the nearest in time is used")
        return RawScenario(
            token=token,
            log_name=path.name,
            scenario_type="av2_sensor",
            source="av2",
            map=log.road_map,
            time_us=motion.time_ns[first:last] // 1000,
            num_history=start - first,
            num_iterations=num_iterations,
            ego=motion.ego[first:last].copy(),
            ego_valid=np.ones(last - first, bool),
            tracks=_cut_tracks(motion.tracks, slice(first, last)),
            lights=[{} for _ in range(first, last)],
            route_roadblocks=log.route.roadblocks(log.road_map, start),
            mission_goal=log.route.goal(log.road_map),
            notes=notes,
        )


def _steps(seconds: float) -> int:
    return round(seconds / _STEP_S)


def _find_logs(root: Path) -> dict[str, Path]:
    """Log folders by the shortest prefix of their names (8 characters or more) that tells them."""
    pose = "city_SE3_egovehicle.feather"
    paths = [root] if (root / pose).is_file() else sorted(p.parent for p in root.glob(f"*/{pose}"))
    if not paths:
        raise ScenarioError(
            f"{root}: neither this folder nor one inside it has a {pose}; "
            "pass a log folder of the Argoverse 2 sensor data set, or a folder of them"
        )
    length = 8
    while len({p.name[:length] for p in paths}) < len(paths):
        length += 1
    return {p.name[:length]: p for p in paths}


def _load(path: Path, wheel_base: float) -> _Log:
    archives = sorted((path / "map").glob("log_map_archive_*.json"))
    if len(archives) != 1:
        raise ScenarioError(
            f"{path / 'map'}: {len(archives)} files log_map_archive_*.json; "
            "a log has exactly one map archive"
        )
    road_map = read_map(archives[0])
    motion = read_motion(path, wheel_base=wheel_base)
    return _Log(road_map, motion, snap_route(road_map, motion.ego[:, :3]))


def _cut_tracks(tracks: RawTracks, part: slice) -> RawTracks:
    """The objects seen in a part of the log, in the order of their first appearance there."""
    valid = tracks.valid[:, part]
    seen = np.flatnonzero(valid.any(1))
    rows = seen[np.argsort(valid[seen].argmax(1), kind="stable")]
    return RawTracks(
        ids=[tracks.ids[i] for i in rows],
        type=tracks.type[rows],
        pose=tracks.pose[rows, part],
        velocity=tracks.velocity[rows, part],
        size=tracks.size[rows, part],
        valid=valid[rows],
    )
