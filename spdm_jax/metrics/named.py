"""Metrics under nuPlan's names, and what cost a run its points (host)."""

from typing import Any, NamedTuple

import jax
import numpy as np

from spdm_jax.metrics.closed import ClosedLoopMetrics
from spdm_jax.metrics.collisions import OBJECT_CLASSES
from spdm_jax.metrics.comfort import NUM_BOUNDED, SERIES
from spdm_jax.metrics.params import MetricConfig, MetricParams, OpenLoopParams
from spdm_jax.metrics.plans import OpenLoopMetrics
from spdm_jax.metrics.score import OPEN_LOOP_SCORED, SCORED

Statistics = dict[str, dict[str, float]]
"""Metric -> statistic -> value, both under nuPlan's names."""

_OPEN_LOOP_SHORT = {
    "planner_expert_average_l2_error_within_bound": ("ADE", 0),
    "planner_expert_final_l2_error_within_bound": ("FDE", 1),
    "planner_expert_average_heading_error_within_bound": ("AHE", 2),
    "planner_expert_final_heading_error_within_bound": ("FHE", 3),
}


def statistics(metrics: ClosedLoopMetrics, params: MetricParams | None = None) -> Statistics:
    """Statistics of one run; those that nuPlan leaves out of its results are left out.

    Args:
      metrics: of one run.
      params: thresholds that they were computed with; the official ones if None.
    """
    params = MetricParams() if params is None else params
    m = jax.tree.map(np.asarray, metrics)
    result: Statistics = {}
    for i, name in enumerate(SERIES):
        result[name] = _summary(name, m.comfort.summary, i)
        if i < NUM_BOUNDED:
            result[name][f"abs_{name}_within_bounds"] = float(m.comfort.within[i])
    for i, name in enumerate(("ego_expert_l2_error", "ego_expert_l2_error_with_yaw")):
        both = _summary(name, m.expert_errors.summary, i)
        del both[f"min_{name}"]
        result[name] = both
    score = dict(zip(SCORED, (float(v) for v in m.scores), strict=True))
    result["ego_mean_speed"] = {"ego_mean_speed_value": float(m.mean_speed)}

    along = {"expert_total_progress_along_route": float(m.progress.expert_total)}
    if m.progress.has_route:
        along["ego_total_progress_along_route"] = float(m.progress.ego_total)
    along["ego_expert_progress_along_route_ratio"] = float(m.progress.ratio)
    result["ego_progress_along_expert_route"] = along
    result["drivable_area_compliance"] = {"drivable_area_compliance": float(m.drivable_area.score)}
    result["corners_in_drivable_area"] = {
        "corners_in_drivable_area": float(m.drivable_area.always_inside)
    }

    contacts = m.collisions
    hits = {
        "no_ego_at_fault_collisions": float(contacts.count.sum() == 0),
        "number_of_all_at_fault_collisions": float(contacts.count.sum()),
    }
    for kind, count in zip(OBJECT_CLASSES, contacts.count, strict=True):
        hits[f"number_of_at_fault_collisions_with_{kind}"] = float(count)
    for i, kind in enumerate(OBJECT_CLASSES):
        if contacts.count[i]:
            for word in ("max", "min", "mean"):
                value = getattr(contacts, f"energy_{word}")[i]
                hits[f"{word}_collision_energy_with_{kind}"] = float(value)
    result["no_ego_at_fault_collisions"] = hits
    result["time_to_collision_within_bound"] = {
        "min_time_to_collision": float(m.time_to_collision.minimum),
        "time_to_collision_within_bound": float(m.time_to_collision.score),
    }

    limit, compliant = m.speed_limit, {}
    if limit.number:
        compliant = {
            "number_of_violations_of_speed_limit_compliance": float(limit.number),
            "max_violation_of_speed_limit_compliance": float(limit.highest),
            "min_violation_of_speed_limit_compliance": float(limit.lowest),
            "mean_violation_of_speed_limit_compliance": float(limit.mean),
        }
    result["speed_limit_compliance"] = compliant | {
        "speed_limit_compliance": float(limit.number == 0)
    }
    for name in ("ego_is_comfortable", "ego_is_making_progress"):
        result[name] = {name: score[name]}
    result["driving_direction_compliance"] = {
        "driving_direction_compliance_score": score["driving_direction_compliance"],
        "min_progress_along_driving_direction_in_1_second_interval": float(
            m.driving_direction.minimum
        ),
    }

    changes = {"number_of_ego_lane_change": float(m.lane_changes.number)}
    fine = True
    if m.lane_changes.number:
        failed = float(m.lane_changes.failed_ratio)
        changes["max_ego_lane_change_duration"] = float(m.lane_changes.longest)
        changes["avg_ego_lane_change_duration"] = float(m.lane_changes.mean)
        changes["ratio_of_failed_ego_lane_change"] = failed
        fine = failed <= params.lane_change_fail_rate
    changes["ego_lane_change_fail_rate_below_threshold"] = float(fine)
    result["ego_lane_change"] = changes
    return result


def _summary(name: str, summary: Any, row: int) -> dict[str, float]:
    words = {"max": "maximum", "min": "minimum", "avg": "mean", "p90": "p90"}
    return {f"{word}_{name}": float(getattr(summary, field)[row]) for word, field in words.items()}


