"""`nuplan_sim` goldens: the two-stage controller, reactive agents and whole runs."""

import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import TrackerParams, VehicleParams
from spdm_jax.geometry import ego_box
from spdm_jax.simulation.agent_paths import path_end
from spdm_jax.simulation.agent_state import AgentParams, AgentSizes, road_facts
from spdm_jax.simulation.controller import Plan, plan_profiles, track_command, track_step
from spdm_jax.simulation.drivers import scripted_driver
from spdm_jax.simulation.idm_agents import step_traffic
from spdm_jax.simulation.loop import (
    SimulationConfig,
    SimulationParams,
    TrafficMode,
    logged_objects,
    simulate,
)
from spdm_jax.simulation.placement import place_agents
from spdm_jax.types import EgoState, LightStatus, Scenario, Tracks

from .devkit_map import DevkitMap, load_devkit_map
from .world import pad, power_bucket

# Columns of `ego` and `next` in the single steps, in the order of `EgoState`.
STEP_COLUMNS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11)
PLAN_STEPS = 80
SINGLE_TOLERANCE = {"f64": 1e-7, "f32": 1e-3}
EGO_TOLERANCE = {"f64": 1e-4, "f32": 1e-2}
AGENT_TOLERANCE = {"f64": 1e-3, "f32": 1e-2}
SIZES = AgentSizes(agents=64, replayed=64, path_points=129, outline_blocks=1)
FIELDS = tuple(EgoState.__dataclass_fields__)


def ego_from(ego: np.ndarray, dtype) -> EgoState:
    """`[..., 11]` columns to a state."""
    return EgoState(**{name: jnp.asarray(ego[..., i], dtype) for i, name in enumerate(FIELDS)})


@jax.jit
@jax.vmap
def _single(ego, plan, time, next_time):
    vehicle, params = VehicleParams(), TrackerParams()
    command = jnp.stack(track_command(ego, plan, time, vehicle, params))
    following = track_step(ego, plan, time, next_time, vehicle, params)
    return command, following, plan_profiles(plan, PLAN_STEPS)


def check_lqr(path: Path, report, dtype) -> None:
    """Compares single controller steps: profiles, commands, next states."""
    data = np.load(path)
    tol = SINGLE_TOLERANCE[report.precision]
    plan, ego = data["plan"], data["ego"]
    length = np.sum(~np.isnan(plan[..., 0]), axis=1)
    for count in np.unique(length):
        rows = length == count
        poses, start = plan[rows, :count], plan[rows, 0, 0]
        origin = poses[:, 0, 1:3]
        local = np.array(ego[rows][:, STEP_COLUMNS])
        local[:, :2] -= origin
        time = (ego[rows, 0] - start) * 1e-6
        given = Plan(
            x=jnp.asarray(poses[..., 1] - origin[:, :1], dtype),
            y=jnp.asarray(poses[..., 2] - origin[:, 1:], dtype),
            heading=jnp.asarray(poses[..., 3], dtype),
            time=jnp.asarray((poses[..., 0] - start[:, None]) * 1e-6, dtype),
            start=jnp.zeros(len(poses), dtype),
        )
        after = time + data["dt"][rows] * 1e-6
        command, following, (speed, curvature) = _single(
            ego_from(local, dtype), given, jnp.asarray(time, dtype), jnp.asarray(after, dtype)
        )
        name = f"lqr/{path.name}"
        note = f"plans of {count} poses"
        report.close(name, "vprof", speed, data["vprof"][rows], tol, note=note)
        report.close(name, "kprof", curvature, data["kprof"][rows], tol, note=note)
        report.close(name, "cmd", command, data["cmd"][rows], tol, note=note)
        ours = np.stack([np.asarray(v, float) for v in jax.tree.leaves(following)], -1)
        ours[:, :2] += origin
        reference = data["next"][rows][:, STEP_COLUMNS]
        for i, field in enumerate(FIELDS):
            mine, theirs, angle = ours[:, i], reference[:, i], field == "heading"
            report.close(name, f"next {field}", mine, theirs, tol, angle=angle, note=note)


