"""Checks of the NAVSIM goldens: frames with all stages of both profiles, and two unit files.

They are told apart from other files of the same name by the arrays that they hold. Every stage is
fed the reference's own inputs; the results run the whole chain from poses.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.navsim import score as navsim
from spdm_jax.navsim import timing
from spdm_jax.navsim.batch import to_device
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.observation import replay
from spdm_jax.navsim.two_stage import follow_up_weights
from spdm_jax.navsim.types import NavsimScene, NavsimScores
from spdm_jax.scoring.aggregate import relative_progress
from spdm_jax.scoring.comfort import comfort_signals, within_bounds
from spdm_jax.scoring.history_comfort import (
    EXTENDED_BOUNDS,
    center_comfort_signals,
    plan_differences,
    plan_features,
)
from spdm_jax.scoring.lights import STEPS_PER_FRAME
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, NAVSIM2_UNFILTERED, Profile
from spdm_jax.tracking.lqr import reference_profiles
from spdm_jax.types import EgoState

from .report import Report
from .world import ego_state, pad, state_array

# Metres, radians and their rates; scores. Roundings to 8 decimals may fall the other way.
STATES = {"f64": 1e-9, "f32": 1e-3}
SCORES = {"f64": 1e-9, "f32": 1e-3}
SIGNALS = {"f64": 2e-8, "f32": 1e-3}
NOISE = {"f64": "1e-6", "f32": "1e-4"}
STEPS = 41
# Columns of the stored results.
V1_ORDER = (
    "no_at_fault_collision",
    "drivable_area",
    "progress",
    "time_to_collision",
    "comfort",
    "driving_direction",
)
V2_ORDER = (*NAVSIM2.multipliers, "progress", "time_to_collision", "lane_keeping", "comfort")

_chain = jax.jit(navsim.score_trajectories, static_argnames=("profile",))
_alone = jax.jit(navsim.score_states, static_argnames=("profile",))
_replay = jax.jit(replay, static_argnames=("profile",))
_profiles = jax.jit(reference_profiles, static_argnames=("tracker",))


@jax.jit
def _drive(scene: NavsimScene, poses: jax.Array) -> dict:
    human = scene.human_poses[None]
    at = partial(navsim.reference_poses, ego=scene.ego, sampling=scene.sampling)
    return {
        "poses": at(poses),
        "human": at(human),
        "states": navsim.simulate(scene, poses),
        "human_states": navsim.simulate(scene, human),
        "reference_states": navsim.simulate_reference(scene),
        "previous": navsim.simulate_previous(scene),
    }


def check_navsim(path: Path, report: Report, dtype) -> bool:
    """Compares a file of NAVSIM's; False if it is none."""
    with np.load(path) as file:
        names = set(file.files)
        if path.name.startswith("scene_") and {"v1_results", "v2_results"} <= names:
            check = _check_scene
        elif {"ec_features_41", "v2_flags_41"} <= names:
            check = _check_comfort
        elif {"first_stage_endpoint", "second_stage_start"} <= names:
            check = _check_weights
        else:
            return False
        data = {name: file[name] for name in names}
    check(path.name, data, report, dtype)
    return True


def _check_scene(name: str, data: dict[str, np.ndarray], report: Report, dtype) -> None:
    scenes = {}
    for version in ("v1", "v2"):
        given = {**data, "reference": data[f"{version}_pdm_ref"]}
        scenes[version] = to_device(from_arrays(given, name=name), dtype)
    _times(name, data, report)
    _driven(name, data, report, scenes, dtype)
    for version, profile in (("v1", NAVSIM1), ("v2", NAVSIM2)):
        scene = scenes[version]
        _objects(name, data, report, scene, version, profile, dtype)
        # One previous plan is enough where extended comfort is not compared.
        single = scene.replace(previous=scene.previous.replace(poses=scene.previous.poses[:1]))
        tracked = np.concatenate([data[f"{version}_pdm_sim"][None], data["sim_states"]])
        direct = data["direct_states"]
        room = max(len(tracked), len(direct))  # one program for both
        for prefix, given in ((f"{version}_", tracked), (f"direct_{version}_", direct)):
            states = pad(given, room)
            states[..., :2] -= scene.origin
            scored = _alone(single, jnp.asarray(states, dtype), profile=profile)
            count = len(given)
            scored = jax.tree.map(lambda v, n=count: _rows(v, n), scored)
            _stages(name, data, report, scored, prefix, version, profile)
        _results(name, data, report, scene, version, dtype)


def _rows(values, count: int) -> np.ndarray:
    values = np.asarray(values)
    return values[:count] if values.ndim else values


