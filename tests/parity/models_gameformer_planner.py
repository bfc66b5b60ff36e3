"""`models/gameformer` goldens of the planner around the network, and of motion tokens."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Box, box_at
from spdm_models.gameformer_paths import (
    Boundaries,
    ReferencePath,
    annotate,
    cheapest_course,
    path_costs,
    path_objects,
)
from spdm_models.gameformer_refine import (
    WEIGHTS,
    occupancy,
    plan_on_path,
    refine,
    refinement_residuals,
)
from spdm_models.lattice import (
    Polyline,
    bezier_points,
    lattice_paths,
    spline_course,
)
from spdm_models.motion_tokens import (
    TokenBox,
    corner_distance,
    draw,
    k_disks,
    nucleus,
    steps_between,
    tokenize,
)
from spdm_models.path_frame import nearest_point, signed_distance

from .models_common import check_named

LANES = ("0", "1")
"""Left and right lane of the synthetic road; each continues from block A to block B."""
HALF_LANE = 1.75
VEHICLE, CONE = 0, 1
SPEED_LIMIT = 11.0
PARTS = ("curvature", "distance", "lane_free", "hits_obstacle", "leaves_boundary")
GEOMETRY = {"f64": 1e-9, "f32": 1e-4}
SOLVE = 1e-7
# Float32 iterates drift; the best objective has to be as good.
BEST_OBJECTIVE = 0.1
POSE_APART = 0.1 + 1e-3
"""One row of the path, m."""
BOXES = {"unit": TokenBox(1.0, 1.0), "car": TokenBox(4.6, 2.0)}
MASSES = (0.5, 0.9, 0.95, 1.0)
TOKEN_MARGIN = 1e-5
"""Tokens this close to equally near may swap in float32, m."""

_lattice = jax.jit(lattice_paths)
_spline = jax.jit(spline_course)
_costs = jax.jit(path_costs)
_cheapest = jax.jit(cheapest_course)
_annotate = jax.jit(annotate)
_occupancy = jax.jit(occupancy)
_refine = jax.jit(refine)
_residuals = jax.jit(refinement_residuals)


def check_planner(match: re.Match, path: Path, report, dtype) -> None:
    """Stage by stage, each from the reference's own inputs."""
    data, name = np.load(path), path.name
    _curves(report, name, data, dtype)
    _paths(report, name, data, dtype)
    reference = _given_path(data, dtype)
    modes = jnp.asarray(data["pred/predictions"], dtype)
    neighbors = jnp.asarray(data["pred/neighbors_current"][: len(modes)], dtype)
    scores = jnp.asarray(data["pred/scores"], dtype)
    _frenet(report, name, modes, scores, reference, data)
    for mode, given in (("learned", modes), ("none", jnp.zeros_like(modes))):
        cells = np.unpackbits(data[f"occupancy_{mode}"], axis=1).astype(bool)
        ours = _occupancy(given, scores, neighbors, reference)
        report.equal(name, f"occupancy_{mode}", ours, cells)
        _refinement(report, name, mode, reference, jnp.asarray(cells), data, dtype)


def _curves(report, name, data, dtype) -> None:
    tol = GEOMETRY[report.precision]
    for i, row in enumerate(data["bezier/in"]):
        x0, y0, heading0, x1, y1, heading1 = (jnp.asarray(v, dtype) for v in row)
        count = int(data["bezier/n_points"][i])
        share = jnp.linspace(0, 1, count, dtype=dtype)
        ours = jnp.stack(bezier_points((x0, y0, heading0), (x1, y1, heading1), share), axis=-1)
        report.close(name, f"bezier/path{i}", ours, data[f"bezier/path{i}"], tol)
    report.not_compared(name, "bezier/control*", "a step on the way to the paths")
    knots = jnp.asarray(data["spline/in_xy"], dtype)
    course = _spline(knots[:, 0], knots[:, 1], jnp.asarray(len(knots)))
    _close_course(report, name, "spline/out", course, data["spline/out"])


def _close_course(report, name, array, course, reference) -> None:
    tol = GEOMETRY[report.precision]
    rows = np.stack([course.x, course.y, course.heading, course.curvature], -1)
    rows = rows[: int(course.count)]
    report.equal(name, f"{array} length", len(rows), len(reference))
    if len(rows) == len(reference):
        # Coordinates reach hundreds of metres.
        report.close(name, array, rows, reference, tol)