class Case(NamedTuple):
    """A golden run as a scenario that starts at iteration 0.

    Attributes:
      scene: scenario on the device.
      params: settings of the run.
      map: where it takes place.
      tokens: of the tracks, in row order.
      data: the golden's arrays.
      meta: its json file.
    """

    scene: Scenario
    params: SimulationParams
    map: DevkitMap
    tokens: list[str]
    data: Any
    meta: dict[str, Any]


def load_case(path: Path, dtype) -> Case:
    """Reads one case of `idm` or `closed_loop`; the row order of tracks is that of the log."""
    data = np.load(path)
    meta = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    base = load_devkit_map(path.parent / "maps" / f"{meta['map']}.json")
    origin = base.origin
    order, valid = data["in_tracks_order"], data["in_tracks_valid"]
    # Tracks in the order of their first appearance, and within it of the detection list.
    first = np.argmax(valid, axis=0)
    place = order[first, np.arange(valid.shape[1])]
    rows = np.lexsort((place, first))
    valid = valid[:, rows]
    size, length = power_bucket(len(rows), 64), len(valid)

    def table(values, offset: float = 0.0):
        here = np.where(valid, values - offset, 0.0)
        return jnp.asarray(pad(here.T, size), dtype)

    pose, extent = data["in_tracks_pose"][:, rows], data["in_tracks_size"][:, rows]
    velocity = data["in_tracks_velocity"][:, rows]
    tracks = Tracks(
        x=table(pose[..., 0], origin[0]),
        y=table(pose[..., 1], origin[1]),
        heading=table(pose[..., 2]),
        vx=table(velocity[..., 0]),
        vy=table(velocity[..., 1]),
        length=table(extent[..., 0]),
        width=table(extent[..., 1]),
        valid=jnp.asarray(pad(valid.T, size)),
        type=jnp.asarray(pad(data["in_tracks_type"][rows], size), jnp.int32),
    )
    logged = "ego" if len(data["ego_time_us"]) == length else "expert"
    states = np.zeros((length, len(FIELDS)))
    states[:, :3] = data[f"{logged}_rear_axle"]
    states[:, :2] -= origin
    states[:, 3:5] = data[f"{logged}_rear_axle_velocity"]
    states[:, 5:7] = data[f"{logged}_rear_axle_acceleration"]
    lights = np.zeros((length, base.scenario.map.lanes.valid.shape[0]), np.int8)
    for iteration, status in meta["lights_by_iteration"]:
        lights[iteration:] = LightStatus.UNKNOWN
        for key, value in status.items():
            lights[iteration:, base.info.lane_ids.index(key)] = LightStatus[value]
    time_us = data[f"{logged}_time_us"]
    shape = base.scenario
    scene = shape.replace(
        map=base.on_device(dtype),
        ego=ego_from(states, dtype),
        ego_valid=jnp.ones(length, bool),
        tracks=tracks,
        lights=jnp.asarray(lights),
        time=jnp.asarray((time_us - time_us[0]) * 1e-6, dtype),
        num_history=jnp.int32(0),
        num_iterations=jnp.int32(length),
    )
    given = meta.get("params") or meta["idm_params"]
    agents = AgentParams(
        target_speed=given["target_velocity"],
        min_gap=given["min_gap_to_lead_agent"],
        headway_time=given["headway_time"],
        accel_max=given["accel_max"],
        decel_max=given["decel_max"],
        min_path_length=given["minimum_path_length"],
        radius=given["radius"],
    )
    params = SimulationParams(agents=agents)
    tokens = [str(v) for v in data["in_tracks_token"][rows]]
    params = jax.tree.map(lambda v: jnp.asarray(v, dtype), params)
    return Case(scene, params, base, tokens, data, meta)


