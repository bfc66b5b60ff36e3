"""Rows of a simulation: one per scenario and point, in closed or in open loop."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
import polars

from spdm_experiments.inventory import Entry
from spdm_experiments.rows import POINT, REAL, TEXT, WHOLE, Layout, identity
from spdm_experiments.simulate_scene import Result
from spdm_experiments.simulate_terms import INTERPLAN
from spdm_jax.interplan.score import LANE_CHANGES, InterplanMetrics
from spdm_jax.metrics import OPEN_LOOP_SCORED, SCORED
from spdm_jax.metrics.named import LostPoint, lost_points
from spdm_jax.types import ObjectType

FIXED = {**POINT, "traffic": TEXT, "mode": TEXT}
METRICS = {"closed": SCORED, "open": OPEN_LOOP_SCORED}
"""Scored metrics by mode, under nuPlan's names."""
LOST = polars.List(
    polars.Struct(
        {
            "metric": polars.String,
            "score": polars.Float32,
            "time": polars.Float32,
            "object": polars.String,
            "object_type": polars.String,
            "detail": polars.String,
        }
    )
)
VALUES = {
    "score": REAL,
    **dict.fromkeys((*SCORED, *OPEN_LOOP_SCORED, *INTERPLAN), REAL),
    "progress_m": REAL,
    "expert_progress_m": REAL,
    "mean_speed": REAL,
    "min_time_to_collision": REAL,
    "collisions": WHOLE,
    "collision_time": REAL,
    "collision_object": TEXT,
    "collision_object_type": TEXT,
    "speed_limit_violations": WHOLE,
    "lane_changes": WHOLE,
    "ade": REAL,
    "fde": REAL,
    "skipped_agents": WHOLE,
    "samples": WHOLE,
    "lost": LOST,
    "run_ms": REAL,
}
"""Columns that are null where a scenario failed; those of the other mode are null as well."""
REASONS = {
    "overflow": "more path points, red lights or agents than there is room for, also when driven "
    "again with more of it; use the Python API with a larger PlannerConfig or AgentSizes",
    "planner": "the planner returned a number that is not finite after {time:.1f} s",
    "short": "the record ends before the last plan does, so that it cannot be compared; pack with "
    "8 s beyond the window, or use --mode closed",
    "unknown": "{metric} could not be computed: the run has {samples} samples",
}


def layout_of(points: Sequence[Mapping[str, Any]]) -> Layout:
    """Returns the columns for the entry "points" of run.json."""
    return Layout.of(points, VALUES, FIXED)


def result_rows(
    layout: Layout,
    entries: Sequence[Entry],
    track_ids: Sequence[Sequence[str]],
    kinds: np.ndarray,
    result: Result,
    point: int,
    run_ms: float,
    verdicts: Sequence[InterplanMetrics] | None = None,
) -> list[dict[str, Any]]:
    """Returns the rows of one point.

    Args:
      layout: columns.
      entries: `[B]` scenarios.
      track_ids: `[B]` source ids of their tracks.
      kinds: `[B, A]` types of the tracks.
      result: NumPy leaves `[B, ...]`.
      point: number of the point.
      run_ms: of one scenario.
      verdicts: `[B]` interPlan's, None for scenarios without extras.
    """
    about = layout.point(point)
    rows = []
    for i, entry in enumerate(entries):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], result.replace(kept=None))
        status, reason = _status(one, about["mode"])
        row = {**identity(entry), **about, "status": status, "reason": reason}
        if status == "ok":
            row |= {"samples": int(one.samples), "run_ms": run_ms}
            row["skipped_agents"] = int(one.skipped_agents)
            row |= _scores(one, about["mode"])
            if about["mode"] == "closed":
                row |= _closed(one, track_ids[i], kinds[i])
                if verdicts is not None:
                    row |= _changed(verdicts[i])
                    row["lost"] += _lost_by_changes(verdicts[i], row)
            else:
                row |= {"ade": float(one.metrics.mean[0]), "fde": float(one.metrics.mean[1])}
        rows.append(row)
    return rows


def _status(one: Result, mode: str) -> tuple[str, str]:
    """Returns status and reason of one run."""
    if one.overflow:
        return "overflow", REASONS["overflow"]
    if one.failed:
        return "failed", REASONS["planner"].format(time=0.1 * int(one.samples))
    if one.short:
        return "failed", REASONS["short"]
    scores = np.asarray(one.metrics.scores)
    if not np.isfinite(scores).all():
        metric = METRICS[mode][int(np.argmin(np.isfinite(scores)))]
        return "failed", REASONS["unknown"].format(metric=metric, samples=int(one.samples))
    return "ok", ""


