"""Checks of the `unit_*.npz` goldens: one function each."""

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax.config import IDMParams, PlannerParams, TrackerParams, VehicleParams
from spdm_jax.decision import brake_trajectory, cast_params, target_speeds
from spdm_jax.geometry import (
    Box,
    box_at,
    box_corners,
    box_distance,
    boxes_overlap,
    ego_box,
    interpolate,
    make_path,
    point_segment_sq,
    project,
)
from spdm_jax.proposals.idm import Leader, at_policies, idm_step
from spdm_jax.proposals.lanes import parallel_path
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.scoring.areas import containing_polygons
from spdm_jax.scoring.collision import (
    collision_kind,
    cos_to_object,
    is_ahead,
    is_behind,
)
from spdm_jax.scoring.comfort import comfort_flags, comfort_signals
from spdm_jax.scoring.driving import driving_direction
from spdm_jax.tracking import lqr
from spdm_jax.tracking.lqr import bicycle_step, reference_profiles, track
from spdm_jax.types import AgentForecast, EgoState

from .report import SCORE_TOLERANCE, STATE_TOLERANCE
from .world import STATE_FIELDS, ego_state, pad, padded_grid, state_array

ZERO = np.zeros(2)


def check_unit(path: Path, report, dtype) -> bool:
    """Runs the check that belongs to the file's name; False if there is none."""
    check = CHECKS.get(path.stem)
    if check is None:
        return False
    check(path.name, np.load(path), report, dtype, STATE_TOLERANCE[report.precision])
    return True


def _params(dtype) -> PlannerParams:
    return cast_params(PlannerParams(), dtype)


def _lqr(name, d, report, dtype, tol):
    params = _params(dtype).replace(tracker=TrackerParams(wheel_base=float(d["wheel_base"])))
    pose = [jnp.asarray(d["reference_se2"][..., i], dtype) for i in range(3)]
    # float32: a local frame first, as everywhere in the library.
    origin = d["reference_se2"][:, 0, :2]
    pose[0] = jnp.asarray(d["reference_se2"][..., 0] - origin[:, :1], dtype)
    pose[1] = jnp.asarray(d["reference_se2"][..., 1] - origin[:, 1:], dtype)
    speed, curvature = reference_profiles(pose[0], pose[1], pose[2], "reference")
    report.close(name, "velocity_profile", speed, d["velocity_profile"], tol)
    report.close(name, "curvature_profile", curvature, d["curvature_profile"], tol)
    # Accelerations and curvature rates are the fit's own unknowns: differences over 0.1 s.
    difference = lambda v: np.diff(np.asarray(v, float), axis=1) / 0.1
    rate_tol = tol * (10 if report.precision == "f32" else 1)
    report.close(
        name, "acceleration_profile", difference(speed), d["acceleration_profile"], rate_tol
    )
    report.close(
        name, "curvature_rate_profile", difference(curvature), d["curvature_rate_profile"], rate_tol
    )
    start = np.array(d["initial_states"])
    start[:, :2] -= origin
    states, commands = track(
        pose[0],
        pose[1],
        pose[2],
        ego_state(start, ZERO, dtype),
        params.vehicle,
        params.tracker,
        "reference",
    )
    whole = state_array(states, ZERO)
    whole[..., :2] += origin[:, None]
    weight = np.ones(11)
    if report.precision == "f32":
        weight[[5, 8, 10]] = 0.1, 0.01, 0.01
    wrapped = whole - d["rollout_states"]
    wrapped[..., 2] = np.arctan2(np.sin(wrapped[..., 2]), np.cos(wrapped[..., 2]))
    report.close(name, "rollout_states", wrapped * weight, np.zeros_like(wrapped), tol * 10)
    report.close(name, "rollout_commands", commands, d["rollout_commands"], tol * 10)
    # One command at a later index, from the same initial state: shift the reference window.
    reference = lqr.reference_at(pose[0], pose[1], pose[2], "reference")
    initial = ego_state(start, ZERO, dtype)
    for row, index in enumerate(np.asarray(d["iteration_index"]).astype(int)):
        at = jax.tree.map(lambda v, k=index: v[k], reference)
        accel, rate = lqr._command(initial, at, params.tracker)
        ours = np.stack([accel, rate], -1)
        report.close(
            name, f"commands_at_index {index}", ours, d["commands_at_index"][row], tol * 10
        )


