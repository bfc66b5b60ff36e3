"""Rows of a sweep: what was chosen at a point and how it scores."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars

from spdm_experiments.inventory import Entry
from spdm_experiments.record import REASONS
from spdm_experiments.rows import REAL, TEXT, WHOLE, Layout, identity
from spdm_experiments.sweep_scene import Reading
from spdm_jax.results import SCORE_COLUMNS

CHOICE = {
    "num_valid": WHOLE,
    "best": WHOLE,
    "stage": WHOLE,
    "path": WHOLE,
    "policy": WHOLE,
    "target_speed": REAL,
    "total": REAL,
    "no_at_fault_collision": REAL,
    "drivable_area": REAL,
    "driving_direction": REAL,
    "progress": REAL,
    "time_to_collision": REAL,
    "comfort": REAL,
    "progress_raw": REAL,
    "progress_centerline": REAL,
    "progress_goal": REAL,
    "collision_time": REAL,
    "ttc_time": REAL,
    "collision_agent": TEXT,
    "ttc_agent": TEXT,
    "emergency_brake": polars.Boolean,
    "mean_total": REAL,
    "run_ms": REAL,
}
"""Columns that are null where a scenario failed."""


def layout_of(points: Sequence[Mapping[str, Any]]) -> Layout:
    """Returns the columns for the entry "points" of run.json."""
    return Layout.of(points, CHOICE)


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
    values = {name: getattr(reading, name) for name in CHOICE if hasattr(reading, name)}
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