@jax.jit
def _drive_agents(scene: Scenario, params: SimulationParams):
    """All agents of an ego that follows the log: `Traffic` before and after each step."""
    facts = road_facts(scene.map, SIZES)
    at = lambda i: jax.tree.map(lambda v: v[i], scene.ego)
    start = place_agents(
        scene.map, facts, logged_objects(scene, 0), at(0), params.vehicle, params.agents, SIZES
    )

    def values(traffic):
        agents = traffic.agents
        end = jax.vmap(path_end)(agents.path)
        return {
            "active": agents.active,
            "pose": jnp.stack([agents.x, agents.y, agents.heading], -1),
            "progress": jnp.clip(agents.progress, 0, end),
            "velocity": agents.speed,
            "path_length": end,
            "target_velocity": agents.target_speed,
            "route": agents.route,
        }

    def step(traffic, i):
        ego = at(i)
        traffic = step_traffic(
            traffic,
            scene.map,
            facts,
            ego_box(ego, params.vehicle),
            ego.heading,
            jnp.hypot(ego.vx, ego.vy),
            logged_objects(scene, i + 1),
            scene.lights[i + 1],
            scene.time[i + 1] - scene.time[i],
            params.agents,
            SIZES,
        )
        return traffic, values(traffic)

    end, rest = jax.lax.scan(step, start, jnp.arange(scene.time.shape[0] - 1))
    first = values(start)
    series = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    skipped = jnp.sum(end.agents.skipped)
    return start.agents.track, start.count, end.overflow, skipped, series


def check_idm(path: Path, report, dtype) -> None:
    """Compares reactive agents alone: who drives, poses, speeds, paths and routes."""
    case = load_case(path, dtype)
    data, name = case.data, f"idm/{path.name}"
    track, count, overflow, skipped, series = _drive_agents(case.scene, case.params)
    ours = [case.tokens[i] for i in np.asarray(track)[: int(count)]]
    theirs = [str(v) for v in data["idm_token"]]
    note = "" if ours == theirs else f"{ours} / {theirs}"
    report.equal(name, "agents", ours == theirs, True, note=note)
    report.equal(name, "overflow", bool(overflow), False)
    report.equal(name, "skipped agents", int(skipped), 0)
    if ours != theirs:
        return
    series = {key: np.asarray(v)[:, : int(count)] for key, v in series.items()}
    ids = np.array([*case.map.info.lane_ids, ""])
    start = {token: route[0] for token, route in case.meta["routes_by_iteration"][0][1].items()}
    elsewhere = [
        t for t, v in zip(ours, series["route"][0, :, -1], strict=True) if ids[v] != start[t]
    ]
    if elsewhere and report.precision == "f32":
        # A centre exactly on the border of two lanes: rounding decides, and the run differs.
        report.equal(
            name, "agents", True, True, note=f"on a lane border, not compared: {elsewhere}"
        )
        return
    active = data["idm_active"]
    report.equal(name, "active", series["active"], active)
    both = series["active"] & active
    tol = AGENT_TOLERANCE[report.precision]
    pose = np.asarray(series["pose"], float)
    xy = pose[..., :2] + case.map.origin
    report.close(name, "pose xy", xy, data["idm_pose"][..., :2], tol, both[..., None])
    report.close(name, "pose heading", pose[..., 2], data["idm_pose"][..., 2], tol, both, True)
    for key in ("progress", "velocity", "path_length", "target_velocity"):
        report.close(name, key, series[key], data[f"idm_{key}"], tol, both)
    routes: dict[str, list[str]] = {}
    changes = {int(i): changed for i, changed in case.meta["routes_by_iteration"]}
    different = []
    for i in range(len(active)):
        routes = changes.get(i, routes)
        for k in np.flatnonzero(both[i]):
            mine = [str(ids[v]) for v in series["route"][i, k] if v >= 0]
            different.append(mine != routes[theirs[k]])
    report.equal(name, "routes", different, np.zeros(len(different), bool))


@partial(jax.jit, static_argnames=("config",))
def _run(scene: Scenario, params: SimulationParams, plans: Plan, config: SimulationConfig):
    return simulate(scene, scripted_driver(plans), params, config)