def _times(name: str, data: dict[str, np.ndarray], report: Report) -> None:
    start = int(data["start_time_us"])
    report.equal(name, "pose_times_us", timing.pose_times(start), data["pose_times_us"])
    report.equal(name, "sample_times_us", timing.sample_times(start), data["sample_times_us"])
    times, states = timing.past_samples(data["ego_past"], data["ego_past_us"])
    report.equal(name, "history_us", times, data["history_us"])
    report.close(name, "history_states", states, data["history_states"], STATES["f64"])


def _driven(name: str, data: dict[str, np.ndarray], report: Report, scenes, dtype) -> None:
    """Interpolation and simulation."""
    tolerance = STATES[report.precision]
    scene = scenes["v1"]
    origin = scene.origin
    driven = _drive(scene, jnp.asarray(data["poses"], dtype))
    second = _drive(scenes["v2"], jnp.asarray(data["poses"], dtype))

    def poses(array, ours, theirs):
        xy = np.stack([np.asarray(ours.x), np.asarray(ours.y)], -1) + origin
        report.close(name, f"{array} xy", xy, theirs[..., :2], tolerance)
        heading = np.asarray(ours.heading)
        report.close(name, f"{array} heading", heading, theirs[..., 2], tolerance, None, True)

    def states(array, ours, theirs):
        ours = state_array(ours, origin)
        angle = np.arange(ours.shape[-1]) == 2
        report.close(name, f"{array} heading", ours[..., 2], theirs[..., 2], tolerance, None, True)
        # Rates of 0.1 s differences carry the rounding of positions tenfold and more.
        for part, columns, slack in (("", slice(0, 10), 1), (" yaw acceleration", [10], 50)):
            keep = [i for i in np.arange(11)[columns] if not angle[i]]
            slack = 1 if report.precision == "f64" else slack
            report.close(
                name, f"{array}{part}", ours[..., keep], theirs[..., keep], tolerance * slack
            )

    poses("ref_se2", driven["poses"], data["ref_se2"])
    poses("human_ref", driven["human"], data["human_ref"][None])
    states("sim_states", driven["states"], data["sim_states"])
    states("human_sim", driven["human_states"], data["human_sim"][None])
    states("v1_pdm_sim", driven["reference_states"], data["v1_pdm_sim"][None])
    states("v2_pdm_sim", second["reference_states"], data["v2_pdm_sim"][None])
    earlier, stored = driven["previous"], data["prev_sim_heading_acceleration"]
    accel = np.stack([np.asarray(earlier.ax), np.asarray(earlier.ay)], -1)
    report.close(name, "prev_sim acceleration", accel, stored[..., 1:], tolerance)
    heading = np.asarray(earlier.heading)
    report.close(name, "prev_sim heading", heading, stored[..., 0], tolerance, None, True)
    reference = ego_state(pad(data["ref_se2"], 11, axis=2), origin, dtype)
    speed, curvature = _profiles(reference.x, reference.y, reference.heading, tracker="reference")
    report.close(name, "ref_velocity_profile", speed, data["ref_velocity_profile"], tolerance)
    report.close(name, "ref_curvature_profile", curvature, data["ref_curvature_profile"], tolerance)


def _objects(name, data, report, scene, version, profile: Profile, dtype) -> None:
    """The replay, before and after objects at the ego's start are dropped."""
    tolerance = STATES[report.precision]
    count = len(data["obj_type"])
    whole = _replay(scene.objects, scene.ego, scene.vehicle, profile=profile)
    row = lambda values: np.asarray(values)[:count]
    valid = row(whole.sample_valid)
    pose = np.stack([row(whole.x), row(whole.y), row(whole.heading)], -1)
    pose[..., :2] += scene.origin
    pose = np.where(valid[..., None], pose, np.nan).swapaxes(0, 1)
    theirs = data[f"{version}_obj_pose"]
    report.equal(name, f"{version}_obj_valid", valid.T, data[f"{version}_obj_valid"])
    report.close(name, f"{version}_obj_pose xy", pose[..., :2], theirs[..., :2], tolerance)
    there = data[f"{version}_obj_valid"]
    report.close(
        name, f"{version}_obj_pose heading", pose[..., 2], theirs[..., 2], tolerance, there, True
    )
    known, agent = np.isfinite(data[f"{version}_obj_first_speed"]), data["obj_is_agent"]
    report.equal(name, f"{version}_obj_is_agent", row(whole.is_agent), agent)
    report.close(
        name,
        f"{version}_obj_first_speed",
        row(whole.speed),
        data[f"{version}_obj_first_speed"],
        tolerance,
        known & agent,
    )
    if version == "v2":
        removed = ~row(whole.valid) & valid.any(axis=1)
        report.equal(name, "v2_obj_removed", removed, data["v2_obj_removed"])
        lights = len(data["log_red"])
        active = np.repeat(np.asarray(scene.red.red), STEPS_PER_FRAME, axis=1)[:lights, :STEPS]
        report.equal(name, "red_active", active.T, data["red_active"])


