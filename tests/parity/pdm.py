"""Checks of the PDM goldens: `scene_*`, `scorer_*` and `closedloop_*` files."""

from functools import partial
from pathlib import Path as FilePath

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.agents.forecast import constant_velocity
from spdm_jax.agents.observation import Observation, select_objects
from spdm_jax.config import DT, PlannerConfig, PlannerParams
from spdm_jax.decision import (
    Seen,
    Stage1,
    brake_trajectory,
    cast_params,
    decide,
    extend_stage1,
    notice,
    target_speeds,
)
from spdm_jax.geometry import ego_box, interpolate
from spdm_jax.proposals import idm
from spdm_jax.proposals.lanes import parallel_path
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.scoring.collision import collision_kind, first_contacts
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import reference_profiles, track

from . import report as limits
from .report import SCORE_TOLERANCE
from .world import (
    GoldenWorld,
    ego_state,
    load_world,
    pad,
    power_bucket,
    ragged,
    red_areas,
    state_array,
)

CONFIG = PlannerConfig()


@partial(jax.jit, static_argnames=("num_states",))
def _rollout(paths, start, speed, targets, forecast, red, contents, vehicle, params, num_states):
    rolled = idm.rollout(
        paths, start, speed, targets, forecast, red, contents, vehicle, params, num_states
    )
    return rolled, jax.vmap(interpolate)(paths, rolled.progress)


_contents = jax.jit(idm.corridor_contents)
_track = jax.jit(track, static_argnames=("tracker",))
_profiles = jax.jit(reference_profiles, static_argnames=("tracker",))
_score = jax.jit(score_trajectories)
_decide = jax.jit(decide, static_argnames=("config",))
_notice = jax.jit(notice, static_argnames=("config",))
_select = jax.jit(select_objects, static_argnames=("config",))


@jax.jit
def _extend_all(paths, targets, rolled, pose, contents, seen, params):
    """8 s poses of every proposal."""
    x, y, heading = pose
    stage1 = Stage1(x, y, heading, rolled, contents)
    count = rolled.progress.shape[0] * rolled.progress.shape[1]
    one = lambda i: extend_stage1(paths, i, targets, stage1, seen, params)
    return jax.lax.map(one, jnp.arange(count))


def params_of(data, world: GoldenWorld, dtype) -> PlannerParams:
    """Planner parameters of a stored scene."""
    params = PlannerParams(
        speed_fractions=np.asarray(data["idm_speed_limit_fraction"], float),
        lateral_offsets=np.asarray(data["lateral_offsets"], float),
        map_radius=float(data["map_radius"]),
        vehicle=world.vehicle,
        idm=world.idm,
    )
    return cast_params(params, dtype)


def observation_of(data, world: GoldenWorld, dtype, pose=None) -> Observation:
    """All tracked objects of a stored scene, padded."""
    box = np.array(data["raw_box"], float)
    if pose is not None:
        box[:, :3] = pose
    box[:, :2] -= world.origin
    size = power_bucket(max(len(box), 1), 16 if len(box) <= 16 else 128)
    column = lambda values, kind=dtype: jnp.asarray(pad(values, size), kind)
    velocity = np.asarray(data["raw_velocity"], float)
    return Observation(
        x=column(box[:, 0]),
        y=column(box[:, 1]),
        heading=column(box[:, 2]),
        vx=column(velocity[:, 0]),
        vy=column(velocity[:, 1]),
        length=column(box[:, 3]),
        width=column(box[:, 4]),
        type=column(data["raw_type"], jnp.int32),
        valid=jnp.asarray(np.arange(size) < len(box)),
        lights=jnp.zeros(1, jnp.int8),
        step=jnp.asarray(0, jnp.int32),
    )


