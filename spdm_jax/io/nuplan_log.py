"""One nuPlan log database (`.db`, SQLite), read without the devkit.

Facts of the format that decide results:

- Tokens are 8-byte blobs; their public form is 16 lower-case hex digits.
- The time of an ego state is that of its lidar sweep, its pose that of the linked `ego_pose` row.
- Ego poses are the rear axle with velocities in the body frame; boxes are centres with velocities
  along the map axes.
- Sweeps come at a nominal 20 Hz. "The next 2 s" means the next 40 rows, not a span of time.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from spdm_jax.io.raw import ScenarioError
from spdm_jax.types import LightStatus, ObjectType

UNTAGGED = "unknown"
"""Scenario type of a sweep that carries no tag."""
LIDAR_CHANNEL = "MergedPointCloud"

_COLUMNS = {
    "log": ("map_version",),
    "lidar": ("token", "channel"),
    "lidar_pc": ("token", "timestamp", "ego_pose_token", "lidar_token", "scene_token"),
    "ego_pose": (
        *("token", "x", "y", "qw", "qx", "qy", "qz", "vx", "vy"),
        *("acceleration_x", "acceleration_y"),
    ),
    "lidar_box": ("lidar_pc_token", "track_token", "x", "y", "width", "length", "vx", "vy", "yaw"),
    "track": ("token", "category_token"),
    "category": ("token", "name"),
    "scene": ("token", "name", "goal_ego_pose_token", "roadblock_ids"),
    "scenario_tag": ("lidar_pc_token", "type"),
    "traffic_light_status": ("lidar_pc_token", "lane_connector_id", "status"),
}
_CATEGORIES = {
    "vehicle": ObjectType.VEHICLE,
    "pedestrian": ObjectType.PEDESTRIAN,
    "bicycle": ObjectType.BICYCLE,
    "traffic_cone": ObjectType.TRAFFIC_CONE,
    "barrier": ObjectType.BARRIER,
    "czone_sign": ObjectType.CZONE_SIGN,
    "generic_object": ObjectType.GENERIC_OBJECT,
}
_LIGHTS = {"green": LightStatus.GREEN, "yellow": LightStatus.YELLOW, "red": LightStatus.RED}


@dataclass(frozen=True)
class Candidate:
    """A sweep that may start a scenario.

    Attributes:
      token: 16 hex digits.
      time_us: its time stamp.
      scenario_type: the alphabetically last of its (accepted) tags, or `UNTAGGED`.
      log: file it comes from.
      map_name: location of the map.
    """

    token: str
    time_us: int
    scenario_type: str
    log: Path
    map_name: str


@dataclass(frozen=True)
class Boxes:
    """Detected boxes of a few sweeps, in file order.

    Attributes:
      frame: `[K]` int, index of the sweep among those asked for.
      track: `[K]` track tokens.
      type: `[K]` int, `ObjectType`.
      pose: `[K, 3]` centre x, y, heading.
      velocity: `[K, 2]` as stored, NaN where the file has none.
      size: `[K, 2]` length, width.
    """

    frame: np.ndarray
    track: list[str]
    type: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    size: np.ndarray


class NuPlanLog:
    """Queries over one log database; opens the file read-only, once per query.

    Args:
      path: the `.db` file; its stem is the log's name.

    Raises:
      ScenarioError: no SQLite file, or a table or column that the reader needs is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._cursor() as cursor:
            for table, columns in _COLUMNS.items():
                found = {row[1] for row in cursor.execute(f"PRAGMA table_info({table})")}
                if not found:
                    raise ScenarioError(
                        f"{path}: table {table!r} is missing; this is no nuPlan v1.1 log database"
                    )
                if missing := [c for c in columns if c not in found]:
                    raise ScenarioError(
                        f"{path}: table {table!r} lacks the column(s) {missing}; "
                        "use a log of nuPlan v1.1"
                    )
            names = cursor.execute("SELECT map_version FROM log").fetchall()
        if len(names) != 1 or not names[0][0]:
            raise ScenarioError(
                f"{path}: log.map_version is {[n[0] for n in names]}; expected one location name"
            )
        self.map_name: str = names[0][0]

    @property
    def name(self) -> str:
        """Log name: the file name without `.db`."""
        return self.path.stem

    @contextmanager
    def _cursor(self) -> Iterator[sqlite3.Cursor]:
        """Yields a cursor on the read-only file; SQLite's complaints become `ScenarioError`."""
        connection = None
        try:
            connection = sqlite3.connect(self.path.resolve().as_uri() + "?mode=ro", uri=True)
            yield connection.cursor()
        except sqlite3.Error as error:
            raise ScenarioError(
                f"{self.path}: not a readable SQLite database ({error}); it may be truncated, "
                "fetch or copy it again"
            ) from error
        finally:
            if connection is not None:
                connection.close()

    @cached_property
    def _rows(self) -> tuple[list[bytes], np.ndarray]:
        """Tokens and time stamps (us) of all sweeps in time order."""
        with self._cursor() as cursor:
            rows = cursor.execute(
                "SELECT lp.token, lp.timestamp FROM lidar_pc lp "
                "JOIN lidar l ON l.token = lp.lidar_token AND l.channel = ? "
                "ORDER BY lp.timestamp, lp.rowid",
                (LIDAR_CHANNEL,),
            ).fetchall()
        return [row[0] for row in rows], np.array([row[1] for row in rows], np.int64)

    @property
    def time_us(self) -> np.ndarray:
        """`[M]` int64 time stamps of all sweeps (20 Hz), ascending."""
        return self._rows[1]

    @cached_property
    def tokens(self) -> list[str]:
        """Tokens of all sweeps in time order."""
        return [token.hex() for token in self._rows[0]]

    def candidates(
        self,
        tokens: Sequence[str] | None = None,
        types: Sequence[str] | None = None,
        require_goal: bool = False,
    ) -> list[Candidate]:
        """Returns the sweeps that may start a scenario, in time order.

        The first two and the last two scenes of a log (by name) are left out, so that history and
        future exist. Of several tags on one sweep the alphabetically last accepted one counts.

        Args:
          tokens: accept only these.
          types: accept only sweeps tagged with one of these.
          require_goal: accept only sweeps whose scene has a mission goal.
        """
        where = ["s.rank >= 3", "s.rank < s.total - 1"]
        values: list[str] = [LIDAR_CHANNEL]
        goal = "JOIN ego_pose g ON g.token = s.goal_ego_pose_token" if require_goal else ""
        if tokens is not None:
            where.append("lp.token IN (SELECT token FROM wanted)")
        if types is not None:
            where.append(f"st.type IN ({_marks(types)})")
            values += types
        with self._cursor() as cursor:
            # The temporary table lives in memory; it has no limit on the number of tokens.
            cursor.execute("PRAGMA temp_store = MEMORY")
            cursor.execute("CREATE TEMP TABLE wanted (token BLOB PRIMARY KEY)")
            cursor.executemany(
                "INSERT OR IGNORE INTO wanted VALUES (?)",
                [(bytes.fromhex(token),) for token in tokens or ()],
            )
            rows = cursor.execute(
                "WITH s AS (SELECT token, goal_ego_pose_token, "
                "ROW_NUMBER() OVER (ORDER BY name) AS rank, COUNT(*) OVER () AS total FROM scene) "
                "SELECT lp.token, lp.timestamp, MAX(st.type) FROM lidar_pc lp "
                "JOIN lidar l ON l.token = lp.lidar_token AND l.channel = ? "
                f"JOIN s ON s.token = lp.scene_token {goal} "
                "LEFT JOIN scenario_tag st ON st.lidar_pc_token = lp.token "
                f"WHERE {' AND '.join(where)} GROUP BY lp.token ORDER BY lp.timestamp, lp.rowid",
                values,
            ).fetchall()
        return [
            Candidate(token.hex(), time, kind or UNTAGGED, self.path, self.map_name)
            for token, time, kind in rows
        ]

    def has_token(self, token: str) -> bool:
        """Tells whether a sweep with this token exists at all."""
        with self._cursor() as cursor:
            found = cursor.execute(
                "SELECT 1 FROM lidar_pc WHERE token = ?", (bytes.fromhex(token),)
            ).fetchone()
        return found is not None

    def ego(self, rows: np.ndarray) -> np.ndarray:
        """Returns recorded ego states at the rear axle.

        Args:
          rows: `[T]` indices into `time_us`.

        Returns:
          `[T, 7]` x, y, heading, vx, vy, ax, ay; velocity and acceleration in the body frame.
        """
        found = self._by_sweep(
            rows,
            "SELECT lp.token, e.x, e.y, e.qw, e.qx, e.qy, e.qz, e.vx, e.vy, "
            "e.acceleration_x, e.acceleration_y FROM lidar_pc lp "
            "JOIN ego_pose e ON e.token = lp.ego_pose_token WHERE lp.token IN ({})",
        )
        state = np.full((len(rows), 10), np.nan)
        for frame, values in found:
            state[frame] = values
        if not np.isfinite(state).all():
            bad = self.tokens[rows[np.flatnonzero(~np.isfinite(state).all(axis=1))[0]]]
            raise ScenarioError(
                f"{self.path}: ego_pose of lidar_pc {bad} is missing or not finite; "
                "leave this scenario out or fetch the log again"
            )
        heading = _yaw(state[:, 2:6])
        return np.concatenate([state[:, :2], heading[:, None], state[:, 6:]], axis=1)

    def boxes(self, rows: np.ndarray) -> Boxes:
        """Returns all boxes of the sweeps `rows` (`[T]` indices into `time_us`).

        Raises:
          ScenarioError: a category that nuPlan does not define.
        """
        found = self._by_sweep(
            rows,
            "SELECT b.lidar_pc_token, b.track_token, c.name, b.x, b.y, b.yaw, b.vx, b.vy, "
            "b.length, b.width FROM lidar_box b JOIN track t ON t.token = b.track_token "
            "JOIN category c ON c.token = t.category_token "
            "WHERE b.lidar_pc_token IN ({}) ORDER BY b.rowid",
        )
        if unknown := {values[1] for _, values in found} - _CATEGORIES.keys():
            raise ScenarioError(
                f"{self.path}: category.name is {sorted(unknown)}; known are {sorted(_CATEGORIES)}"
            )
        numbers = np.array([values[2:] for _, values in found], np.float64).reshape(-1, 7)
        return Boxes(
            frame=np.array([frame for frame, _ in found], np.int64),
            track=[values[0].hex() for _, values in found],
            type=np.array([_CATEGORIES[values[1]] for _, values in found], np.int64),
            pose=numbers[:, :3],
            velocity=numbers[:, 3:5],
            size=numbers[:, 5:],
        )

    def lights(self, rows: np.ndarray) -> list[dict[str, int]]:
        """Returns, per sweep of `rows`, lane-connector id -> `LightStatus`."""
        found = self._by_sweep(
            rows,
            "SELECT lidar_pc_token, lane_connector_id, status FROM traffic_light_status "
            "WHERE lidar_pc_token IN ({}) ORDER BY rowid",
        )
        lights: list[dict[str, int]] = [{} for _ in rows]
        for frame, (connector, status) in found:
            lights[frame][str(connector)] = int(_LIGHTS.get(status, LightStatus.UNKNOWN))
        return lights

    def route(self, token: str) -> list[str]:
        """Returns the roadblock ids of the scene that the sweep `token` belongs to."""
        with self._cursor() as cursor:
            row = cursor.execute(
                "SELECT s.roadblock_ids FROM lidar_pc lp JOIN scene s ON s.token = lp.scene_token "
                "WHERE lp.token = ?",
                (bytes.fromhex(token),),
            ).fetchone()
        text: str = row[0] if row and row[0] else ""
        # The files separate by blanks; the format's description speaks of commas.
        return text.replace(",", " ").split()

    def mission_goal(self, token: str) -> np.ndarray | None:
        """Returns the goal (`[3]` x, y, heading) of the scene of `token`, None without one."""
        with self._cursor() as cursor:
            row = cursor.execute(
                "SELECT g.x, g.y, g.qw, g.qx, g.qy, g.qz FROM lidar_pc lp "
                "JOIN scene s ON s.token = lp.scene_token "
                "JOIN ego_pose g ON g.token = s.goal_ego_pose_token WHERE lp.token = ?",
                (bytes.fromhex(token),),
            ).fetchone()
        if row is None:
            return None
        pose = np.array(row, np.float64)
        return np.array([pose[0], pose[1], _yaw(pose[None, 2:])[0]])

    def _by_sweep(self, rows: np.ndarray, query: str) -> list[tuple[int, tuple]]:
        """Runs a query whose first column is a sweep token; returns (index in `rows`, rest)."""
        tokens = [self._rows[0][row] for row in rows]
        frame = {token: i for i, token in enumerate(tokens)}
        with self._cursor() as cursor:
            found = cursor.execute(query.format(_marks(tokens)), tokens).fetchall()
        return [(frame[row[0]], row[1:]) for row in found]


def _marks(values: Sequence[object]) -> str:
    return ",".join("?" * len(values))


def _yaw(quaternion: np.ndarray) -> np.ndarray:
    """Returns the heading of `[N, 4]` quaternions (w, x, y, z), rad.

    The first angle of the rotation order x-y-z, which nuPlan's headings are; for a tilted vehicle
    it differs by some 1e-4 rad from the direction of the body's x axis (there: + x y).
    """
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    return np.arctan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
