"""`nuplan_metrics` goldens: closed-loop and open-loop metrics, intermediates, scores."""

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.metrics import (
    OPEN_LOOP_SCORED,
    SCORED,
    ClosedLoopMetrics,
    Expert,
    ExpertPoses,
    MetricConfig,
    MetricParams,
    OpenLoopParams,
    closed_loop,
    comparison_indices,
    open_loop,
)
from spdm_jax.metrics.named import (
    open_loop_series,
    open_loop_statistics,
    series,
    statistics,
)
from spdm_jax.simulation.controller import Plan
from spdm_jax.simulation.history import History, Snapshot
from spdm_jax.types import CollisionKind, EgoState, ScenarioMap

from .devkit_map import DevkitMap, load_devkit_map
from .world import pad, power_bucket

# Float32: positions keep 1e-5 m, differences over 0.1 s of them 1e-3 and worse.
VALUE_TOLERANCE = {"f64": 1e-6, "f32": 5e-3}
SCORE_TOLERANCE = {"f64": 1e-9, "f32": 1e-3}
SAMPLE_ROOM = 160

closed_loop_jit = jax.jit(closed_loop, static_argnames="config")
open_loop_jit = jax.jit(open_loop, static_argnames="config")

# The unit scenes name one metric otherwise than the full runs.
RENAMED = {"no_ego_at_fault_collision": "no_ego_at_fault_collisions"}
# Thresholds of the unit scenes, by their names there.
PARAMS = {
    "min_lon_accel": "lon_accel_min",
    "max_lon_accel": "lon_accel_max",
    "max_abs_lat_accel": "lat_accel_max",
    "max_abs_mag_jerk": "jerk_max",
    "max_abs_lon_jerk": "lon_jerk_max",
    "max_abs_yaw_rate": "yaw_rate_max",
    "max_abs_yaw_accel": "yaw_accel_max",
    "score_progress_threshold": "progress_threshold",
    "min_progress_threshold": "min_progress_ratio",
    "least_min_ttc": "least_ttc",
    "max_overspeed_value_threshold": "max_overspeed",
    "driving_direction_compliance_threshold": "direction_compliant",
    "driving_direction_violation_threshold": "direction_violation",
    "time_horizon": "direction_horizon",
    "driving_direction_horizon_s": "direction_horizon",
    "heading_diff_weight": "heading_weight",
    "drivable_area_max_violation_threshold": "max_outside",
    "max_fail_rate": "lane_change_fail_rate",
}


def check_metrics(path: Path, report, dtype) -> bool:
    """Compares one case; False where the file is no case of these folders."""
    described = path.with_suffix(".json")
    if not described.exists():
        return False
    case = json.loads(described.read_text(encoding="utf-8"))
    if "expected" not in case or not case.keys() & {"metric", "expected_scores"}:
        return False
    expected = case["expected"]
    if isinstance(expected, list):
        expected = {case["metric"]: expected}
    data = np.load(path)
    name = f"{path.parent.name}/{path.stem}"
    if any(metric.startswith("planner_") for metric in expected):
        metrics = _open_metrics(case, data, dtype)
        names, values, curves = OPEN_LOOP_SCORED, open_loop_statistics(metrics), None
        curves = open_loop_series(metrics)
    else:
        metrics, world = closed_metrics(case, data, path, dtype)
        names, curves = SCORED, series(metrics)
        values = statistics(metrics, metric_params(case.get("params", {})))
        # The unit scenes give their collisions beside the results.
        given = case.get("intermediate", case)
        _check_lanes(name, report, given, metrics, world, data)
        _check_collisions(name, report, given, metrics, data)
    scores = dict(zip(names, np.asarray(metrics.scores).tolist(), strict=True))
    _check_results(name, report, expected, scores, values, curves)
    if "expected_final_score" in case:
        final, tolerance = float(metrics.final), SCORE_TOLERANCE[report.precision]
        report.close(name, "final score", final, case["expected_final_score"], tolerance)
    return True