def _scores(one: Result, mode: str) -> dict[str, Any]:
    values = np.asarray(one.metrics.scores).tolist()
    return {"score": float(one.metrics.final), **dict(zip(METRICS[mode], values, strict=True))}


def _closed(one: Result, track_ids: Sequence[str], kinds: np.ndarray) -> dict[str, Any]:
    metrics: Any = one.metrics
    time = np.asarray(one.time)
    name = lambda row: None if row is None or row < 0 else track_ids[row]
    kind = lambda row: None if row is None or row < 0 else ObjectType(int(kinds[row])).name.lower()
    lost: list[LostPoint] = lost_points(metrics, time)
    contacts = metrics.collisions
    hits = np.flatnonzero(contacts.at_fault)
    first = min(hits.tolist(), key=lambda row: contacts.time_index[row], default=None)
    return {
        "progress_m": float(metrics.progress.ego_total),
        "expert_progress_m": float(metrics.progress.expert_total),
        "mean_speed": float(metrics.mean_speed),
        "min_time_to_collision": float(metrics.time_to_collision.minimum),
        "collisions": int(contacts.count.sum()),
        "collision_time": None if first is None else float(time[contacts.time_index[first]]),
        "collision_object": name(first),
        "collision_object_type": kind(first),
        "speed_limit_violations": int(metrics.speed_limit.number),
        "lane_changes": int(metrics.lane_changes.number),
        "lost": [
            {
                "metric": point.metric,
                "score": point.score,
                "time": point.time,
                "object": name(point.object),
                "object_type": kind(point.object),
                "detail": point.detail,
            }
            for point in lost
        ],
    }


def _changed(verdict: InterplanMetrics) -> dict[str, Any]:
    """interPlan's columns; a metric that could not be computed is null."""
    scores = {"interplan_score": verdict.final, **verdict.scores}
    known = lambda name: name in scores and np.isfinite(scores[name])
    return {name: float(scores[name]) if known(name) else None for name in INTERPLAN}


def _lost_by_changes(verdict: InterplanMetrics, row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What cost points of interPlan's score alone."""
    changes, found = verdict.lane_changes, {}
    if changes.score < 1:
        count = lambda value: "unknown" if value is None else str(value)
        found[LANE_CHANGES] = (
            f"lane changes to the goal: {count(changes.at_start)} at the start, "
            f"{count(changes.at_end)} left at the end"
        )
    ratio = row["ego_progress_along_expert_route"]
    for name in INTERPLAN:
        if name.startswith("ego_sorts") and row[name] == 0:
            found[name] = (
                f"stays behind: progress {ratio:.2f} of the {verdict.required_progress:.2f} that "
                "it takes"
            )
    none = {"time": None, "object": None, "object_type": None}
    return [
        {"metric": name, "score": verdict.scores[name], "detail": detail, **none}
        for name, detail in found.items()
    ]


def histories_of(
    result: Result,
    tokens: Sequence[str],
    track_ids: Sequence[Sequence[str]],
    point: int,
    origins: np.ndarray,
) -> dict[str, np.ndarray]:
    """Returns recorded runs as arrays to write, one entry per scenario.

    Args:
      result: NumPy leaves `[B, ...]`, `kept` included.
      tokens: `[B]`.
      track_ids: `[B]` source ids of their tracks.
      point: number of the point.
      origins: `[B, 2]` of the scenarios' local frames, in which all poses are, float64.
    """
    assert result.kept is not None
    history = result.kept.history
    objects = history.objects
    ego = history.ego
    rows = objects.x.shape[-1]
    ids = [(*names, *[""] * (rows - len(names))) for names in track_ids]
    arrays = {
        "token": np.array(tokens, str),
        "point": np.full(len(tokens), point, np.int32),
        "origin": np.asarray(origins, np.float64),
        "samples": np.asarray(result.samples),
        "time": history.time,
        "ego": np.stack([getattr(ego, name) for name in ego.__dataclass_fields__], axis=-1),
        "objects": np.stack([getattr(objects, name) for name in OBJECT_COLUMNS], axis=-1),
        "object_valid": objects.valid,
        "object_type": objects.type,
        "object_id": np.array(ids, str),
        "lights": history.lights,
    }
    if result.kept.plans is not None:
        arrays["plans"] = result.kept.plans
    single = lambda v: v.astype(np.float32) if v.dtype == np.float64 else v
    return {name: v if name == "origin" else single(np.asarray(v)) for name, v in arrays.items()}


OBJECT_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
"""What "objects" of a recorded run holds, in order."""