def stored_contents(data, world: GoldenWorld, dtype) -> idm.CorridorContents:
    """Corridor contents as the reference saw them, with its tie-breaking order."""
    hit = np.asarray(data["corridor_hit"])
    width = world.size + world.red.valid.shape[0]
    shape = (*hit.shape[:2], width)
    last = np.iinfo(np.int32).max - 1
    out = np.zeros(shape, bool), np.zeros(shape), np.full(shape, last, np.int32)
    out[0][..., world.columns] = hit
    out[1][..., world.columns] = np.where(hit, data["corridor_progress"], 0)
    out[2][..., world.columns] = np.where(hit, data["corridor_rank"], last)
    return idm.CorridorContents(
        jnp.asarray(out[0]), jnp.asarray(out[1], dtype), jnp.asarray(out[2])
    )


def areas_array(scores) -> np.ndarray:
    """Ego areas in the reference's column order."""
    return np.stack([scores.multiple_lanes, scores.non_drivable, scores.oncoming], -1)


def compare_scores(
    report, name, prefix, scores, data, *, robust, robust_areas, tolerance, whole=None
):
    """Everything that the scorer returns; `whole` marks rows without a tie resolved otherwise."""
    f64 = report.precision == "f64"
    whole = np.ones(len(data["scores"]), bool) if whole is None else whole
    report.equal(
        name, f"{prefix}ego_areas", areas_array(scores), data["ego_areas"], robust_areas[..., None]
    )
    multi = np.stack((scores.no_at_fault_collision, scores.drivable_area, scores.driving_direction))
    report.equal(name, f"{prefix}multi_metrics", multi, data["multi_metrics"], robust)
    weighted = data["weighted_metrics"]
    report.equal(name, f"{prefix}ttc", scores.time_to_collision, weighted[1], robust)
    report.equal(name, f"{prefix}comfort", scores.comfort, weighted[2], robust)
    flags = np.asarray(scores.comfort_flags)
    report.equal(name, f"{prefix}comfort_flags", flags, data["comfort_flags"], robust[:, None])
    for ours, key in ((scores.collision_time, "collision"), (scores.ttc_time, "ttc")):
        index = np.round(np.asarray(ours) / DT, 3)
        report.equal(name, f"{prefix}{key}_time_idx", index, data[f"{key}_time_idx"], robust)
    raw = np.asarray(scores.progress_raw)
    # Near a bend's centre of curvature a projection multiplies rounding.
    slack = 1 if f64 else 10
    report.close(name, f"{prefix}progress_raw", raw, data["progress_raw"], tolerance * slack, whole)
    # Progress is normalised over the set: one flipped or tied row would move every score.
    same_rows = whole & (multi == data["multi_metrics"]).all(axis=0)
    same_rows &= np.asarray(scores.comfort) == weighted[2]
    same_rows &= np.asarray(scores.time_to_collision) == weighted[1]
    if same_rows.all():
        bound = SCORE_TOLERANCE[report.precision] * (1 if f64 else 10)
        report.close(name, f"{prefix}scores", scores.total, data["scores"], bound)


def compare_best(report, name, array, best: int, data_scores, reference: int):
    """Same proposal, or one whose reference score is as good."""
    slack = {"f64": 1e-9, "f32": 1e-4}[report.precision]
    same = best == reference
    margin = float(np.max(data_scores) - data_scores[best])
    note = "" if same else f"chose {best}, reference {reference}, margin {margin:.2e}"
    report.equal(name, array, same or margin <= slack, True, note=note)