def _bicycle(name, d, report, dtype, tol):
    params = _params(dtype)
    vehicle = VehicleParams(wheel_base=float(d["wheel_base"]))
    tracker = params.tracker.replace(max_steering=float(d["max_steering"]))
    origin = np.array(d["states"][:, :2])
    start = np.array(d["states"])
    start[:, :2] = 0
    commands = jnp.asarray(d["commands"], dtype)
    following = bicycle_step(
        ego_state(start, ZERO, dtype), commands[:, 0], commands[:, 1], vehicle, tracker
    )
    ours = state_array(following, ZERO)
    ours[:, :2] += origin
    difference = ours - d["next_states"]
    difference[:, 2] = np.arctan2(np.sin(difference[:, 2]), np.cos(difference[:, 2]))
    if report.precision == "f32":
        difference[:, [8, 10]] *= 0.01
    report.close(name, "next_states", difference, np.zeros_like(difference), tol)


def _idm(name, d, report, dtype, tol):
    params = IDMParams(
        min_gap=jnp.asarray(d["min_gap"], dtype),
        headway_time=jnp.asarray(d["headway_time"], dtype),
        accel_max=jnp.asarray(d["accel_max"], dtype),
        decel_max=jnp.asarray(d["decel_max"], dtype),
        fallback_speed=jnp.asarray(d["fallback_target_velocity"], dtype),
    )
    planner = _params(dtype).replace(
        idm=params, speed_fractions=jnp.asarray(d["speed_limit_fraction"], dtype)
    )
    targets = target_speeds(jnp.asarray(12.0, dtype), planner)
    report.close(name, "target_velocity", targets, d["target_velocity"], tol)
    unknown = target_speeds(jnp.asarray(jnp.nan, dtype), planner)
    report.close(name, "target_velocity_no_limit", unknown, d["target_velocity_no_limit"], tol)
    policy = jnp.asarray(np.asarray(d["policy_index"]).astype(np.int32))
    state, lead = jnp.asarray(d["idm_state"], dtype), jnp.asarray(d["lead_state"], dtype)
    x, v = idm_step(
        state[:, 0],
        state[:, 1],
        Leader(lead[:, 0], lead[:, 1], lead[:, 2]),
        targets[policy],
        at_policies(params, policy),
    )
    report.close(name, "next_idm_state", np.stack([x, v], -1), d["next_idm_state"], tol)


def _comfort(name, d, report, dtype, tol):
    zero = jnp.zeros(d["heading"].shape, dtype)
    fields = dict.fromkeys(STATE_FIELDS, zero)
    fields["heading"] = jnp.asarray(d["heading"], dtype)
    fields["ax"], fields["ay"] = jnp.asarray(d["accel_x"], dtype), jnp.asarray(d["accel_y"], dtype)
    ego = EgoState(**fields)
    names = dict(
        zip(
            ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate"),
            ("lon_accel", "lat_accel", "mag_jerk", "lon_jerk", "yaw_accel", "yaw_rate"),
            strict=True,
        )
    )
    bounds = np.asarray(d["bounds"])
    near = np.zeros((len(d["heading"]), 6), bool)
    for column, (ours, signal) in enumerate(zip(names, comfort_signals(ego).values(), strict=True)):
        reference = np.asarray(d[names[ours]])
        scale = 50 if report.precision == "f32" and ours == "yaw_accel" else 1
        report.close(name, names[ours], signal, reference, tol * scale)
        distance = np.abs(reference[..., None] - bounds[column]).min(axis=(1, 2))
        near[:, column] = distance < (1e-9 if report.precision == "f64" else 1e-3)
    flags = np.asarray(comfort_flags(ego, _params(dtype).scoring))
    report.equal(name, "flags", flags, d["flags"], ~near)


