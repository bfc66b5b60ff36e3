"""Replays `closedloop_*` goldens: consecutive steps, planner memory, perfect ego simulation."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax.agents.forecast import constant_velocity
from spdm_jax.agents.observation import Observation, select_objects
from spdm_jax.config import NUM_STATES, PlannerConfig
from spdm_jax.decision import decide, notice, target_speeds
from spdm_jax.geometry import ego_box
from spdm_jax.tracking.lqr import track

from .pdm import observation_of, params_of
from .world import area_masks, ego_state, load_world, padded_grid, ragged, red_areas, state_array

CONFIG = PlannerConfig()


@partial(jax.jit, static_argnames=("config",))
def _step(
    ego, observation: Observation, collided, red, paths, speed_limit, grid, masks, params, config
):
    box = ego_box(ego, params.vehicle)
    selected = select_objects(observation, box.x, box.y, collided, params.map_radius, config)
    poses = constant_velocity(observation, selected)
    seen = notice(ego, observation, selected, poses, red, params.vehicle, config)
    center = jax.tree.map(lambda v: v[0], paths)
    decision = decide(
        ego,
        paths,
        target_speeds(speed_limit, params),
        seen,
        None,
        grid,
        masks,
        center,
        params,
        config,
    )
    size = collided.shape[0]
    collided = collided.at[jnp.where(seen.touching, seen.forecast.track, size)].set(
        True, mode="drop"
    )
    # The reference's simulator tracks the first 4 s.
    plan = jax.tree.map(lambda v: v[None, :NUM_STATES], decision.trajectory)
    states, _ = track(
        plan.x, plan.y, plan.heading, ego, params.vehicle, params.tracker, config.tracker
    )
    following = jax.tree.map(lambda v: v[0, 1], states)
    return decision, collided, seen.inside, following


def replay(path: Path, report, dtype) -> None:
    """Runs our planner on its own states and compares every step."""
    scene = path.with_name(path.name.replace("closedloop_", "scene_", 1))
    if not scene.exists():
        report.equal(path.name, "matching scene", False, True, note=f"{scene.name} is missing")
        return
    data, base = np.load(path), np.load(scene)
    world = load_world(base, dtype)
    params = params_of(base, world, dtype)
    drivable = [shapely.Polygon(ring - world.origin) for ring in ragged(data, "drivable")]
    crossings = [shapely.Polygon(ring - world.origin) for ring in ragged(base, "intersection")]
    grid = padded_grid([*drivable, *crossings], dtype)
    red = red_areas(ragged(base, "red"), world.origin, dtype)
    ego = ego_state(data["ego_states"][0], world.origin, dtype)
    collided = None
    steps = len(data["ego_states"])
    f64 = report.precision == "f64"
    state_tol, score_tol = (1e-5, 1e-6) if f64 else (5e-2, 1e-2)
    name, collected = path.name, {}

    def keep(array, ours, reference):
        collected.setdefault(array, []).append((np.asarray(ours), np.asarray(reference)))

    note = f"{steps} steps"
    for i in range(steps):
        masks = area_masks(
            data["drivable_active"][i],
            data["drivable_on_route"],
            len(drivable),
            len(crossings),
            grid.masks.shape[1],
        )
        observation = observation_of(base, world, dtype, data["raw_pose"][i])
        if collided is None:
            collided = jnp.zeros(observation.x.shape, bool)
        decision, collided, inside, following = _step(
            ego,
            observation,
            collided,
            red,
            world.paths,
            jnp.asarray(data["speed_limit"][i], dtype),
            grid,
            masks,
            params,
            config=CONFIG,
        )
        red = red.replace(ignored=red.ignored | inside)
        keep("loop ego_states", state_array(ego, world.origin), data["ego_states"][i])
        scores = decision.scores
        best, theirs = int(decision.best), int(data["best_index"][i])
        gap = float(data["scores"][i].max() - data["scores"][i][best])
        if best != theirs and gap <= (1e-9 if f64 else 1e-4):
            note = f"up to step {i}: a tie resolved otherwise ({best} for {theirs}, {gap:.1e})"
            break
        keep("loop scores", scores.total, data["scores"][i])
        multi = (scores.no_at_fault_collision, scores.drivable_area, scores.driving_direction)
        keep("loop multi_metrics", np.stack(multi), data["multi_metrics"][i])
        keep("loop best_index", best, theirs)
        keep("loop emergency_brake", bool(decision.emergency_brake), data["emergency_brake"][i])
        keep(
            "loop collided",
            np.asarray(collided)[: data["collided_raw"].shape[1]],
            data["collided_raw"][i],
        )
        keep(
            "loop trajectories",
            state_array(decision.trajectory, world.origin)[:, :3],
            data["trajectories"][i],
        )
        ego = following
    else:
        keep("loop ego_states", state_array(ego, world.origin), data["final_ego_state"])
    tolerances = {
        "loop ego_states": state_tol,
        "loop trajectories": state_tol * 10,
        "loop scores": score_tol,
    }
    for array, pairs in collected.items():
        ours, reference = (np.stack(v) for v in zip(*pairs, strict=True))
        if array in tolerances:
            if array != "loop scores":
                ours[..., 2] = reference[..., 2] + np.arctan2(
                    np.sin(ours[..., 2] - reference[..., 2]),
                    np.cos(ours[..., 2] - reference[..., 2]),
                )
            report.close(name, array, ours, reference, tolerances[array], note=note)
        else:
            report.equal(name, array, ours, reference)
