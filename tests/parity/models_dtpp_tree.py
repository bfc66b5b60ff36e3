"""`models/dtpp/tree_*` goldens: paths, expansions, scores and choice of DTPP's tree planner."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.geometry import box_at
from spdm_models import dtpp
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_paths import ReferencePaths, is_obstacle, reference_paths
from spdm_models.dtpp_planner import DTPPPlannerConfig, plan
from spdm_models.dtpp_tree import TreeConfig, expand, speed_coefficients, target_speeds
from spdm_models.lattice import Course, Polyline, lattice_paths
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures

from .models_common import load_weights

CONFIG = DTPPConfig(encoder=EncoderConfig(width=32))
TREE = TreeConfig(reference_wrap=True)
PLANNER = DTPPPlannerConfig(network=CONFIG, tree=TREE)
LANES = (("A0", "B0"), ("A1", "B1"))
VEHICLE, CONE = 0, 1
NO_LIMIT = 13.0
"""What the reference drives where a lane has no limit, m/s."""
GEOMETRY_TOLERANCE = {"f64": 1e-9, "f32": 1e-4}
# The reference's tree is float32 throughout.
STATE_TOLERANCE = 1e-5
FUTURE_TOLERANCE = {"f64": 4e-6, "f32": 2e-5}
SCORE_TOLERANCE = {"f64": 4e-5, "f32": 2e-4}
# States may fall to the next row of a path, 0.1 m away, where rounding decides: share of them.
ROWS_APART = 0.06
# Scores of a tree whose states lie that much apart.
TREE_SCORE_TOLERANCE = 0.5

_expand = jax.jit(expand, static_argnums=(4, 5))
_lattice = jax.jit(lattice_paths)
_reference_paths = jax.jit(reference_paths, static_argnums=5)


def _course(rows: np.ndarray, dtype) -> Course:
    x, y, heading, curvature = (jnp.asarray(rows[..., i], dtype) for i in range(4))
    count = jnp.full(rows.shape[:-2], rows.shape[-2], jnp.int32)
    return Course(x, y, heading, curvature, count)


def check_tree(match: re.Match, path: Path, report, dtype) -> None:
    """Stage by stage from the reference's own inputs, then the whole tree."""
    data, name = np.load(path), path.name
    rows = data["speed_poly/in_v0_a0_vf_tf"]
    v0, a0, vf, tf = (jnp.asarray(column, dtype) for column in rows.T)
    ours = jnp.stack(speed_coefficients(v0, a0, vf, tf), axis=-1)
    tol = GEOMETRY_TOLERANCE[report.precision]
    report.close(name, "speed_poly/coeffs", ours, data["speed_poly/coeffs"], tol)
    _paths(report, name, data, dtype)
    count = sum(key.startswith("paths/ref") for key in data.files)
    courses = _course(np.stack([data[f"paths/ref{i}"] for i in range(count)]), dtype)
    limit = _speed_limit(data)
    for key in sorted(k.removesuffix("/x0") for k in data.files if k.endswith("/x0")):
        root = bool(data[f"{key}/is_root"])
        given = data[f"{key}/x0"], data[f"{key}/v_grid"], data[f"{key}/trajs"]
        _expansion(report, name, key, given, courses, limit, root, dtype)
    _standalone(report, name, data, dtype)
    weights = path.with_name(f"{path.stem}_params.npz")
    if not weights.is_file():
        report.not_compared(name, "predict*, best_traj", f"{weights.name} is not beside it")
        return
    params = load_weights(weights, dtpp.abstract(CONFIG), dtpp.extras(CONFIG), dtype)
    features = SceneFeatures(
        ego_past=jnp.asarray(data["in/ego_agent_past"][0], dtype),
        neighbors_past=jnp.asarray(data["in/neighbor_agents_past"][0], dtype),
        lanes=jnp.asarray(data["in/map_lanes"][0], dtype),
        crosswalks=jnp.asarray(data["in/map_crosswalks"][0], dtype),
        route_lanes=jnp.asarray(data["in/route_lanes"][0], dtype),
    )
    for i, steps in enumerate((30, 80)):
        _predictions(report, name, f"predict{i}", params, features, steps, data, dtype)
    _whole_tree(report, name, params, features, courses, limit, data, dtype)


