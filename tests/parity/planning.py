"""`pdm_<token>_<iteration>.npz`: PDM-Closed on nuPlan-format logs, read by our own reader."""

from functools import lru_cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax import decision, planner
from spdm_jax.config import pdm_closed
from spdm_jax.geometry import box_corners, ego_box
from spdm_jax.io.build import build_scenario, start_at
from spdm_jax.io.nuplan import NuPlanReader
from spdm_jax.io.nuplan_filter import ScenarioFilter
from spdm_jax.padding import PaddingConfig, batch, to_device
from spdm_jax.proposals.corridor import object_boxes
from spdm_jax.proposals.lanes import drivable_lanes
from spdm_jax.types import LightStatus

from . import report as limits
from .pdm import compare_best, compare_scores

SPEC = pdm_closed(15)


@lru_cache(maxsize=4)
def _reader(root: Path, token: str) -> NuPlanReader:
    from spdm_jax.io.nuplan_filter import Window

    return NuPlanReader(
        root / "nuplan-v1.1",
        root / "maps",
        ScenarioFilter(scenario_tokens=(token,)),
        window=Window(8.0, 0.0),
    )


@partial(jax.jit, static_argnames=("config",))
def _plan(scene, params, config):
    state = planner.init(scene, params, config)
    given = planner.observe(scene, 0)
    params = decision.cast_params(params, scene.ego.x.dtype)
    box = ego_box(given.ego, params.vehicle)
    lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    seen = planner.see(scene, given, state, params, config)
    targets = decision.target_speeds(
        scene.map.lanes.speed_limit[scene.route.start_lane[state.slot]], params
    )
    stage1 = decision.stage1_proposals(state.paths, given.ego, targets, seen, params)
    one = lambda i: decision.extend_stage1(state.paths, i, targets, stage1, seen, params)
    extended = jax.lax.map(one, jnp.arange(stage1.x.shape[0] * stage1.x.shape[1]))
    result, _ = planner.step(scene, given, state, params, config)
    return result, state, lanes, parks, seen, extended