def check_closed_loop(path: Path, report, dtype) -> None:
    """Compares whole runs under the stored plans: ego states, and objects as the run saw them."""
    case = load_case(path, dtype)
    data, name = case.data, f"closed_loop/{path.name}"
    time = data["plan_time_us"]
    poses = data["plan_rear_axle"]
    origin = case.map.origin
    plans = Plan(
        x=jnp.asarray(poses[..., 0] - origin[0], dtype),
        y=jnp.asarray(poses[..., 1] - origin[1], dtype),
        heading=jnp.asarray(poses[..., 2], dtype),
        time=jnp.asarray((time - time[:, :1]) * 1e-6, dtype),
        start=jnp.asarray((time[:, 0] - data["expert_time_us"][0]) * 1e-6, dtype),
    )
    mode: TrafficMode = "reactive" if case.meta["reactive"] else "replay"
    config = SimulationConfig(num_samples=len(time), traffic=mode, sizes=SIZES)
    run = _run(case.scene, case.params, plans, config)
    history = run.history
    report.equal(name, "overflow or failed", bool(run.overflow | run.failed), False)
    report.equal(name, "samples", int(np.sum(history.valid)), len(data["ego_time_us"]))
    tol = EGO_TOLERANCE[report.precision]
    ego = history.ego
    xy = np.stack([ego.x, ego.y], -1).astype(float) + origin
    report.close(name, "ego xy", xy, data["ego_rear_axle"][..., :2], tol)
    report.close(name, "ego heading", ego.heading, data["ego_rear_axle"][..., 2], tol, angle=True)
    pairs = {
        "ego velocity": ((ego.vx, ego.vy), "ego_rear_axle_velocity"),
        "ego acceleration": ((ego.ax, ego.ay), "ego_rear_axle_acceleration"),
    }
    for array, (values, key) in pairs.items():
        report.close(name, array, np.stack(values, -1), data[key], tol)
    for array, values, key in (
        ("ego yaw rate", ego.yaw_rate, "ego_angular_velocity"),
        ("ego yaw acceleration", ego.yaw_acceleration, "ego_angular_acceleration"),
        ("ego steering", ego.steering, "ego_tire_steering_angle"),
    ):
        report.close(name, array, values, data[key], tol)
    tol = AGENT_TOLERANCE[report.precision]
    objects = history.objects
    rows = [case.tokens.index(str(token)) for token in data["tracks_token"]]
    valid = data["tracks_valid"]
    report.equal(name, "objects present", np.asarray(objects.valid)[:, rows], valid)
    others = np.delete(np.asarray(objects.valid), rows, axis=1)
    report.equal(name, "objects absent", int(others.sum()), 0)
    pick = lambda *values: np.stack([np.asarray(v, float)[:, rows] for v in values], -1)
    both = valid & np.asarray(objects.valid)[:, rows]
    xy = pick(objects.x, objects.y) + origin
    report.close(name, "objects xy", xy, data["tracks_pose"][..., :2], tol, both[..., None])
    heading = pick(objects.heading)[..., 0]
    report.close(name, "objects heading", heading, data["tracks_pose"][..., 2], tol, both, True)
    speed = pick(objects.vx, objects.vy)
    report.close(name, "objects velocity", speed, data["tracks_velocity"], tol, both[..., None])
    size = pick(objects.length, objects.width)
    report.close(name, "objects size", size, data["tracks_size"], tol, both[..., None])


def check_simulation(path: Path, report, dtype) -> bool:
    """Runs the check of a simulation case, told by its arrays; False if the file is none."""
    if not path.with_suffix(".json").is_file():
        return False
    arrays = set(np.load(path).files)
    if "vprof" in arrays:
        check_lqr(path, report, dtype)
    elif "idm_token" in arrays:
        check_idm(path, report, dtype)
    elif {"plan_time_us", "in_tracks_token"} <= arrays:
        check_closed_loop(path, report, dtype)
    else:
        return False
    return True