def _speed_limit(data) -> float:
    """The largest target speed that acceleration would have exceeded."""
    limits = [NO_LIMIT]
    for key in (k.removesuffix("/x0") for k in data.files if k.endswith("/x0")):
        gain = 7.2 if bool(data[f"{key}/is_root"]) else 5.0
        fastest = float(data[f"{key}/v_grid"][-1])
        if fastest < float(data[f"{key}/x0"][3]) + gain - 1e-3:
            limits.append(fastest)
    return limits[-1]


def _paths(report, name, data, dtype) -> None:
    """Lattice, costs and splines, from the lanes."""
    tol = GEOMETRY_TOLERANCE[report.precision]
    ego = tuple(jnp.asarray(v, dtype) for v in data["ego_pose_v_a"][:3])
    lanes = [np.concatenate([data[f"map/{part}"] for part in parts]) for parts in LANES]
    size = max(len(lane) for lane in lanes) + 1  # a padded point at least
    away = [np.hypot(*(lane[:, :2] - data["ego_pose_v_a"][:2]).T).min() for lane in lanes]
    # The golden's candidates come four a lane, the lane told by its distance.
    distances = data["paths/dist"]
    order = [int(np.argmin(np.abs(np.array(away) - d))) for d in distances[::4]]
    padded = np.stack(
        [np.pad(lanes[i], ((0, size - len(lanes[i])), (0, 0)), mode="edge") for i in order]
    )
    counts = jnp.asarray([len(lanes[i]) for i in order], jnp.int32)
    lines = Polyline(*(jnp.asarray(padded[..., i], dtype) for i in range(3)), count=counts)
    objects = data["objects"]
    kind, x, y, heading, length, width, speed = (jnp.asarray(column, dtype) for column in objects.T)
    boxes = box_at(x, y, heading, 0.5 * length, 0.5 * width)
    blocks = is_obstacle(kind == VEHICLE, kind == CONE, speed)
    valid = jnp.ones(len(order), bool)
    ours = _reference_paths(lines, valid, ego, boxes, blocks, TREE.num_paths)
    # Costs are told apart by 1e-3 m at most; float32 sums of metres.
    report.close(name, "paths/costs", np.asarray(ours.cost).reshape(-1), data["paths/costs"], tol)
    for line in range(len(order)):
        one = jax.tree.map(lambda v, line=line: v[line], lines)
        found = _lattice(one, *ego)
        report.close(name, "paths/dist", found.distance, distances[4 * line], tol)
        for k in range(4):
            array = f"paths/path{4 * line + k}"
            xy = np.stack([found.x[k], found.y[k]], -1)[: int(found.count[k])]
            report.equal(name, f"{array} length", len(xy), len(data[array]))
            if len(xy) == len(data[array]):
                report.close(name, array, xy, data[array], tol)
    for i in range(int(np.sum(ours.valid))):
        array = f"paths/ref{i}"
        course = jax.tree.map(lambda v, i=i: v[i], ours.course)
        rows = np.stack([course.x, course.y, course.heading, course.curvature], -1)
        rows = rows[: int(course.count)]
        report.equal(name, f"{array} length", len(rows), len(data[array]))
        if len(rows) == len(data[array]):
            report.close(name, array, rows, data[array], tol)


def _expansion(report, name, key, given, courses, limit, root, dtype) -> None:
    start, grid, reference = given
    targets = target_speeds(
        jnp.asarray(start[3], dtype),
        jnp.asarray(limit, dtype),
        3.0 if root else 5.0,
        TREE.first_range if root else TREE.second_range,
        len(grid),
    )
    report.close(name, f"{key} speeds", targets, grid, STATE_TOLERANCE)
    valid = jnp.ones(courses.x.shape[0], bool)
    start = jnp.asarray(start, dtype)
    states, kept = _expand(start, courses, valid, jnp.asarray(limit, dtype), root, TREE)
    ours = np.asarray(states)[np.asarray(kept)]
    report.equal(name, f"{key} branches", len(ours), len(reference))
    if len(ours) == len(reference):
        _close_states(report, name, key, ours, reference[..., :6])