def metric_params(given: Mapping[str, Any]) -> MetricParams:
    """Returns the thresholds of a case."""
    values: dict[str, Any] = {PARAMS[k]: float(v) for k, v in given.items() if k in PARAMS}
    if "max_violation_threshold" in given and isinstance(given["max_violation_threshold"], float):
        values["max_outside"] = given["max_violation_threshold"]
    if "driving_direction_thresholds" in given:
        compliant, violation = given["driving_direction_thresholds"]
        values |= {"direction_compliant": compliant, "direction_violation": violation}
    allowed = given.get("collision_thresholds")
    if allowed is None and "max_violation_threshold_vru" in given:
        allowed = {k: given[f"max_violation_threshold_{k}"] for k in ("vru", "vehicle", "object")}
    if allowed is not None:
        order = ("vru", "vehicle", "object")
        values["collisions_allowed"] = np.array([allowed[k] for k in order], float)
    # Of the comparison thresholds of the progress case, time_horizon belongs to another metric.
    return MetricParams(**values)


def ego_states(data, prefix: str, origin: np.ndarray, dtype) -> EgoState:
    """Reads ego or expert states into the local frame."""
    pose = np.asarray(data[f"{prefix}_rear_axle"], float)
    velocity, accel = data[f"{prefix}_rear_axle_velocity"], data[f"{prefix}_rear_axle_acceleration"]
    zero = np.zeros(len(pose))
    optional = lambda key: data[f"{prefix}_{key}"] if f"{prefix}_{key}" in data else zero
    columns = {
        "x": pose[:, 0] - origin[0],
        "y": pose[:, 1] - origin[1],
        "heading": pose[:, 2],
        "vx": velocity[:, 0],
        "vy": velocity[:, 1],
        "ax": accel[:, 0],
        "ay": accel[:, 1],
        "steering": optional("tire_steering_angle"),
        "steering_rate": optional("tire_steering_rate"),
        "yaw_rate": optional("angular_velocity"),
        "yaw_acceleration": optional("angular_acceleration"),
    }
    return EgoState(**{k: jnp.asarray(v, dtype) for k, v in columns.items()})


def extended(tree: Any, size: int) -> Any:
    """Repeats the last entry of leading axes up to a size."""

    def extend(values):
        widths = [(0, size - values.shape[0])] + [(0, 0)] * (values.ndim - 1)
        return jnp.pad(values, widths, mode="edge")

    return jax.tree.map(extend, tree)


def snapshots(data, prefix: str, origin: np.ndarray, dtype, room: int) -> Snapshot:
    """Reads `[T, K]` objects into the local frame, K padded."""
    grow = lambda v, axis: jnp.asarray(pad(np.asarray(v), room, axis))
    real = np.asarray(data[f"{prefix}_valid"])
    clean = lambda v: np.where(real, np.nan_to_num(v), 0)
    pose, size = np.asarray(data[f"{prefix}_pose"], float), data[f"{prefix}_size"]
    velocity = data[f"{prefix}_velocity"]
    columns = {
        "x": pose[..., 0] - origin[0],
        "y": pose[..., 1] - origin[1],
        "heading": pose[..., 2],
        "vx": velocity[..., 0],
        "vy": velocity[..., 1],
        "length": size[..., 0],
        "width": size[..., 1],
    }
    return Snapshot(
        **{k: jnp.asarray(grow(clean(v), 1), dtype) for k, v in columns.items()},
        type=grow(np.asarray(data[f"{prefix}_type"], np.int32), 0),
        valid=grow(real, 1),
    )


@lru_cache(maxsize=64)
def device_map(path: Path, dtype_name: str) -> tuple[DevkitMap, ScenarioMap]:
    """Reads a golden's map; the second part lives on the device."""
    world = load_devkit_map(path)
    return world, world.on_device(jnp.dtype(dtype_name))