def _road(data, dtype) -> tuple[Polyline, Boundaries, list[int]]:
    """Candidate lanes, nearest first, and their outer edges."""
    ego = data["ego_pose"]
    lanes = [np.concatenate([data[f"map/A{i}"], data[f"map/B{i}"]]) for i in LANES]
    away = [np.hypot(*(lane[:, :2] - ego[:2]).T).min() for lane in lanes]
    order = [int(i) for i in np.argsort(away)]
    size = max(len(lane) for lane in lanes) + 1  # a padded point at least
    points, edges = np.zeros((2, size, 3)), np.zeros((2, size - 1, 4))
    valid = np.zeros((2, size - 1), bool)
    for row, i in enumerate(order):
        lane, side = lanes[i], HALF_LANE if i == 0 else -HALF_LANE
        points[row] = np.pad(lane, ((0, size - len(lane)), (0, 0)), mode="edge")
        outward = np.stack([-np.sin(lane[:, 2]), np.cos(lane[:, 2])], -1)
        edge = lane[:, :2] + side * outward
        edges[row, : len(lane) - 1] = np.concatenate([edge[:-1], edge[1:]], axis=1)
        valid[row, : len(lane) - 1] = True
    counts = jnp.asarray([len(lanes[i]) for i in order], jnp.int32)
    lines = Polyline(*(jnp.asarray(points[..., i], dtype) for i in range(3)), count=counts)
    fields = {key: jnp.asarray(edges[..., i], dtype) for i, key in enumerate(_EDGE)}
    return lines, Boundaries(**fields, valid=jnp.asarray(valid)), order


_EDGE = ("ax", "ay", "bx", "by")


def _ego_box(pose) -> Box:
    vehicle = VehicleParams()
    x, y, heading = pose
    ahead = vehicle.rear_axle_to_center
    x, y = x + ahead * jnp.cos(heading), y + ahead * jnp.sin(heading)
    half = [jnp.asarray(0.5 * v, x.dtype) for v in (vehicle.length, vehicle.width)]
    return box_at(x, y, heading, half[0], half[1])


def _paths(report, name, data, dtype) -> None:
    tol = GEOMETRY[report.precision]
    ego = tuple(jnp.asarray(v, dtype) for v in data["ego_pose"])
    lines, boundaries, order = _road(data, dtype)
    for row in range(len(order)):
        line = jax.tree.map(lambda v, row=row: v[row], lines)
        paths = _lattice(line, *ego)
        length = 0.25 * (int(paths.count[0]) + 1)
        array = f"lattice/candidate{row}"
        lane = np.stack([line.x, line.y, line.heading], -1)[: int(line.count)]
        left = lane[len(lane) - int(paths.count[0]) - 1 :]
        report.equal(name, f"{array} length", len(left), len(data[array]))
        if len(left) == len(data[array]):
            # The reference's headings are differences of points, ours the map's own.
            report.close(name, array, left[:, :2], data[array][:, :2], tol)
        known = [length, float(paths.distance)]
        report.close(name, f"{array}_len_dist", known, data[f"{array}_len_dist"], tol)
        for k in range(4):
            array = f"lattice/path{4 * row + k}"
            xy = np.stack([paths.x[k], paths.y[k]], -1)[: int(paths.count[k])]
            report.equal(name, f"{array} length", len(xy), len(data[array]))
            if len(xy) == len(data[array]):
                report.close(name, array, xy, data[array], tol)
    kind, x, y, heading, length, width, speed = (jnp.asarray(v, dtype) for v in data["objects"].T)
    boxes = box_at(x, y, heading, 0.5 * length, 0.5 * width)
    obstacle, moving = path_objects(boxes, kind == VEHICLE, kind == CONE, speed, _ego_box(ego))
    usable = jnp.ones(len(order), bool)
    costs = _costs(lines, usable, ego, boxes, obstacle, moving, boundaries)
    parts = data["lattice/cost_parts"]
    for i, key in enumerate(PARTS):
        value = np.asarray(getattr(costs, key), float)
        value = np.broadcast_to(value.reshape(len(order), -1), (len(order), 4)).reshape(-1)
        report.close(name, f"lattice/cost_parts {key}", value, parts[:, i], tol)
    for stay in (False, True):
        total = np.asarray(costs.total(jnp.asarray(stay))).reshape(-1)
        array = f"lattice/costs_stay{int(stay)}"
        report.close(name, array, total, data[array], tol)
    course, found = _cheapest(lines, ego, costs.total(jnp.asarray(False)))
    report.equal(name, "lattice/ref_path found", bool(found), True)
    _close_course(report, name, "lattice/ref_path", course, data["lattice/ref_path"])
    xy = jnp.asarray(data["annotate/red_lane"], dtype)[None]
    count = jnp.asarray([xy.shape[1]], jnp.int32)
    red = Polyline(xy[..., 0], xy[..., 1], jnp.zeros_like(xy[..., 0]), count)
    ours = _annotate(course, found, jnp.asarray(SPEED_LIMIT, dtype), red)
    array = "annotate/occupancy_from_red_lane"
    report.equal(name, array, ours.red_light, data[array][:, 0] != 0)
    report.close(name, "annotate/speed", ours.speed_limit, data["annotate/speed"][:, 0], tol)
    final = np.concatenate([ours.path, ours.curvature[:, None], ours.speed_limit[:, None]], -1)
    array = "ref_path_final"
    report.close(name, array, final, data[array][:, :5], max(tol, 1e-5), note="float32 array")
    report.not_compared(name, f"{array} red light", "its connectors are not in the file")