def _close_states(report, name, key, ours, reference) -> None:
    """Columns x, y, heading, and speed, acceleration, curvature where there are any."""
    apart = np.any(np.abs(ours[..., :2] - reference[..., :2]) > 1e-3, axis=-1)
    note = f"{np.sum(apart)} of {apart.size} one row apart, left out" if apart.any() else ""
    report.equal(name, f"{key} rows apart", np.mean(apart) > ROWS_APART, False)
    report.close(name, key, ours, reference, STATE_TOLERANCE, ~apart[..., None], note=note)
    gap = np.hypot(*np.moveaxis(ours[..., :2] - reference[..., :2], -1, 0))
    report.close(name, f"{key} gap", gap, np.zeros_like(gap), 0.11)


def _standalone(report, name, data, dtype) -> None:
    """Expansions on analytic paths; from a leaf with the reference's rounding of it."""
    courses = _course(data["standalone/paths"], dtype)
    for j in sorted({k.split("/")[1] for k in data.files if k.startswith("standalone/")}):
        if not j.isdigit():
            continue
        key = f"standalone/{j}/"
        *start, limit = data[f"{key}x0_limit"]
        first, second = data[f"{key}first"], data[f"{key}second"]
        given = np.array(start), data[f"{key}v_grid_first"], first
        _expansion(report, name, f"{key}first", given, courses, limit, True, dtype)
        leaf = first[int(data[f"{key}second_from_leaf"]), -1]
        given = leaf, data[f"{key}v_grid_second"], second
        _expansion(report, name, f"{key}second", given, courses, limit, False, dtype)
        why = "the reference computes the flag but does not use it"
        report.not_compared(name, f"{key}feasible_first", why)


@partial(jax.jit, static_argnums=4)
def _decode(params, features, branches, valid, steps):
    encoding = dtpp.encode(params, CONFIG, features)
    output = dtpp.decode(params, CONFIG, encoding, features, branches, steps, branch_valid=valid)
    return output.futures, output.scoring.scores


def _predictions(report, name, key, params, features, steps, data, dtype) -> None:
    """The network on the reference's own branches."""
    given = data[f"{key}/ego_trajs"]
    count = len(given)
    branches = np.zeros((TREE.num_branches, 80, 6))
    branches[:count, :steps] = given[..., :6]
    valid = jnp.arange(TREE.num_branches) < count
    futures, scores = _decode(params, features, jnp.asarray(branches, dtype), valid, steps)
    tol = FUTURE_TOLERANCE[report.precision]
    futures = np.asarray(futures)[:count, :, :steps]
    report.close(name, f"{key}/agents", futures, data[f"{key}/agents"][0], tol)
    tol = SCORE_TOLERANCE[report.precision]
    report.close(name, f"{key}/scores", scores, data[f"{key}/scores"][0], tol)


_plan = jax.jit(plan, static_argnames="config")


def _whole_tree(report, name, params, features, courses, limit, data, dtype) -> None:
    """From the reference paths to the chosen trajectory."""
    paths = ReferencePaths(courses, jnp.ones(courses.x.shape[0], bool), jnp.zeros(()))
    speed, acceleration = (jnp.asarray(v, dtype) for v in data["ego_pose_v_a"][3:])
    given = params, features, paths, speed, acceleration, jnp.asarray(limit, dtype)
    found = _plan(*given, config=PLANNER)
    report.equal(name, "plan valid", bool(found.valid), True)
    for i, (stage, scores) in enumerate(
        ((found.first, found.first_scores), (found.second, found.second_scores))
    ):
        reference = data[f"predict{i}/ego_trajs"][..., :6]
        ours = np.asarray(stage.states)[np.asarray(stage.valid)]
        report.equal(name, f"tree {i} branches", len(ours), len(reference))
        if len(ours) == len(reference):
            _close_states(report, name, f"tree {i}", ours, reference)
            given = data[f"predict{i}/scores"][0]
            report.close(name, f"tree {i} scores", scores, given, TREE_SCORE_TOLERANCE)
    ours = np.stack([found.x, found.y, found.heading], -1)
    _close_states(report, name, "best_traj", ours, data["best_traj"])
