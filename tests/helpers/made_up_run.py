"""Writes run folders of the form that `spdm sweep` writes, with made-up scores."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars

POINT = {
    "horizon": 8.0,
    "forecast": "constant_velocity",
    "progress_reference": "auto",
    "tracker": "reference",
}
GRID: list[dict[str, Any]] = [
    {**POINT, "point": i, "planner": planner, "num_proposals": count}
    for i, (planner, count) in enumerate(
        [("PDM-Closed", 3), ("PDM-Closed", 15), *(("SPDM", n) for n in (15, 20, 30, 45, 60))]
    )
]
GATES = ("no_at_fault_collision", "drivable_area", "driving_direction")
SCORES = ("total", *GATES, "progress", "time_to_collision", "comfort", "progress_raw")
COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("token", "log_name", "map_name", "scenario_type"), polars.String),
    "point": polars.Int32,
    "planner": polars.String,
    **dict.fromkeys(("num_proposals", "num_valid"), polars.Int32),
    **dict.fromkeys((*SCORES, "collision_time", "ttc_time", "run_ms"), polars.Float32),
    **dict.fromkeys(("collision_agent", "ttc_agent"), polars.String),
    "emergency_brake": polars.Boolean,
    **dict.fromkeys(("status", "reason"), polars.String),
}
"""Columns of the rows, as far as reports look at them; what a row lacks is null."""


def scored_rows(
    points: Sequence[Mapping[str, Any]], tokens: Sequence[str], seed: int = 0
) -> list[dict[str, Any]]:
    """Returns plausible rows: more proposals score better, every rule is broken somewhere."""
    scenes, generator = np.random.default_rng(0), np.random.default_rng(seed)
    hardness, fortune = scenes.uniform(size=len(tokens)), scenes.uniform(size=(len(tokens), 6))
    rows = []
    for number, point in enumerate(points):
        skill = 0.5 + 0.5 * np.log2(point["num_proposals"]) / 6
        for token, hard, lot in zip(tokens, hardness, fortune, strict=True):
            luck = np.clip(lot + 0.05 * generator.normal(size=6), 0, 1)
            holds = luck[:5] < 1 - 0.6 * hard * (1.1 - skill)
            terms = dict(zip((*GATES, "time_to_collision", "comfort"), holds.tolist(), strict=True))
            terms = {name: float(value) for name, value in terms.items()}
            progress = float(np.clip(skill - 0.4 * hard + 0.25 * luck[5], 0, 1))
            gates = float(np.prod([terms[name] for name in GATES]))
            weighted = 5 * progress + 5 * terms["time_to_collision"] + 2 * terms["comfort"]
            collides, close = terms[GATES[0]] < 1, terms["time_to_collision"] < 1
            rows.append(
                {
                    "token": token,
                    "log_name": "made-up log",
                    "map_name": "made-up map",
                    "scenario_type": token.rsplit("-", 1)[0],
                    "point": number,
                    "planner": point["planner"],
                    "num_proposals": point["num_proposals"],
                    "num_valid": point["num_proposals"],
                    "total": gates * weighted / 12,
                    **terms,
                    "progress": progress,
                    "progress_raw": 40 * progress,
                    "collision_time": 2.3 if collides else np.inf,
                    "ttc_time": 1.1 if close else np.inf,
                    "collision_agent": "car-7" if collides else None,
                    "ttc_agent": "car-2" if close else None,
                    "emergency_brake": bool(collides and hard > 0.7),
                    "run_ms": 4.0 + 0.2 * point["num_proposals"],
                    "status": "ok",
                    "reason": "",
                }
            )
    return rows


def failed_rows(
    points: Sequence[Mapping[str, Any]], token: str, reason: str, status: str = "failed"
) -> list[dict[str, Any]]:
    """Returns the rows of a scenario without scores."""
    return [
        {
            "token": token,
            "point": number,
            "planner": point["planner"],
            "num_proposals": point["num_proposals"],
            "status": status,
            "reason": reason,
        }
        for number, point in enumerate(points)
    ]


def stage_rows(points: Sequence[Mapping[str, Any]], tokens: Sequence[str]) -> list[dict[str, Any]]:
    """Returns times of stages that grow with the number of proposals."""
    rows = []
    for point in points:
        count = point["num_proposals"]
        times = {
            "proposals": 2 + 0.05 * count,
            "tracking": 0.04 * count,
            "scoring": 1 + 0.1 * count,
        }
        times["total"] = 0.9 * sum(times.values()) + 0.5
        for at, token in enumerate(tokens):
            for stage, time in times.items():
                rows.append(
                    {
                        "planner": point["planner"],
                        "num_proposals": count,
                        "stage": stage,
                        "median_ms": time * (1 + 0.1 * at),
                        "min_ms": 0.9 * time,
                        "repetitions": 15,
                        "token": token,
                    }
                )
    return rows


def write_run(
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    *,
    points: Sequence[Mapping[str, Any]] = GRID,
    stages: Sequence[Mapping[str, Any]] = (),
    parts: int = 2,
    **about: Any,
) -> Path:
    """Writes a run folder.

    Args:
      folder: made if absent.
      rows: one per (scenario, grid point).
      points: grid.
      stages: rows of stages.parquet, if any.
      parts: files to spread the rows over.
      about: fields of run.json that differ from the usual.
    """
    (folder / "rows").mkdir(parents=True, exist_ok=True)
    tokens = sorted({row["token"] for row in rows})
    for part in range(parts):
        mine = set(tokens[part::parts])
        part_rows = [row for row in rows if row["token"] in mine]
        columns = {name: [row.get(name) for row in part_rows] for name in COLUMNS}
        frame = polars.DataFrame(columns, schema=COLUMNS)
        frame.write_parquet(folder / "rows" / f"part-{part:05d}.parquet")
    if stages:
        polars.DataFrame(stages).write_parquet(folder / "stages.parquet")
    described = {
        "format": 1,
        "command": "sweep",
        "suite": "pack (built-in scenes)",
        "scenes": "pack",
        "num_scenarios": len(tokens),
        "input_hash": "0" * 16,
        "seed": 0,
        "precision": "f32",
        "points": list(points),
        "config": {},
        "versions": {"spdm-jax": "0.1.0", "jax": "0.10.2"},
        "commit": "0123456789ab",
        "device": "cpu (cpu)",
        "created": "2026-11-25T10:00:00+00:00",
        **about,
    }
    (folder / "run.json").write_text(json.dumps(described), encoding="utf-8")
    return folder