def _given_path(data, dtype) -> ReferencePath:
    rows = data["ref_path_final"]
    columns = jnp.asarray(rows, dtype)
    return ReferencePath(
        path=columns[:, :3],
        curvature=columns[:, 3],
        speed_limit=columns[:, 4],
        red_light=jnp.asarray(rows[:, 5] != 0),
        valid=jnp.asarray(True),
    )


@jax.jit
def _best_on_path(modes, scores, path):
    best = jnp.argmax(scores, axis=1)[:, None, None, None]
    xy = jnp.take_along_axis(modes, best, axis=1)[:, 0, :, :2]
    row = nearest_point(xy, path)
    return row, signed_distance(xy, path, row)


def _frenet(report, name, modes, scores, reference, data) -> None:
    row, beside = _best_on_path(modes, scores, reference.path)
    theirs = data["pred/frenet_best"]
    apart = np.abs(np.asarray(row) - np.round(theirs[..., 0] * 10))
    if report.precision == "f64":
        report.equal(name, "pred/frenet_best s", apart, np.zeros_like(apart))
    else:
        report.equal(name, "pred/frenet_best s rows apart", np.mean(apart > 0) > 0.01, False)
    same = apart == 0
    # The reference subtracts in float32.
    tol = max(GEOMETRY[report.precision], 1e-5)
    report.close(name, "pred/frenet_best l", beside, theirs[..., 1], tol, same)


def _refinement(report, name, mode, reference, cells, data, dtype) -> None:
    plan = jnp.asarray(data["refine/plan"], dtype)
    speed, acceleration = (jnp.asarray(data["refine/ego_state"][0, i], dtype) for i in (3, 5))
    start = plan_on_path(plan, reference.path)
    exact = report.precision == "f64"
    if mode == "learned":
        arc = np.concatenate([[0], np.asarray(start.row)]) * 0.1
        report.close(name, "refine/s0", arc, data["refine/s0"], 1e-5)
        report.close(name, "refine/ds0", start.speed, data["refine/ds0"], 1e-4)
    key = f"refine/{mode}/"
    parts = _residuals(
        jnp.maximum(start.speed, 0),
        speed,
        acceleration,
        start.row,
        cells,
        reference.speed_limit,
    )
    weighted = np.concatenate([WEIGHTS[part] * np.asarray(parts[part]) for part in WEIGHTS])
    tol = 1e-8 if exact else 1e-2
    array = f"{key}weighted_residual0"
    report.close(name, array, weighted, data[array], tol, note="entries up to 1e3")
    ours = _refine(plan, speed, acceleration, reference, cells)
    objectives = data[f"{key}objectives"]
    filled = np.isfinite(objectives)
    best = float(np.min(objectives[filled]))
    if exact:
        relative = np.where(filled, ours.solution.objectives / np.where(filled, objectives, 1), 1)
        report.close(name, f"{key}objectives", relative, np.ones_like(relative), SOLVE)
        report.close(name, f"{key}ds", ours.speed, data[f"{key}ds"], SOLVE)
        report.close(name, f"{key}s", ours.arc, data[f"{key}s"], SOLVE)
        values = ours.solution.values
        report.close(name, f"{key}gn_best_ds", values, data[f"{key}gn_best_ds"], SOLVE)
    else:
        worse = max(0.0, float(ours.solution.objective) / best - 1)
        report.close(
            name, f"{key}objectives", worse, 0.0, BEST_OBJECTIVE, note="best not worse by more"
        )
        why = "float32 iterates may end in another basin"
        report.not_compared(name, f"{key}ds, s, gn_best_ds, plan", why)
        return
    # The arc length is cut to a row of the path: rounding may move a pose by one.
    apart = np.abs(np.asarray(ours.poses) - data[f"{key}plan"]).max(axis=1)
    report.equal(name, f"{key}plan rows apart", np.mean(apart > 1e-4) > 0.03, False)
    report.close(name, f"{key}plan", ours.poses, data[f"{key}plan"], POSE_APART)