def _path(name, d, report, dtype, tol):
    offsets = np.asarray(d["path_offsets"]).astype(int)
    points = np.asarray(d["path_points"])
    size = int(np.diff(offsets).max())
    f32 = report.precision == "f32"
    robust = np.asarray(d["query_gap"]) > (1e-3 if f32 else 1e-9)
    for row, (a, b) in enumerate(itertools.pairwise(offsets)):
        x, y, heading = (jnp.asarray(pad(points[a:b, i], size), dtype) for i in range(3))
        path = make_path(x, y, heading, jnp.asarray(b - a, jnp.int32))
        report.close(
            name, f"path_progress {row}", path.progress[: b - a], d["path_progress"][a:b], tol
        )
        report.close(
            name,
            f"path_points_unwrapped {row}",
            path.heading[: b - a],
            d["path_points_unwrapped"][a:b, 2],
            tol,
        )
        mine = np.asarray(d["query_path"]) == row
        query = jnp.asarray(d["query_points"][mine], dtype)
        at = project(path, query[:, 0], query[:, 1])
        report.close(
            name,
            f"query_progress {row}",
            at,
            d["query_progress"][mine],
            tol * (25 if f32 else 10),
            robust[mine],
        )
        square, _ = point_segment_sq(
            query[:, :1], query[:, 1:], path.x[:-1], path.y[:-1], path.x[1:], path.y[1:]
        )
        distance = np.sqrt(np.asarray(square)[:, : b - a - 1].min(1))
        report.close(name, f"query_distance {row}", distance, d["query_distance"][mine], tol)
        mine = np.asarray(d["interp_path"]) == row
        pose = np.stack(interpolate(path, jnp.asarray(d["interp_distance"][mine], dtype)), -1)
        report.close(name, f"interp xy {row}", pose[:, :2], d["interp_se2"][mine][:, :2], tol)
        report.close(
            name, f"interp heading {row}", pose[:, 2], d["interp_se2"][mine][:, 2], tol, None, True
        )
        for i, offset in enumerate(np.asarray(d["parallel_offset"])):
            moved = parallel_path(path, jnp.asarray(offset, dtype))
            ours = np.stack([moved.x, moved.y], -1)[: b - a]
            report.close(name, f"parallel {row} {i}", ours, d["parallel_points"][i, a:b, :2], tol)


def _direction(name, d, report, dtype, tol):
    center = jnp.asarray(d["ego_center"], dtype)
    mask = jnp.asarray(d["oncoming_mask"], bool)
    params = _params(dtype).scoring
    ours = driving_direction(center[..., 0], center[..., 1], mask, params)
    report.equal(name, "score", ours, d["score"])


def _aggregate(name, d, report, dtype, tol):
    tol = SCORE_TOLERANCE[report.precision]
    params = _params(dtype).scoring
    for i in range(len(d["scores"])):
        get = lambda key, row=i: jnp.asarray(d[key][row], dtype)
        ours = aggregate(
            jnp.prod(get("multi_metrics"), axis=0),
            get("progress_raw"),
            get("ttc"),
            get("comfortable"),
            jnp.ones(d["ttc"].shape[1], bool),
            params,
        )
        report.close(name, "normalized_progress", ours.progress, d["normalized_progress"][i], tol)
        report.close(name, "scores", ours.total, d["scores"][i], tol)


