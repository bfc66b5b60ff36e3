"""Stages of one planning step, for the benchmark."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from spdm_jax import decision, planner
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.geometry import ego_box
from spdm_jax.proposals import idm, lanes, spline
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.types import Scenario


def stages(
    scene: Scenario, params: PlannerParams, config: PlannerConfig
) -> list[tuple[str, Callable[[], Any]]]:
    """Returns the stages of one planning step, each compiled alone and fed by the one before.

    Args:
      scene: one scenario on the device.
      params: traced settings.
      config: static settings.

    Returns:
      Names and calls; each call waits for its result.
    """
    params = decision.cast_params(params, scene.ego.x.dtype)
    vehicle, ego = params.vehicle, planner.observe(scene, 0).ego
    calls: list[tuple[str, Callable[[], Any]]] = []

    def run(name: str, function, *arguments):
        compiled = jax.jit(function)
        calls.append((name, lambda: jax.block_until_ready(compiled(*arguments))))
        return compiled(*arguments)

    state = run("init", lambda s: planner.init(s, params, config), scene)
    seen = run(
        "see", lambda s, m: planner.see(s, planner.observe(s, 0), m, params, config), scene, state
    )

    def look_up(s, now):
        box = ego_box(now, vehicle)
        near, parks = lanes.drivable_lanes(s.map, box.x, box.y, params.map_radius)
        lane = lanes.starting_lane(s.map, s.route, near, now, vehicle)
        return lane, lanes.area_masks(s.map, s.route.lane_on_route, near, parks)

    lane, masks = run("look up lanes", look_up, scene, ego)
    targets = decision.target_speeds(scene.map.lanes.speed_limit[lane], params)
    start = jax.vmap(lambda path: idm.project(path, ego.x, ego.y))(state.paths)
    contents = run(
        "corridors",
        lambda p, at, v, w: idm.corridor_contents(p, at, v.max(), w.forecast, w.red, vehicle),
        state.paths,
        start,
        targets,
        seen,
    )
    run(
        "IDM rollout",
        lambda p, at, now, v, w, c: idm.rollout(
            p, at, now.vx, v, w.forecast, w.red, c, vehicle, params.idm, 41
        ),
        state.paths,
        start,
        ego,
        targets,
        seen,
        contents,
    )
    stage1 = jax.jit(lambda p, now, v, w: decision.stage1_proposals(p, now, v, w, params))(
        state.paths, ego, targets, seen
    )
    center = jax.tree.map(lambda leaf: leaf[0], state.paths)
    routes = driven = None
    if config.num_route_paths:

        def route_lanes(s, m, now, at, v):
            paths = spline.route_lane_paths(
                s.map.lanes,
                s.route,
                m.slot,
                s.map.lanes.roadblock[at],
                jax.tree.map(lambda leaf: leaf[0], m.paths),
                m.goal,
                now,
                params.spline,
                config.num_route_paths,
                config.max_path_points,
            )
            return paths, spline.drive(paths, now, v, params.spline, 81)

        routes, driven = run("route lanes", route_lanes, scene, state, ego, lane, targets)
    proposals = decision.merge(stage1, driven, routes)
    tracked = run(
        "track",
        lambda p, now: track(p.x, p.y, p.heading, now, vehicle, params.tracker)[0],
        proposals,
        ego,
    )
    run(
        "score",
        lambda t, ok, m, w, path, grid: score_trajectories(
            t, ok, World(grid, m, w.forecast, path), vehicle, params.scoring
        ),
        tracked,
        proposals.valid,
        masks,
        seen,
        center,
        scene.map.grid,
    )
    run(
        "extend to 8 s",
        lambda p, v, one, w: decision.extend_stage1(p, jnp.int32(0), v, one, w, params),
        state.paths,
        targets,
        stage1,
        seen,
    )
    return calls