def series(metrics: ClosedLoopMetrics) -> dict[str, np.ndarray]:
    """Time series of one run over its real samples, by the name of the result they belong to."""
    m = jax.tree.map(np.asarray, metrics)
    result = dict(zip(SERIES, m.comfort.values, strict=True))
    result["ego_expert_l2_error"], result["ego_expert_l2_error_with_yaw"] = m.expert_errors.values
    result["ego_progress_along_expert_route"] = m.progress.values
    result["corners_in_drivable_area"] = m.drivable_area.inside.astype(float)
    result["time_to_collision_within_bound"] = m.time_to_collision.values
    result["speed_limit_compliance"] = m.speed_limit.over
    result["driving_direction_compliance"] = m.driving_direction.values
    return {name: values[m.valid] for name, values in result.items()}


def open_loop_statistics(
    metrics: OpenLoopMetrics,
    params: OpenLoopParams | None = None,
    config: MetricConfig | None = None,
) -> Statistics:
    """Statistics of the plans of one scenario.

    Args:
      metrics: of one scenario.
      params: thresholds that they were computed with; the official ones if None.
      config: horizons that they were computed with.
    """
    config = MetricConfig() if config is None else config
    params = OpenLoopParams() if params is None else params
    m = jax.tree.map(np.asarray, metrics)
    horizons = config.comparison_horizons
    bounds = (params.max_displacement, params.max_heading)
    result: Statistics = {}
    for name, (short, row) in _OPEN_LOOP_SHORT.items():
        values = {
            f"planner_expert_{short}_horizon_{h}": float(m.by_horizon[row, i])
            for i, h in enumerate(horizons)
        }
        values[name] = float(m.mean[row] <= bounds[row // 2])
        values[f"avg_planner_expert_{short}_over_all_horizons"] = float(m.mean[row])
        result[name] = values
    misses = {
        f"planner_miss_rate_horizon_{h}": float(m.miss_rate[i]) for i, h in enumerate(horizons)
    }
    name = OPEN_LOOP_SCORED[0]
    result[name] = misses | {name: float(m.scores[0])}
    return result


def open_loop_series(metrics: OpenLoopMetrics) -> dict[str, np.ndarray]:
    """Errors of each plan, averaged over the horizons, by metric."""
    by_sample = np.asarray(metrics.by_sample)
    return {name: by_sample[row] for name, (_, row) in _OPEN_LOOP_SHORT.items()}


class LostPoint(NamedTuple):
    """Something that cost a run points.

    Attributes:
      metric: nuPlan's name of the scored metric.
      score: of that metric.
      time: s, when it happened first; None for a metric about the whole run.
      object: row of the object involved; None if there is none.
      detail: what happened, in words.
    """

    metric: str
    score: float
    time: float | None
    object: int | None
    detail: str


def lost_points(metrics: ClosedLoopMetrics, time: np.ndarray) -> list[LostPoint]:
    """What cost one run its points, in the order of `SCORED`.

    Args:
      metrics: of one run.
      time: `[T]` s of its samples.
    """
    m = jax.tree.map(np.asarray, metrics)
    score = dict(zip(SCORED, (float(v) for v in m.scores), strict=True))
    lost: list[LostPoint] = []

    def add(metric: str, when: np.ndarray | None, item: int | None, detail: str) -> None:
        moment = None if when is None or not when.any() else float(time[int(when.argmax())])
        lost.append(LostPoint(metric, score[metric], moment, item, detail))

    for metric, value in score.items():
        if value >= 1:
            continue
        if np.isnan(value):
            add(metric, None, None, "the run is too short to tell")
        elif metric == "no_ego_at_fault_collisions":
            for row in np.flatnonzero(m.collisions.at_fault):
                when = np.arange(len(time)) == m.collisions.time_index[row]
                energy = float(m.collisions.energy[row])
                add(metric, when, int(row), f"collision at fault, {energy:.2f} m/s")
        elif metric == "drivable_area_compliance":
            add(metric, m.drivable_area.far.any(1), None, "a corner leaves the drivable area")
        elif metric == "driving_direction_compliance":
            values = m.driving_direction.values
            when = values == values.min()
            add(metric, when, None, f"{-values.min():.2f} m against the traffic within 1 s")
        elif metric == "time_to_collision_within_bound":
            values = m.time_to_collision.values
            when = values == values.min()
            item = int(m.time_to_collision.object[int(when.argmax())])
            add(metric, when, item, f"{values.min():.1f} s to a collision")
        elif metric == "speed_limit_compliance":
            over = m.speed_limit.over
            add(metric, over > 0, None, f"up to {over.max():.2f} m/s over the limit")
        elif metric == "ego_is_comfortable":
            for row in np.flatnonzero(~m.comfort.within):
                add(metric, m.comfort.outside[row], None, f"{SERIES[row]} out of bounds")
        else:
            ego, expert = float(m.progress.ego_total), float(m.progress.expert_total)
            add(metric, None, None, f"{ego:.1f} m of the expert's {expert:.1f} m")
    return lost