def golden_history(data, world: DevkitMap, dtype, origin: np.ndarray | None = None) -> History:
    """Reads a golden's history, padded to common sizes; into the map's frame by default."""
    origin = world.origin if origin is None else origin
    steps, tracks = data["tracks_valid"].shape
    room = 16 if steps <= 16 else power_bucket(steps, SAMPLE_ROOM)
    time = np.asarray(data["ego_time_us"])
    ego = ego_states(data, "ego", origin, dtype)
    objects = snapshots(data, "tracks", origin, dtype, power_bucket(max(tracks, 1), 16))
    kind = objects.type
    moving = extended(objects.replace(type=objects.x), room)
    return History(
        time=extended(jnp.asarray((time - time[0]) * 1e-6, dtype), room),
        ego=extended(ego, room),
        valid=jnp.arange(room) < steps,
        objects=moving.replace(type=kind),
        lights=jnp.zeros((room, len(world.scenario.map.lanes.valid)), jnp.int8),
    )


def golden_expert(data, origin: np.ndarray, dtype) -> Expert:
    """Reads a golden's expert, padded to a common size."""
    prefix = "expert" if "expert_rear_axle" in data else "ego"
    states = ego_states(data, prefix, origin, dtype)
    size = states.x.shape[0]
    room = 16 if size <= 16 else power_bucket(size, SAMPLE_ROOM)
    return Expert(extended(states, room), jnp.arange(room) < size)


def closed_metrics(case, data, path: Path, dtype) -> tuple[ClosedLoopMetrics, DevkitMap]:
    """Runs the closed-loop metrics of a case."""
    folder = path.parent / "maps"
    chart = folder / f"{case['map']}.json"
    has_map = chart.exists()
    if not has_map:
        # Scenes that need no map get some: no compared value depends on it.
        chart = sorted(folder.glob("*.json"))[0]
    world, scene_map = device_map(chart, jnp.dtype(dtype).name)
    origin = world.origin if has_map else np.asarray(data["ego_rear_axle"][0, :2], float)
    params = metric_params(case.get("params", {}))
    config = MetricConfig()
    if "time_step_size" in case.get("params", {}):
        given = case["params"]
        config = MetricConfig(ttc_step=given["time_step_size"], ttc_horizon=given["time_horizon"])
        params = params.replace(direction_horizon=1.0)
    history = golden_history(data, world, dtype, origin)
    expert = golden_expert(data, origin, dtype)
    return closed_loop_jit(history, scene_map, expert, params, config=config), world


def _open_metrics(case, data, dtype):
    origin = np.asarray(data["ego_rear_axle"][0, :2])
    start = int(data["ego_time_us"][0])
    seconds = lambda v: jnp.asarray((np.asarray(v) - start) * 1e-6, dtype)
    pose, time = np.asarray(data["expert_rear_axle"], float), np.asarray(data["expert_time_us"])
    samples = np.arange(len(data["ego_time_us"]))
    if "expert_future_time_us" in data:
        samples, rows = comparison_indices(len(time), len(samples))
        # The log beyond the scenario also holds the scenario itself.
        pose, time = data["expert_future_rear_axle"][rows], data["expert_future_time_us"][rows]
    local = lambda v: jnp.asarray(v[..., :2] - origin, dtype)
    plan_time = np.asarray(data["plan_time_us"])[samples]
    plan_pose = np.asarray(data["plan_rear_axle"], float)[samples]
    plans = Plan(
        x=local(plan_pose)[..., 0],
        y=local(plan_pose)[..., 1],
        heading=jnp.asarray(plan_pose[..., 2], dtype),
        time=jnp.asarray((plan_time - plan_time[:, :1]) * 1e-6, dtype),
        start=seconds(plan_time[:, 0]),
    )
    expert = ExpertPoses(
        local(pose)[:, 0], local(pose)[:, 1], jnp.asarray(pose[:, 2], dtype), seconds(time)
    )
    given = case.get("params", {})
    misses = given.get("max_displacement_threshold", given.get("max_displacement", (6, 8, 16)))
    params = OpenLoopParams(
        max_displacement=float(given.get("max_average_l2_error_threshold", 8.0)),
        max_heading=float(given.get("max_average_heading_error_threshold", 0.8)),
        max_miss=np.array(misses, float),
        max_miss_rate=float(given.get("max_miss_rate_threshold", 0.3)),
    )
    return open_loop_jit(plans, expert, params, config=MetricConfig())


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _check_results(name, report, expected, scores, values, curves) -> None:
    """Compares scores, statistics and series of every metric of a case."""
    tolerance, score_tolerance = (
        VALUE_TOLERANCE[report.precision],
        SCORE_TOLERANCE[report.precision],
    )
    for results in expected.values():
        for result in results:
            key = RENAMED.get(result["name"], result["name"])
            if result["score"] is not None and key in scores:
                report.close(name, f"{key}: score", scores[key], result["score"], score_tolerance)
            theirs = {
                str(RENAMED.get(s["name"], s["name"])): (s["type"], _number(s["value"]))
                for s in result["statistics"]
            }
            report.equal(name, "statistics given", sorted(values[key]), sorted(theirs))
            for statistic, (kind, value) in theirs.items():
                mine = values[key].get(statistic, np.nan)
                if kind in ("BOOLEAN", "COUNT"):
                    report.equal(name, f"{key}: {kind}", mine, value)
                else:
                    report.close(name, statistic, mine, value, tolerance)
            if result["time_series"] is not None and key in curves:
                reference = np.array([float(v) for v in result["time_series"]["values"]])
                _check_curve(name, report, key, curves[key], reference, tolerance)