def check_tokens(match: re.Match, path: Path, report, dtype) -> None:
    """Vocabulary, closed-loop tokens, nucleus and draws."""
    data, name = np.load(path), path.name
    demos = jnp.asarray(data["demo_trajs"], dtype)
    tol = GEOMETRY[report.precision]
    steps = steps_between(demos[:, :-1], demos[:, 1:]).reshape(-1, 3)
    report.close(name, "actions", steps, data["actions"], tol)
    kept = k_disks(data["actions"], data["order"], float(data["eps"]), BOXES["unit"])
    report.equal(name, "kept", np.array_equal(kept, data["kept"]), True)
    vocabulary = data["actions"][kept] if len(kept) == len(data["vocab"]) else data["vocab"]
    report.close(name, "vocab", vocabulary, data["vocab"], 0.0)
    templates = jnp.asarray(data["vocab"], dtype)
    for box in BOXES:
        _tokens(report, name, box, demos[: len(data[f"tokens_{box}"])], templates, data)
    logits = jnp.asarray(data["logits"], dtype)
    uniform = jnp.asarray(data["u"], dtype)
    for mass in MASSES:
        if f"p{mass}/keep" not in data.files:
            report.not_compared(name, f"p{mass}", "not in the file")
            continue
        ours = nucleus(logits, mass)
        report.equal(name, f"p{mass}/keep", ours.keep, data[f"p{mass}/keep"])
        report.close(name, f"p{mass}/probs", ours.probs, data[f"p{mass}/probs"], min(tol, 1e-5))
        drawn = draw(ours.probs[:, None, :], uniform)
        report.equal(name, f"p{mass}/sampled", drawn, data[f"p{mass}/sampled"])


def _tokens(report, name, box, demos, templates, data) -> None:
    size = BOXES[box]
    ours = jax.jit(jax.vmap(lambda t: tokenize(t, templates, size)))(demos)
    tokens, theirs = np.asarray(ours.tokens), data[f"tokens_{box}"]
    same = np.logical_and.accumulate(tokens == theirs, axis=1)
    if report.precision == "f64":
        report.equal(name, f"tokens_{box}", tokens, theirs)
    else:
        _swapped(report, name, box, demos, tokens, same, data)
    poses, reference = np.asarray(ours.poses), data[f"recon_{box}"]
    tol = GEOMETRY[report.precision]
    xy = same[..., None]
    report.close(name, f"recon_{box} xy", poses[..., :2], reference[..., :2], tol, xy)
    headings = poses[..., 2], reference[..., 2]
    report.close(name, f"recon_{box} heading", *headings, tol, same, angle=True)


def _swapped(report, name, box, demos, tokens, same, data) -> None:
    """In float32 the first token that differs must be as near as the reference's, nearly."""
    demos, vocabulary = np.asarray(demos, float), data["vocab"]
    worst = 0.0
    for i in np.flatnonzero(~same.all(axis=1)):
        t = int(np.argmin(same[i]))
        before = demos[i, 0] if t == 0 else data[f"recon_{box}"][i, t - 1]
        truth = steps_between(jnp.asarray(before), jnp.asarray(demos[i, t + 1]))
        pair = [tokens[i, t], data[f"tokens_{box}"][i, t]]
        gaps = corner_distance(jnp.asarray(vocabulary[pair]), truth, BOXES[box])
        worst = max(worst, float(gaps[0] - gaps[1]))
    note = f"first swaps of {np.sum(~same.all(axis=1))} trajectories, by m"
    report.close(name, f"tokens_{box}", worst, 0.0, TOKEN_MARGIN, note=note)


CHECKS = {r"planner_seed\d+": check_planner, r"ar_tokens_seed\d+": check_tokens}


def check_gameformer_planner(path: Path, report, dtype) -> bool:
    """Runs the check that the file's name asks for; False if it is none of these."""
    return check_named(CHECKS, path, report, dtype)