def check_scene(path: FilePath, report, dtype) -> None:
    """Stage by stage on the reference's own inputs, then the whole chain."""
    data = np.load(path)
    name = path.name
    world = load_world(data, dtype)
    params = params_of(data, world, dtype)
    far = bool(np.max(np.abs(data["ego_state"][:2])) > 1e5)
    state_tol = limits.FAR_TOLERANCE if far else limits.STATE_TOLERANCE["f64"]
    if report.precision == "f32":
        state_tol = limits.STATE_TOLERANCE["f32"]
    num_paths, num_policies = len(data["lateral_offsets"]), len(data["idm_target_velocity"])
    num = num_paths * num_policies
    targets = jnp.asarray(data["idm_target_velocity"], dtype)
    robust = ~data[f"fragile_metrics_{'1e-6' if report.precision == 'f64' else '1e-4'}"]
    robust_areas = ~data[f"fragile_areas_{'1e-6' if report.precision == 'f64' else '1e-4'}"]
    ego = ego_state(data["ego_state"], world.origin, dtype)

    def pose_rows(ours, reference, array, tolerance, mask=None):
        ours = np.asarray(ours, float)
        shift = world.origin
        report.close(
            name,
            f"{array} xy",
            ours[..., :2] + shift,
            reference[..., :2],
            tolerance,
            None if mask is None else mask[..., None],
        )
        report.close(
            name, f"{array} heading", ours[..., 2], reference[..., 2], tolerance, mask, True
        )

    # Observation and forecast.
    observation = observation_of(data, world, dtype)
    center = ego_box(ego, world.vehicle)
    excluded = jnp.zeros(observation.x.shape, bool)
    selected = _select(observation, center.x, center.y, excluded, params.map_radius, config=CONFIG)
    picked = np.asarray(selected.track)[np.asarray(selected.valid)]
    report.equal(
        name, "obj_raw_index", _same_length(picked, data["obj_raw_index"]), data["obj_raw_index"]
    )
    poses = constant_velocity(observation, selected)
    supplied_forecast = name.startswith("scene_fc_")
    if not supplied_forecast and len(picked) == world.num_objects:
        ours = np.stack([poses.x, poses.y], -1)[: len(picked)]
        theirs = np.asarray(data["obj_corners"]).mean(2).swapaxes(0, 1) - world.origin
        report.close(name, "forecast", ours, theirs, state_tol)
    red = red_areas(ragged(data, "red"), world.origin, dtype)
    seen_now = _notice(ego, observation, selected, poses, red, world.vehicle, config=CONFIG)
    lights = int(np.sum(np.asarray(red.valid)))
    touching = np.concatenate(
        [np.asarray(seen_now.touching)[: len(picked)], np.asarray(seen_now.inside)[:lights]]
    )
    report.equal(
        name,
        "initially_collided",
        _same_length(touching, data["initially_collided"]),
        data["initially_collided"],
    )
    report.close(
        name,
        "target_velocity",
        target_speeds(jnp.asarray(data["speed_limit"], dtype), params),
        targets,
        state_tol,
    )

    # Paths.
    center_path = jax.tree.map(lambda v: v[0], world.paths)
    parallel = jax.vmap(parallel_path, (None, 0))(center_path, params.lateral_offsets)
    for row, points in enumerate(ragged(data, "path")):
        ours = np.stack([parallel.x[row], parallel.y[row]], -1)[: len(points)] + world.origin
        report.close(name, f"path {row}", ours, points[:, :2], state_tol)
    progress = np.concatenate(
        [np.asarray(world.paths.progress[i])[: len(p)] for i, p in enumerate(ragged(data, "path"))]
    )
    report.close(name, "path_progress", progress, data["path_progress"], state_tol)

    # Corridors and IDM.
    start = jnp.asarray(data["idm_state"][::num_policies, 0, 0], dtype)
    contents = _contents(
        world.paths, start, targets.max(), world.forecast, world.red, world.vehicle
    )
    columns = world.columns
    hit = np.asarray(data["corridor_hit"])
    ours = np.asarray(contents.hit)[..., columns]
    report.equal(name, "corridor_hit", ours, hit)
    at = np.asarray(contents.progress)[..., columns]
    both = hit & ours
    report.close(name, "corridor_progress", at, data["corridor_progress"], state_tol * 10, both)
    stored = stored_contents(data, world, dtype)
    rolled, pose = _rollout(
        world.paths,
        start,
        ego.vx,
        targets,
        world.forecast,
        world.red,
        stored,
        world.vehicle,
        world.idm,
        num_states=41,
    )
    flat = lambda v: np.asarray(v, float).reshape(num, -1)
    idm_state = np.stack([flat(rolled.progress), flat(rolled.speed)], -1)
    report.close(name, "idm_state", idm_state, data["idm_state"], state_tol)
    lead = np.stack([flat(v) for v in rolled.leader], -1)
    report.close(name, "lead_state", lead, data["lead_state"], state_tol * 10)
    lookup = np.full(world.size + len(np.asarray(world.red.valid)), -9)
    lookup[columns] = np.arange(len(columns))
    index = np.asarray(rolled.leader_index).reshape(num, -1)
    index = np.where(index >= 0, lookup[index], index)
    report.equal(name, "lead_object", index, data["lead_object"][:, :41])
    pose_rows(np.stack([flat(v) for v in pose], -1), data["proposal_states"], "proposal", state_tol)
    seen = Seen(world.forecast, world.red, world.forecast.ignored, world.red.ignored)
    extended = _extend_all(world.paths, targets, rolled, pose, stored, seen, params)
    pose_rows(np.stack(extended, -1), data["ext_se2"], "ext_se2", state_tol * 2)

    # Tracking.
    reference = ego_state(data["proposal_states"], world.origin, dtype)
    speed, curvature = _profiles(reference.x, reference.y, reference.heading, tracker="reference")
    report.close(name, "ref_velocity_profile", speed, data["ref_velocity_profile"], state_tol)
    report.close(name, "ref_curvature_profile", curvature, data["ref_curvature_profile"], state_tol)
    states, commands = _track(
        reference.x,
        reference.y,
        reference.heading,
        ego,
        world.vehicle,
        cast_params(PlannerParams(), dtype).tracker,
        tracker="reference",
    )
    report.close(name, "lqr_commands", commands, data["lqr_commands"], state_tol * 10)
    _compare_states(
        report, name, "sim_states", state_array(states, world.origin), data["sim_states"], state_tol
    )

    # Scoring.
    simulated = ego_state(data["sim_states"], world.origin, dtype)
    box = ego_box(simulated, world.vehicle)
    report.close(
        name,
        "ego_corners",
        np.stack([box.x, box.y], -1) + world.origin,
        data["ego_corners"][:, :, 4],
        state_tol,
    )
    valid = jnp.ones(num, bool)
    scored = _score(
        simulated,
        valid,
        World(world.grid, world.masks, world.forecast, center_path),
        world.vehicle,
        params.scoring,
    )
    compare_scores(
        report,
        name,
        "",
        scored,
        data,
        robust=robust,
        robust_areas=robust_areas,
        tolerance=state_tol,
    )
    _compare_events(report, name, simulated, world, params, data, robust)
    combined = aggregate(
        jnp.asarray(np.prod(data["multi_metrics"], 0), dtype),
        jnp.asarray(data["progress_raw"], dtype),
        jnp.asarray(data["weighted_metrics"][1], dtype),
        jnp.asarray(data["weighted_metrics"][2], dtype),
        valid,
        params.scoring,
    )
    report.close(
        name, "aggregate", combined.total, data["scores"], SCORE_TOLERANCE[report.precision]
    )
    pose_rows(
        np.stack(brake_trajectory(ego, world.vehicle, params.brake), -1),
        data["brake_trajectory"],
        "brake_trajectory",
        state_tol,
    )

    # The whole chain, from raw objects to the plan.
    if supplied_forecast:
        seen_now = seen
    decision = _decide(
        ego,
        world.paths,
        targets,
        seen_now,
        None,
        world.grid,
        world.masks,
        center_path,
        params,
        config=CONFIG,
    )
    chain_tol = limits.CHAIN_TOLERANCE[report.precision]
    chain_tol = max(chain_tol, state_tol) * (10 if report.precision == "f64" else 1)
    # A tie may be resolved otherwise; from there on the proposal differs, and so do the later
    # policies of the same path, into which its leader's speed leaks.
    ties = np.asarray(data["lead_tie"]).reshape(num_paths, num_policies, -1)
    tied = np.logical_or.accumulate(np.logical_or.accumulate(ties[..., :41], 2), 1)
    untied = ~tied.reshape(num, -1)
    whole = np.atleast_1d(untied.all(axis=1))
    ours = np.stack([decision.proposals.x, decision.proposals.y, decision.proposals.heading], -1)
    pose_rows(ours, data["proposal_states"], "chain proposal", chain_tol, untied)
    _compare_states(
        report,
        name,
        "chain sim_states",
        state_array(decision.tracked, world.origin),
        data["sim_states"],
        chain_tol,
        whole[:, None],
    )
    compare_scores(
        report,
        name,
        "chain ",
        decision.scores,
        data,
        robust=robust & whole,
        robust_areas=robust_areas & whole[:, None],
        tolerance=chain_tol,
        whole=whole,
    )
    best, theirs = int(decision.best), int(data["best_index"])
    compare_best(report, name, "chain best_index", best, data["scores"], theirs)
    report.equal(
        name, "chain emergency_brake", bool(decision.emergency_brake), bool(data["emergency_brake"])
    )
    if best == theirs and whole[best] and not data["lead_tie"][best].any():
        plan = state_array(decision.trajectory, world.origin)[:, :3] - [*world.origin, 0]
        pose_rows(plan, data["final_trajectory"], "chain final_trajectory", chain_tol * 2)