def _stages(name, data, report, scored: NavsimScores, prefix, version, profile: Profile) -> None:
    """Sub-scores of given states, before the human filter."""
    robust = ~data[f"{prefix}fragile_{NOISE[report.precision]}"]
    terms = scored.raw
    areas = np.stack([scored.multiple_lanes, scored.non_drivable, scored.oncoming], -1)
    equal = lambda array, ours, theirs: report.equal(
        name, prefix + array, ours, theirs, robust.reshape(-1, *(1,) * (np.ndim(ours) - 1))
    )
    equal("ego_areas", areas, data[f"{prefix}ego_areas"])
    rows = [terms.no_at_fault_collision, terms.drivable_area]
    if version == "v2":
        rows += [terms.traffic_light, terms.driving_direction]
    multi = np.stack(rows)
    equal("multi_metrics", multi.T, data[f"{prefix}multi_metrics"].T)
    equal("ttc", terms.time_to_collision, data[f"{prefix}ttc"])
    for array, index in (("collision", scored.collision_index), ("ttc", scored.ttc_index)):
        time = np.where(index < STEPS, index, np.inf)
        equal(f"{array}_time_idx", time, data[f"{prefix}{array}_time_idx"])
    if version == "v1":
        equal("comfort_flags", scored.comfort_flags, data[f"{prefix}comfort_flags"])
        equal("driving_direction", terms.driving_direction, data[f"{prefix}driving_direction"])
    else:
        flags = scored.comfort_flags
        equal("history_comfort_flags", flags, data[f"{prefix}history_comfort_flags"])
        equal("history_comfort", terms.comfort, data[f"{prefix}history_comfort"])
        equal("lane_keeping", terms.lane_keeping, data[f"{prefix}lane_keeping"])
    tolerance = STATES[report.precision]
    raw = scored.progress_raw
    report.close(name, f"{prefix}progress_raw", raw, data[f"{prefix}progress_raw"], tolerance)
    _batch(name, data, report, scored, prefix, profile, robust)


def _batch(name, data, report, scored, prefix, profile: Profile, robust) -> None:
    """Progress and scores of a whole set in one call, relative to the set's best."""
    multiplier = np.prod([getattr(scored.raw, term) for term in profile.multipliers], axis=0)
    if not robust.all():
        return  # one row that may be judged otherwise moves all of them
    progress = relative_progress(
        np.asarray(scored.progress_raw, float),
        multiplier,
        np.max(scored.progress_raw * multiplier),
        profile.progress_threshold,
        multiplied=profile.progress_multiplied,
        xp=np,
    )
    tolerance = SCORES[report.precision]
    report.close(name, f"{prefix}batch_ep", progress, data[f"{prefix}batch_ep"], tolerance)
    weights = {term: w for term, w in profile.weights if term != "extended_comfort"}
    terms = scored.raw.replace(progress=progress)
    mean = sum(w * getattr(terms, term) for term, w in weights.items()) / sum(weights.values())
    total = multiplier * mean
    report.close(name, f"{prefix}batch_score", total, data[f"{prefix}batch_score"], tolerance)


