"""Rows of a sweep: one per scenario and point, always of the same columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars

from spdm_experiments.inventory import Entry
from spdm_experiments.record import REASONS
from spdm_experiments.sweep_grid import varying
from spdm_experiments.sweep_scene import Reading
from spdm_jax import Failure
from spdm_jax.results import SCORE_COLUMNS

_TEXT, _WHOLE, _REAL = polars.String, polars.Int32, polars.Float32
_IDENTITY = {"token": _TEXT, "log_name": _TEXT, "map_name": _TEXT, "scenario_type": _TEXT}
_POINT = {"point": _WHOLE, "planner": _TEXT, "num_proposals": _WHOLE}
_CHOICE = {
    "num_valid": _WHOLE,
    "best": _WHOLE,
    "stage": _WHOLE,
    "path": _WHOLE,
    "policy": _WHOLE,
    "target_speed": _REAL,
    "total": _REAL,
    "no_at_fault_collision": _REAL,
    "drivable_area": _REAL,
    "driving_direction": _REAL,
    "progress": _REAL,
    "time_to_collision": _REAL,
    "comfort": _REAL,
    "progress_raw": _REAL,
    "progress_centerline": _REAL,
    "progress_goal": _REAL,
    "collision_time": _REAL,
    "ttc_time": _REAL,
    "collision_agent": _TEXT,
    "ttc_agent": _TEXT,
    "emergency_brake": polars.Boolean,
    "mean_total": _REAL,
    "run_ms": _REAL,
}
"""Columns that are null where a scenario failed."""
_OUTCOME = {"status": _TEXT, "reason": _TEXT}


@dataclass(frozen=True)
class Layout:
    """Columns of a sweep's rows.

    Attributes:
      points: the points as run.json holds them.
      names: settings that differ between them; each is a column.
    """

    points: Sequence[Mapping[str, Any]]
    names: Sequence[str]

    @staticmethod
    def of(points: Sequence[Mapping[str, Any]]) -> "Layout":
        """Returns the layout for the entry "points" of run.json."""
        return Layout(points, varying(points))

    @property
    def schema(self) -> dict[str, Any]:
        """Column -> type."""
        text = lambda name: isinstance(self.points[0][name], str | list)
        settings = {name: _TEXT if text(name) else polars.Float64 for name in self.names}
        return {**_IDENTITY, **_POINT, **settings, **_CHOICE, **_OUTCOME}

    def point(self, number: int) -> dict[str, Any]:
        """Returns what all rows of a point have in common."""
        entry = self.points[number]
        plain = lambda v: ",".join(f"{x:g}" for x in v) if isinstance(v, list) else v
        return {name: plain(entry[name]) for name in (*_POINT, *self.names)}

    def frame(self, rows: Sequence[Mapping[str, Any]]) -> polars.DataFrame:
        """Returns rows as a table; what a row lacks is null."""
        schema = self.schema
        columns = {name: [row.get(name) for row in rows] for name in schema}
        return polars.DataFrame(columns, schema=schema)


def identity(entry: Entry) -> dict[str, Any]:
    """Returns the columns that say which scenario a row is of."""
    return {name: getattr(entry, name) for name in _IDENTITY}


def failed_rows(layout: Layout, failures: Sequence[tuple[Failure, Entry | None]]) -> list[dict]:
    """Returns a row per point for scenarios that could not be computed.

    Args:
      layout: columns.
      failures: with what is known of the scenario.
    """
    return [
        {
            "token": failure.token,
            **(identity(entry) if entry else {}),
            **layout.point(number),
            "status": "failed",
            "reason": failure.reason,
        }
        for failure, entry in failures
        for number in range(len(layout.points))
    ]


def scored_rows(
    layout: Layout,
    entries: Sequence[Entry],
    track_ids: Sequence[Sequence[str]],
    reading: Reading,
    points: Sequence[int],
    run_ms: float,
) -> list[dict]:
    """Returns the rows of one run.

    Args:
      layout: columns.
      entries: `[B]` scenarios.
      track_ids: `[B]` source ids of their tracks.
      reading: NumPy leaves `[B, C]`, `overflow` included.
      points: `[C]` points that were read.
      run_ms: of one scenario.
    """
    values = {name: getattr(reading, name) for name in _CHOICE if hasattr(reading, name)}
    values |= {name: reading.scores[name] for name in SCORE_COLUMNS}
    rows = []
    for i, entry in enumerate(entries):
        agent = lambda track, i=i: track_ids[i][track] if track >= 0 else None
        for c, number in enumerate(points):
            row = {**identity(entry), **layout.point(number), "reason": ""}
            row["status"] = status(reading, i, c)
            if row["status"] == "ok":
                row |= {name: value[i, c].item() for name, value in values.items()}
                row["collision_agent"] = agent(reading.collision_track[i, c])
                row["ttc_agent"] = agent(reading.ttc_track[i, c])
                row["run_ms"] = run_ms
            else:
                row["reason"] = REASONS[row["status"]]
            rows.append(row)
    return rows


def status(reading: Reading, scene: int, column: int) -> str:
    """Returns "ok", "overflow" (a buffer was too small) or "failed" (not finite)."""
    if reading.overflow[scene, column]:
        return "overflow"
    return "ok" if reading.finite[scene, column] else "failed"


def poses_of(
    reading: Reading, tokens: Sequence[str], points: Sequence[int], origins: np.ndarray
) -> dict[str, np.ndarray]:
    """Returns the chosen proposals' poses in map coordinates, one entry per row that is "ok".

    Args:
      reading: NumPy leaves `[B, C]`, poses included.
      tokens: `[B]`.
      points: `[C]`.
      origins: `[B, 2]` of the scenarios' local frames, float64.
    """
    assert reading.poses is not None
    good = [
        (i, c)
        for i in range(len(tokens))
        for c in range(len(points))
        if status(reading, i, c) == "ok"
    ]
    scene = np.array([i for i, _ in good], int)
    column = np.array([c for _, c in good], int)

    def in_map(local: np.ndarray) -> np.ndarray:
        poses = np.asarray(local[scene, column], np.float64)
        poses[..., :2] += origins[scene, None]
        return poses

    return {
        "token": np.array([tokens[i] for i in scene], str),
        "point": np.array([points[c] for c in column], np.int32),
        "reference": in_map(reading.poses.reference),
        "tracked": in_map(reading.poses.tracked),
    }