def _same_length(ours: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Cuts or fills, so that a wrong count shows up as mismatches."""
    out = np.full(len(reference), -9, ours.dtype if ours.dtype != bool else int)
    out[: min(len(ours), len(reference))] = ours[: len(reference)]
    return out


def _compare_states(report, name, array, ours, reference, tolerance, mask=None):
    plain = [0, 1, *range(3, 11)]
    # Accelerations and angular accelerations are differences over 0.1 s.
    weight = np.where(np.isin(np.arange(11), (8, 10)), 0.01, np.where(np.arange(11) == 5, 0.1, 1.0))
    if report.precision == "f64":
        weight = np.ones(11)
    wide = None if mask is None else mask[..., None]
    report.close(
        name, array, (ours * weight)[..., plain], (reference * weight)[..., plain], tolerance, wide
    )
    report.close(name, f"{array} heading", ours[..., 2], reference[..., 2], tolerance, mask, True)


def _compare_events(report, name, simulated, world, params, data, robust):
    """First contact of each proposal and object: time and kind."""
    contacts = first_contacts(simulated, world.forecast, world.vehicle, params.scoring)
    num, steps = simulated.x.shape
    row, item = np.indices(contacts.time.shape)
    when = jnp.minimum(contacts.time, steps - 1)
    kinds = collision_kind(
        simulated, world.forecast, row, item, when, world.vehicle, params.scoring
    )
    kinds = np.where(np.asarray(contacts.time) < steps, kinds, -1)
    first = np.full((num, world.num_objects, 2), -1)
    for proposal, time, index, kind, *_ in np.asarray(data["collision_events"]).astype(int)[::-1]:
        first[proposal, index] = time, kind
    time = np.asarray(contacts.time)[:, : world.num_objects]
    kind = kinds[:, : world.num_objects]
    time = np.where(time < simulated.x.shape[1], time, -1)
    report.equal(name, "first contacts", np.stack([time, kind], -1), first, robust[:, None, None])


def check_scorer(path: FilePath, report, dtype) -> None:
    """Random trajectories in the world of the scene of the same name."""
    scene = path.with_name(path.name.replace("scorer_", "scene_", 1))
    if not scene.exists():
        report.equal(path.name, "matching scene", False, True, note=f"{scene.name} is missing")
        return
    data, world = np.load(path), load_world(np.load(scene), dtype)
    level = "1e-6" if report.precision == "f64" else "1e-4"
    robust, robust_areas = ~data[f"fragile_metrics_{level}"], ~data[f"fragile_areas_{level}"]
    states = ego_state(data["states"], world.origin, dtype)
    params = cast_params(PlannerParams(), dtype)
    center = jax.tree.map(lambda v: v[0], world.paths)
    scored = _score(
        states,
        jnp.ones(len(data["states"]), bool),
        World(world.grid, world.masks, world.forecast, center),
        world.vehicle,
        params.scoring,
    )
    tolerance = limits.STATE_TOLERANCE[report.precision]
    compare_scores(
        report,
        path.name,
        "random ",
        scored,
        data,
        robust=robust,
        robust_areas=robust_areas,
        tolerance=tolerance,
    )