def check_planning(path: Path, report, dtype) -> None:
    """Reads the log, plans, and compares every intermediate that the file holds."""
    data = np.load(path)
    name = path.name
    root = path.parent.parent
    if not (root / "nuplan-v1.1").is_dir():
        report.equal(name, "log", False, True, note=f"{root} holds no nuplan-v1.1")
        return
    token = str(data["token"])
    raw = _reader(root, token).read(token)
    scenario, info = build_scenario(raw)
    iteration = int(data["iteration"])
    if iteration:
        scenario = start_at(scenario, info, iteration)
    origin = np.asarray(scenario.origin)
    scene = jax.tree.map(lambda v: v[0], to_device(batch([scenario], PaddingConfig()), dtype))
    result, state, lanes, parks, seen, extended = _plan(scene, SPEC.params, config=SPEC.config)
    f64 = report.precision == "f64"
    tol = limits.CHAIN_TOLERANCE[report.precision] * (10 if f64 else 1)

    ids = np.array(info.roadblock_ids)
    route = np.asarray(scenario.route.roadblocks)
    ours = [str(v) for v in ids[route[route >= 0]]]
    theirs = [str(v) for v in data["route_corrected"]]
    report.equal(name, "route_corrected", ours == theirs, True, note=f"{ours} / {theirs}")
    lane_ids = np.array(info.lane_ids)
    report.equal(
        name, "starting_lane", lane_ids[int(result.starting_lane)], str(data["starting_lane"])
    )
    limit = scenario.map.lanes.speed_limit[int(result.starting_lane)]
    report.close(name, "speed_limit", limit, data["starting_lane_speed_limit"], 1e-9)
    center = data["centerline"]
    count = int(state.paths.count[0])
    report.equal(name, "centerline length", count, len(center))
    if count == len(center):
        mine = np.stack([state.paths.x[0], state.paths.y[0]], -1)[:count] + origin
        report.close(name, "centerline", mine, center[:, :2], tol)
    # The file lists every red connector; the planner takes those on the route.
    at = int(scenario.num_history)
    red = sorted(int(lane_ids[i]) for i in np.flatnonzero(scenario.lights[at] == LightStatus.RED))
    theirs = sorted(v for v in map(int, data["red_connectors"]) if str(v) in set(lane_ids))
    report.equal(name, "red_connectors", red == theirs, True, note=f"{red} / {theirs}")
    mine = {str(lane_ids[i]) for i in np.flatnonzero(lanes) if i < len(lane_ids)}
    tokens = {str(v) for v in data["drivable_tokens"]}
    # Car parks have ids of their own layer, which the scenario file does not keep.
    lane_tokens = tokens & set(info.lane_ids)
    report.equal(name, "drivable lanes", mine == lane_tokens, True, note=str(mine ^ lane_tokens))
    report.equal(name, "drivable car parks", int(np.sum(parks)), len(tokens - lane_tokens))

    boxes = box_corners(object_boxes(seen.forecast))
    corners = np.stack(boxes, -1) + origin  # [S, A, 4, 2]
    track_ids = np.array(info.track_ids)
    valid = np.asarray(seen.forecast.valid)
    row_of = {
        str(track_ids[t]): i for i, t in enumerate(np.asarray(seen.forecast.track)) if valid[i]
    }
    stored = {}
    for step, object_token, ring in zip(
        data["forecast_step"], data["forecast_token"], data["forecast_corners"], strict=True
    ):
        stored.setdefault(str(object_token), []).append((int(step), ring[:4]))
    objects = {k for k in stored if "red_light" not in k}
    report.equal(
        name, "forecast objects", set(row_of) == objects, True, note=str(set(row_of) ^ objects)
    )
    worst = 0.0
    for object_token in objects & set(row_of):
        for step, ring in stored[object_token]:
            mine = corners[step // 2, row_of[object_token]]
            # The stored ring may start at any corner.
            gap = min(
                np.abs(np.roll(mine, k, 0)[:, :] - r).max()
                for k in range(4)
                for r in (ring, ring[::-1])
            )
            worst = max(worst, gap)
    report.close(name, "forecast_corners", worst, 0.0, tol)

    poses = np.stack(extended, -1)
    # Nothing is stored beyond 4 s.
    reference = data["proposals"]
    stored_rows = np.any(reference[..., :2] != 0, axis=-1)
    mine = poses[..., :2] + origin
    report.close(name, "proposals xy", mine, reference[..., :2], tol * 2, stored_rows[..., None])
    heading = poses[..., 2]
    report.close(name, "proposals heading", heading, reference[..., 2], tol, stored_rows, True)
    tracked = result.tracked
    mine = np.stack([tracked.x, tracked.y], -1) + origin
    report.close(name, "simulated xy", mine, data["simulated"][..., :2], tol)
    report.close(name, "simulated vx", tracked.vx, data["simulated"][..., 3], tol * 5)
    report.close(name, "simulated steering", tracked.steering, data["simulated"][..., 7], tol)
    as_scene = {key: data[key] for key in data.files}
    as_scene["collision_time_idx"] = data["collision_time_idcs"]
    as_scene["ttc_time_idx"] = data["ttc_time_idcs"]
    as_scene["comfort_flags"] = np.asarray(result.scores.comfort_flags)  # not stored
    everywhere = np.ones(len(data["scores"]), bool)
    compare_scores(
        report,
        name,
        "log ",
        result.scores,
        as_scene,
        robust=everywhere,
        robust_areas=np.ones(data["ego_areas"].shape[:2], bool),
        tolerance=tol,
    )
    report.close(
        name, "log scores 1e-6", result.scores.total, data["scores"], 1e-6 if f64 else 1e-3
    )
    best, theirs = int(result.best), int(data["best"])
    compare_best(report, name, "log best", best, data["scores"], theirs)
    report.equal(
        name, "log emergency_brake", bool(result.emergency_brake), bool(data["emergency_brake"])
    )
    if best == theirs:
        plan = result.trajectory
        mine = np.stack([plan.x, plan.y], -1) + origin
        report.close(name, "log trajectory", mine, data["trajectory"][:, :2], tol * 2)