def _results(name, data, report, scene, version, dtype) -> None:
    """The benchmark's numbers, from poses."""
    tolerance = SCORES[report.precision]
    robust = ~data[f"{version}_fragile_{NOISE[report.precision]}"]
    # The human and the reference are judged with every trajectory.
    robust = robust[1:] & robust[0]
    poses = jnp.asarray(data["poses"], dtype)
    get = lambda profile: jax.tree.map(np.asarray, _chain(scene, poses, profile=profile))

    def column(array, ours, theirs, discrete):
        if discrete:
            report.equal(name, array, ours, theirs, robust)
        else:
            report.close(name, array, ours, theirs, tolerance, robust)

    if version == "v1":
        scored = get(NAVSIM1)
        for i, term in enumerate(V1_ORDER):
            ours, theirs = getattr(scored.filtered, term), data["v1_results"][:, i]
            column(f"v1_results {term}", ours, theirs, term != "progress")
        column("v1_results PDMS", scored.total, data["v1_results"][:, 6], False)
        return
    scored = get(NAVSIM2)
    human = np.array([getattr(scored.human, term) for term in V2_ORDER])
    report.equal(name, "v2_human_metrics", human, data["v2_human_metrics"])
    for i, term in enumerate(V2_ORDER):
        ours, theirs = getattr(scored.filtered, term), data["v2_results"][:, i]
        column(f"v2_results {term}", ours, theirs, term != "progress")
    product = np.prod([getattr(scored.filtered, term) for term in NAVSIM2.multipliers], axis=0)
    column("v2_results product", product, data["v2_results"][:, 8], True)
    extended = scored.raw.extended_comfort
    column("v2_extended_comfort", extended, data["v2_extended_comfort"], True)
    column("v2_epdms", scored.total, data["v2_epdms"], False)
    without = scored.total_without_extended_comfort
    column("v2_epdms_no_ec", without, data["v2_epdms_no_ec"], False)
    for array, ours in (
        ("v2_epdms_unfiltered", scored.total_unfiltered),
        ("v2_epdms_unfiltered profile", get(NAVSIM2_UNFILTERED).total),
    ):
        column(array, ours, data["v2_epdms_unfiltered"], False)


def _check_comfort(name: str, data: dict[str, np.ndarray], report: Report, dtype) -> None:
    vehicle, params = VehicleParams(), ScoringParams()
    bound = SIGNALS[report.precision]

    def signals(array, ours, theirs):
        ours = np.stack([np.asarray(v) for v in ours.values()], 1)
        # Yaw accelerations of noisy headings are large: float32 is judged relative to them.
        scale = 1 if report.precision == "f64" else np.maximum(1, np.abs(theirs).max(-1))[..., None]
        report.close(name, array, ours / scale, theirs / scale, bound)

    def flags(array, ours, theirs, values):
        ours = np.asarray(within_bounds(ours, params))
        report.equal(name, array, ours, theirs, _clear(values, report))

    for size in (41, 55):
        heading, ax, ay, rate, turn = jnp.moveaxis(
            jnp.asarray(data[f"states_{size}"], dtype), -1, 0
        )
        ours = center_comfort_signals(heading, ax, ay, rate**2 + turn, vehicle)
        signals(f"v2_signals_{size}", ours, data[f"v2_signals_{size}"])
        flags(f"v2_flags_{size}", ours, data[f"v2_flags_{size}"], data[f"v2_signals_{size}"])
    heading, ax, ay, rate, turn = jnp.moveaxis(jnp.asarray(data["states_41"], dtype), -1, 0)
    ours = comfort_signals(_moving(heading, ax, ay))
    signals("v1_signals_41", ours, data["v1_signals_41"])
    flags("v1_flags_41", ours, data["v1_flags_41"], data["v1_signals_41"])
    signals("ec_features_41", plan_features(heading, ax, ay, STEPS), data["ec_features_41"])
    first, second = (
        _moving(*jnp.moveaxis(jnp.asarray(data[f"ec_{which}"], dtype), -1, 0))
        for which in ("first", "second")
    )
    rms = np.asarray(plan_differences(first, second, 0))
    report.close(name, "ec_rms", rms, data["ec_rms"], bound)
    bounds = np.array(list(EXTENDED_BOUNDS.values()))
    margin = np.abs(data["ec_rms"] - bounds).min(1) > bound
    report.equal(name, "ec_pass", (rms <= bounds).all(1), data["ec_pass"], margin)


def _clear(values: np.ndarray, report: Report) -> np.ndarray:
    """Signals `[B, 6, T]` farther from their bounds than float32 rounds, `[B, 6]`."""
    if report.precision == "f64":
        return np.ones(values.shape[:2], bool)
    low = np.array([-4.05, -4.89, -8.37, -4.13, -1.93, -0.95])[:, None]
    high = np.array([2.40, 4.89, 8.37, 4.13, 1.93, 0.95])[:, None]
    return np.all(np.minimum(np.abs(values - low), np.abs(values - high)) > 1e-3, axis=-1)


def _moving(heading, ax, ay) -> EgoState:
    zero = jnp.zeros_like(heading)
    given = {"heading": heading, "ax": ax, "ay": ay}
    return EgoState(**{field: given.get(field, zero) for field in EgoState.__dataclass_fields__})


def _check_weights(name: str, data: dict[str, np.ndarray], report: Report, dtype) -> None:
    ends = jnp.asarray(data["first_stage_endpoint"], dtype)
    starts = jnp.asarray(data["second_stage_start"], dtype)
    bound = 1e-12 if report.precision == "f64" else 1e-4
    report.close(name, "weight", follow_up_weights(ends, starts), data["weight"], bound)