def _geometry(name, d, report, dtype, tol):
    origin = np.array(d["ego_states"][:, :2])
    states = np.array(d["ego_states"])
    states[:, :2] = 0
    ego = ego_state(states, ZERO, dtype)
    params = _params(dtype)
    box = ego_box(ego, params.vehicle)
    x, y = box_corners(box)
    corners = np.stack([x, y], -1) + origin[:, None]
    report.close(name, "ego_corners", corners, d["ego_corners"][:, :4], tol)
    other = [jnp.asarray(v, dtype) for v in np.asarray(d["box"]).T]
    ox = jnp.asarray(d["box"][:, 0] - origin[:, 0], dtype)
    oy = jnp.asarray(d["box"][:, 1] - origin[:, 1], dtype)
    boxes = box_at(ox, oy, other[2], 0.5 * other[3], 0.5 * other[4])
    f32 = report.precision == "f32"
    distance = np.asarray(d["distance"])
    # A pair is robust when neither the gap nor the overlap is of rounding size.
    depth = np.asarray(d["overlap_area_sqrt"])
    margin = 1e-3 if f32 else 1e-9
    robust = np.where(np.asarray(d["intersects"], bool), depth > margin, distance > margin)
    hits = np.asarray(boxes_overlap(box, boxes))
    report.equal(name, "intersects", hits, d["intersects"], robust)
    report.close(name, "distance", box_distance(box, boxes), distance, tol, robust)
    bumper = Box(
        box.x + box.half_length * box.cos,
        box.y + box.half_length * box.sin,
        box.cos,
        box.sin,
        jnp.zeros_like(box.x),
        box.half_width,
    )
    report.equal(
        name, "front_edge_hits", boxes_overlap(bumper, boxes), d["front_edge_hits"], robust
    )
    cos = cos_to_object(ego.x, ego.y, ego.heading, ox, oy)
    angle = np.arccos(np.clip(np.asarray(cos, float), -1, 1))
    report.close(
        name,
        "relative_angle",
        angle,
        d["relative_angle"],
        tol * (10 if f32 else 1),
        np.abs(np.sin(np.asarray(d["relative_angle"]))) > 1e-2,
    )
    for key, ours, limit in (
        ("ahead", is_ahead(cos, params.scoring), 30),
        ("behind", is_behind(cos, params.scoring), 150),
    ):
        far = np.abs(np.degrees(np.asarray(d["relative_angle"])) - limit) > (1e-3 if f32 else 1e-9)
        report.equal(name, key, ours, d[key], far)
    # Collision type of each pair on its own: one ego state, one object, contact at once.
    forecast = AgentForecast(
        x=ox[:, None, None],
        y=oy[:, None, None],
        heading=other[2][:, None, None],
        sample_valid=jnp.ones((len(distance), 1, 1), bool),
        length=other[3][:, None],
        width=other[4][:, None],
        type=jnp.asarray(d["box_type"], jnp.int32)[:, None],
        is_agent=jnp.asarray(np.asarray(d["box_type"]) <= 2)[:, None],
        speed=jnp.asarray(d["box_speed"], dtype)[:, None],
        current_heading=other[2][:, None],
        track=jnp.zeros((len(distance), 1), jnp.int32),
        valid=jnp.ones((len(distance), 1), bool),
        ignored=jnp.zeros((len(distance), 1), bool),
    )

    def kind_of(state, agents):
        one = jax.tree.map(lambda v: v[None, None], state)
        first = jnp.int32(0)
        return collision_kind(one, agents, first, first, first, params.vehicle, params.scoring)

    report.equal(
        name, "collision_type", jax.vmap(kind_of)(ego, forecast), d["collision_type"], robust
    )

    pip = np.asarray(d["pip_offsets"]).astype(int)
    rings = [np.asarray(d["pip_xy"])[a:b] for a, b in itertools.pairwise(pip)]
    grid = padded_grid([shapely.Polygon(ring) for ring in rings], dtype)
    points = jnp.asarray(d["pip_points"], dtype)
    words = containing_polygons(grid, points[:, 0], points[:, 1])
    inside = np.array(
        [(np.asarray(words[i // 32]) >> np.uint32(i % 32)) & 1 for i in range(len(rings))], bool
    )
    edge = np.asarray(d["pip_boundary_distance"])
    report.equal(name, "pip_contains", inside, d["pip_contains"], edge > (1e-4 if f32 else 1e-9))


def _brake(name, d, report, dtype, tol):
    params = _params(dtype)
    origin = np.array(d["ego_states"][:, :2])
    states = np.array(d["ego_states"])
    states[:, :2] = 0
    one = lambda ego: brake_trajectory(ego, params.vehicle, params.brake)
    pose = np.stack(jax.vmap(one)(ego_state(states, ZERO, dtype)), -1)
    pose[..., :2] += origin[:, None]
    report.close(name, "trajectory xy", pose[..., :2], d["trajectory"][..., :2], tol * 10)
    report.close(name, "trajectory heading", pose[..., 2], d["trajectory"][..., 2], tol, None, True)


CHECKS = {
    "unit_lqr": _lqr,
    "unit_bicycle": _bicycle,
    "unit_idm": _idm,
    "unit_comfort": _comfort,
    "unit_path": _path,
    "unit_driving_direction": _direction,
    "unit_aggregate": _aggregate,
    "unit_geometry": _geometry,
    "unit_emergency_brake": _brake,
}