def _check_curve(name, report, key, ours, reference, tolerance) -> None:
    if ours.shape != reference.shape:
        report.equal(name, f"{key}: series length", len(ours), len(reference))
    elif key == "time_to_collision_within_bound" and report.precision == "f32":
        # Whole steps: either the same one or a flip.
        same = np.isclose(ours, reference, atol=1e-3) | (ours == reference)
        report.equal(name, "time to collision: series", same, np.ones_like(same))
    else:
        report.close(name, f"{key}: series", ours, reference, tolerance)


def _rows(world: DevkitMap, lists) -> np.ndarray:
    """Lists of lane ids, nested to any depth, as flags over the map's lanes."""
    if lists and isinstance(lists[0], list):
        return np.stack([_rows(world, entry) for entry in lists])
    flags = np.zeros(world.scenario.map.lanes.valid.shape[0], bool)
    flags[world.lane_rows(lists)] = True
    return flags


def _check_lanes(name, report, given, metrics, world, data) -> None:
    """Compares driven route, corner lanes and in-lane samples."""
    if "ego_driven_route" not in given:
        return
    time = np.asarray(data["ego_time_us"])
    steps = len(time)
    route = _rows(world, given["ego_driven_route"])
    report.equal(name, "driven route", np.asarray(metrics.route)[:steps], route)
    corners = _rows(world, given["corners_route"])
    report.equal(name, "corners route", np.asarray(metrics.corners.corners)[:steps], corners)
    in_lane = np.isin(time, given["timestamps_in_common_or_connected_route_objs"])
    report.equal(name, "in lane", np.asarray(metrics.corners.in_lane)[:steps], in_lane)


def _check_collisions(name, report, given, metrics, data) -> None:
    """Compares the first contact with each object, and the at-fault samples."""
    if "collisions" not in given:
        return
    time = np.asarray(data["ego_time_us"])
    tokens = [str(token) for token in data["tracks_token"]]
    first = np.full(len(tokens), metrics.valid.shape[0])
    kind, energy = np.full(len(tokens), -1), np.zeros(len(tokens))
    for contact in given["collisions"]:
        for token, what in contact["tracks"].items():
            row = tokens.index(token)
            first[row] = int(np.flatnonzero(time == contact["time_us"])[0])
            kind[row] = CollisionKind[what["type"].removesuffix("_COLLISION")]
            energy[row] = what["ego_delta_v"]
    ours, size = metrics.collisions, len(tokens)
    report.equal(name, "collision sample", np.asarray(ours.time_index)[:size], first)
    report.equal(name, "collision kind", np.asarray(ours.kind)[:size], kind)
    tolerance = VALUE_TOLERANCE[report.precision]
    report.close(name, "collision energy", np.asarray(ours.energy)[:size], energy, tolerance)
    if "at_fault_time_us" in given:
        at_fault = np.isin(time, given["at_fault_time_us"])
        report.equal(name, "at-fault samples", np.asarray(ours.at_fault_now)[: len(time)], at_fault)
