"""PDM-Closed and SPDM: one planning step, as a pure function.

`init` and `step` carry what the planner remembers in closed loop; `plan` is the first step alone.
Read `step`: it spells the whole method.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.forecast import (
    ForecastPoses,
    assemble,
    constant_velocity,
    perfect,
    supplied,
)
from spdm_jax.agents.observation import (
    Observation,
    RedLights,
    SelectedObjects,
    ego_contacts,
    ego_inside,
    red_lights,
    select_objects,
)
from spdm_jax.config import (
    DT,
    NUM_STATES,
    NUM_TRAJECTORY_STATES,
    BrakeParams,
    PlannerConfig,
    PlannerParams,
    VehicleParams,
)
from spdm_jax.geometry import Path, ego_box, interpolate, point_segment_sq, project
from spdm_jax.proposals import idm
from spdm_jax.proposals.lanes import (
    area_masks,
    drivable_lanes,
    nearest_heading,
    parallel_path,
    polygons_containing,
    sequence_path,
    starting_lane,
)
from spdm_jax.proposals.spline import RouteLanePaths, drive, route_lane_paths
from spdm_jax.scoring.areas import AreaMasks
from spdm_jax.scoring.driving import progress
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.types import (
    AgentForecast,
    Array,
    EgoState,
    PolygonGrid,
    ProposalSet,
    Scenario,
    SubScores,
)

LANE_CHANGE_OFFSET = 0.5
"""Lateral offset below which a lane change is complete, m."""
LANE_CHANGE_HEADING = jnp.pi / 18
"""Heading error below which a lane change is complete, rad."""


class PlannerState(struct.PyTreeNode, kw_only=True):
    """What a planner remembers between steps.

    Attributes:
      paths: stage-1 paths `[L, M]`, the first is the centreline; made at the first step and kept.
      goal: goal path `[M]`.
      slot: `[]` int32, route slot the centreline starts from.
      collided: `[A]` bool, tracks met at an earlier step.
      passed_lights: `[Lanes]` bool, red lights the ego was entirely inside.
      overflow: `[]` bool, a fixed buffer was too small; results are not to be used.
    """

    paths: Path
    goal: Path
    slot: Array
    collided: Array
    passed_lights: Array
    overflow: Array


class PlanResult(struct.PyTreeNode, kw_only=True):
    """Outcome of one planning step.

    Attributes:
      trajectory: chosen plan `[81]` at 0.1 s; as in the reference only poses are filled.
      best: `[]` int32, first proposal with the highest score.
      emergency_brake: `[]` bool, the trajectory is the brake's.
      proposals: reference poses.
      tracked: simulated proposals `[P, 41]`.
      scores: sub-scores, progress along the configured reference.
      progress_centerline, progress_goal: `[P]` raw progress along either reference, m.
      forecast: the objects the scores saw.
      target_speed: `[K]` m/s.
      starting_lane: `[]` int32.
      overflow: `[]` bool, a fixed buffer was too small; results are not to be used.
    """

    trajectory: EgoState
    best: Array
    emergency_brake: Array
    proposals: ProposalSet
    tracked: EgoState
    scores: SubScores
    progress_centerline: Array
    progress_goal: Array
    forecast: AgentForecast
    target_speed: Array
    starting_lane: Array
    overflow: Array


class StepInput(struct.PyTreeNode, kw_only=True):
    """What a planner is given at one step.

    Attributes:
      ego: current state, scalars.
      observation: objects and lights.
      forecast: a supplied forecast for all tracks (`[A, S]` fields), or None.
    """

    ego: EgoState
    observation: Observation
    forecast: ForecastPoses | None = None


def observe(scene: Scenario, iteration: jax.Array | int = 0) -> StepInput:
    """Reads one step of the recording."""
    at = scene.num_history + iteration
    tracks = scene.tracks
    column = lambda values: values[:, at]
    return StepInput(
        ego=jax.tree.map(lambda values: values[at], scene.ego),
        observation=Observation(
            x=column(tracks.x),
            y=column(tracks.y),
            heading=column(tracks.heading),
            vx=column(tracks.vx),
            vy=column(tracks.vy),
            length=column(tracks.length),
            width=column(tracks.width),
            type=tracks.type,
            valid=column(tracks.valid),
            lights=scene.lights[at],
            step=jnp.asarray(at, jnp.int32),
        ),
    )


def _stage1_paths(scene: Scenario, slot, params: PlannerParams, config: PlannerConfig):
    lines, route = scene.map.lanes.centerline, scene.route
    size = config.max_path_points
    center, overflow = sequence_path(lines, route.centerline_lanes[slot], size)
    offsets = jnp.asarray(params.lateral_offsets, center.x.dtype)
    paths = jax.vmap(parallel_path, in_axes=(None, 0))(center, offsets)
    # The first path is the centreline itself, not a copy moved by zero.
    paths = jax.tree.map(lambda all_, one: all_.at[0].set(one), paths, center)
    goal, goal_overflow = sequence_path(lines, route.goal_lanes[slot], size)
    return paths, goal, overflow | goal_overflow


def init(scene: Scenario, params: PlannerParams, config: PlannerConfig) -> PlannerState:
    """Creates centreline and parallel paths from the ego's lane at iteration 0.

    Args:
      scene: one scenario on the device, floats of one dtype.
      params: traced settings.
      config: static settings.
    """
    params = cast_params(params, scene.ego.x.dtype)
    ego = jax.tree.map(lambda values: values[scene.num_history], scene.ego)
    box = ego_box(ego, params.vehicle)
    lanes, _ = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    lane = starting_lane(scene.map, scene.route, lanes, ego, params.vehicle)
    slot = scene.route.slot_of_lane[lane]
    paths, goal, overflow = _stage1_paths(scene, slot, params, config)
    return PlannerState(
        paths=paths,
        goal=goal,
        slot=slot.astype(jnp.int32),
        collided=jnp.zeros(scene.tracks.type.shape, bool),
        passed_lights=jnp.zeros(scene.map.lanes.valid.shape, bool),
        overflow=overflow | (lane < 0),
    )


def cast_params(params: PlannerParams, dtype) -> PlannerParams:
    """Brings every parameter to the scene's dtype."""
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), params)


class Seen(NamedTuple):
    """The world at one step as the planner takes it in.

    Attributes:
      forecast: selected objects and their future; those that touch the ego now are ignored.
      red: red lights on the route; those the ego stands in are ignored.
      touching: `[A']` bool, forecast rows in contact with the ego.
      inside: `[R]` bool, red lights the ego is entirely inside.
    """

    forecast: AgentForecast
    red: RedLights
    touching: jax.Array
    inside: jax.Array


def notice(
    ego: EgoState,
    observation: Observation,
    selected: SelectedObjects,
    poses: ForecastPoses,
    red: RedLights,
    vehicle: VehicleParams,
    config: PlannerConfig,
) -> Seen:
    """Joins objects, forecast and lights, and marks what the ego touches right now.

    Source: tuplan_garage `PDMObservation.update` (the list of collided tokens).
    """
    box = ego_box(ego, vehicle)
    forecast = assemble(
        observation,
        selected,
        poses,
        jnp.zeros(selected.valid.shape, bool),
        hide_agents=config.forecast == "none",
    )
    now = [values[:, 0] for values in (forecast.x, forecast.y, forecast.heading)]
    touching = forecast.valid & ego_contacts(box, *now, forecast.length, forecast.width)
    inside = ego_inside(red, box)
    return Seen(
        forecast.replace(ignored=touching),
        red.replace(ignored=red.ignored | inside),
        touching,
        inside,
    )


def see(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
) -> Seen:
    """Selects objects, forecasts them and collects the red lights of the route."""
    ego = ego_box(given.ego, params.vehicle)
    observation = given.observation
    selected = select_objects(observation, ego.x, ego.y, state.collided, params.map_radius, config)
    if given.forecast is not None:
        poses = supplied(given.forecast, selected)
    elif config.forecast == "perfect":
        poses = perfect(observation, selected, scene.tracks)
    else:
        poses = constant_velocity(observation, selected)
    red = red_lights(
        observation.lights,
        scene.route.lane_on_route,
        state.passed_lights,
        scene.map.lanes.polygon,
        config.max_red_lights,
        config.max_red_edges,
    )
    return notice(given.ego, observation, selected, poses, red, params.vehicle, config)


def _mark(flags: jax.Array, index: jax.Array, where: jax.Array) -> jax.Array:
    """Sets `flags[index]` where asked."""
    return flags.at[jnp.where(where, index, flags.shape[0])].set(True, mode="drop")


def _completed_lane_change(scene: Scenario, state: PlannerState, ego: EgoState) -> jax.Array:
    """Slot to continue on: a new one where a lane change off the centreline is complete."""
    lanes, route = scene.map.lanes, scene.route
    num = lanes.valid.shape[0]
    sequence = route.centerline_lanes[state.slot]
    on_center = (
        jnp.zeros(num, bool).at[jnp.where(sequence >= 0, sequence, num)].set(True, mode="drop")
    )
    here = polygons_containing(lanes.polygon, ego.x, ego.y, num)
    _, heading = nearest_heading(lanes.centerline, ego.x, ego.y)
    error = jnp.abs(jnp.arctan2(jnp.sin(heading - ego.heading), jnp.cos(heading - ego.heading)))
    candidate = here & route.lane_on_route & ~on_center & (error < LANE_CHANGE_HEADING)
    lane = jnp.argmin(jnp.where(candidate, error, jnp.inf))
    count = lanes.centerline.count[lane]
    # Distance to the lane's baseline, by its segments.
    line = lanes.centerline
    ax, ay = line.points[:-1, 0], line.points[:-1, 1]
    bx, by = line.points[1:, 0], line.points[1:, 1]
    square, _ = point_segment_sq(ego.x, ego.y, ax, ay, bx, by)
    index = jnp.arange(square.shape[0])
    start = line.start[lane]
    within = (index >= start) & (index < start + count - 1)
    offset = jnp.sqrt(jnp.min(jnp.where(within, square, jnp.inf)))
    done = jnp.any(candidate) & (offset < LANE_CHANGE_OFFSET)
    return jnp.where(done, route.slot_of_lane[lane], state.slot).astype(jnp.int32)


def _follow_lane_change(
    scene: Scenario,
    state: PlannerState,
    ego: EgoState,
    params: PlannerParams,
    config: PlannerConfig,
) -> PlannerState:
    """Rebuilds centreline, parallels and goal path once a lane change is complete."""
    slot = _completed_lane_change(scene, state, ego)
    changed = slot != state.slot
    paths, goal, overflow = _stage1_paths(scene, slot, params, config)
    keep = lambda new, old: jnp.where(changed, new, old)
    return state.replace(
        paths=jax.tree.map(keep, paths, state.paths),
        goal=jax.tree.map(keep, goal, state.goal),
        slot=slot,
        overflow=state.overflow | (changed & overflow),
    )


class _Stage1(NamedTuple):
    """Stage-1 proposals and what the winner's extension needs."""

    x: jax.Array  # [L, K, T]
    y: jax.Array
    heading: jax.Array
    rollout: idm.IDMRollout
    contents: idm.CorridorContents


def _stage1(
    paths: Path,
    ego: EgoState,
    target_speed: jax.Array,
    seen: Seen,
    params: PlannerParams,
) -> _Stage1:
    start = jax.vmap(lambda path: project(path, ego.x, ego.y))(paths)
    contents = idm.corridor_contents(
        paths, start, jnp.max(target_speed), seen.forecast, seen.red, params.vehicle
    )
    rolled = idm.rollout(
        paths,
        start,
        ego.vx,
        target_speed,
        seen.forecast,
        seen.red,
        contents,
        params.vehicle,
        params.idm,
        NUM_STATES,
    )
    x, y, heading = jax.vmap(interpolate)(paths, rolled.progress)
    return _Stage1(x, y, heading, rolled, contents)


def _extend_stage1(
    paths: Path,
    index: jax.Array,
    target_speed: jax.Array,
    stage1: _Stage1,
    seen: Seen,
    params: PlannerParams,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Poses of stage-1 proposal `index` over the whole 8 s, `[81]` each."""
    num_policies = target_speed.shape[0]
    row, policy = index // num_policies, index % num_policies
    path = jax.tree.map(lambda v: v[row], paths)
    rolled, contents = stage1.rollout, stage1.contents
    last = lambda v: v[row, policy, -1]
    rank = jnp.broadcast_to(contents.rank, contents.hit.shape)
    progress, _ = idm.extend(
        path,
        last(rolled.progress),
        last(rolled.speed),
        jax.tree.map(last, rolled.leader),
        target_speed[policy],
        contents.hit[row],
        contents.progress[row],
        rank[row],
        seen.forecast,
        seen.red,
        params.vehicle,
        idm.at_policies(params.idm, policy),
        NUM_STATES,
        NUM_TRAJECTORY_STATES,
    )
    return interpolate(path, jnp.concatenate([rolled.progress[row, policy], progress]))


def brake_trajectory(
    ego: EgoState, vehicle: VehicleParams, params: BrakeParams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Emergency-brake poses `[81]` of the rear axle.

    Constant speed along the current heading, usually backwards: the controller turns that into
    braking.

    Source: tuplan_garage `PDMEmergencyBrake._generate_trajectory`.
    """
    reach = vehicle.rear_axle_to_center
    speed = ego.vx
    accel = ego.ax + reach * (ego.yaw_rate**2 + ego.yaw_acceleration)
    low, high = -params.max_decel, params.max_accel
    moving = 1.1 * (speed + jnp.clip(-10 * speed, low, high))
    standing = jnp.clip(-4 * speed - accel, low, high)
    rate = jnp.where(speed > 0.2, moving, standing)
    way = rate * DT * jnp.arange(NUM_TRAJECTORY_STATES, dtype=ego.x.dtype)
    return (
        ego.x + way * jnp.cos(ego.heading),
        ego.y + way * jnp.sin(ego.heading),
        jnp.broadcast_to(ego.heading, way.shape),
    )


def target_speeds(speed_limit: jax.Array, params: PlannerParams) -> jax.Array:
    """Target speed of each policy `[K]`: fraction x limit, or x fallback where it is unknown."""
    limit = jnp.where(jnp.isnan(speed_limit), params.idm.fallback_speed, speed_limit)
    return params.speed_fractions * limit


def _merge(stage1: _Stage1, stage2: tuple | None, route_paths: RouteLanePaths | None):
    """Joins both stages into a `ProposalSet` `[P, 41]`."""
    num_paths, num_policies, _ = stage1.x.shape
    count = num_paths * num_policies
    flat = lambda v: v.reshape(-1, v.shape[-1])
    index = jnp.arange(count, dtype=jnp.int32)
    proposals = ProposalSet(
        x=flat(stage1.x),
        y=flat(stage1.y),
        heading=flat(stage1.heading),
        valid=jnp.ones(count, bool),
        path=index // num_policies,
        policy=index % num_policies,
        stage=jnp.ones(count, jnp.int32),
        lane=jnp.full(count, -1, jnp.int32),
    )
    if stage2 is None or route_paths is None:
        return proposals
    x, y, heading, valid = stage2
    index = jnp.arange(valid.size, dtype=jnp.int32)
    second = ProposalSet(
        x=flat(x)[:, :NUM_STATES],
        y=flat(y)[:, :NUM_STATES],
        heading=flat(heading)[:, :NUM_STATES],
        valid=valid.reshape(-1),
        path=num_paths + index // num_policies,
        policy=index % num_policies,
        stage=jnp.full(index.shape, 2, jnp.int32),
        lane=jnp.repeat(route_paths.lane, num_policies),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), proposals, second)


class Decision(NamedTuple):
    """Proposals, their scores and the choice; see `PlanResult`."""

    trajectory: EgoState
    best: jax.Array
    emergency_brake: jax.Array
    proposals: ProposalSet
    tracked: EgoState
    scores: SubScores


def decide(
    ego: EgoState,
    paths: Path,
    target_speed: jax.Array,
    seen: Seen,
    route_paths: RouteLanePaths | None,
    grid: PolygonGrid,
    masks: AreaMasks,
    progress_path: Path,
    params: PlannerParams,
    config: PlannerConfig,
) -> Decision:
    """Proposes, tracks, scores and chooses on given paths.

    Args:
      ego: current state, scalars.
      paths: stage-1 paths `[L, M]`.
      target_speed: `[K]` m/s.
      seen: objects and lights.
      route_paths: stage-2 paths, or None.
      grid: point-in-polygon index.
      masks: polygons that count at this step.
      progress_path: where progress is measured.
      params: traced settings, cast to the dtype of the ego.
      config: static settings.
    """
    vehicle = params.vehicle
    with jax.named_scope("propose"):
        stage1 = _stage1(paths, ego, target_speed, seen, params)
        stage2 = None
        if route_paths is not None:
            stage2 = drive(route_paths, ego, target_speed, params.spline, NUM_TRAJECTORY_STATES)
        proposals = _merge(stage1, stage2, route_paths)
    with jax.named_scope("track"):
        reference = (proposals.x, proposals.y, proposals.heading)
        tracked, _ = track(*reference, ego, vehicle, params.tracker, config.tracker)
    with jax.named_scope("score"):
        world = World(grid, masks, seen.forecast, progress_path)
        scores = score_trajectories(tracked, proposals.valid, world, vehicle, params.scoring)
    with jax.named_scope("choose"):
        best = jnp.argmax(scores.total).astype(jnp.int32)
        braking = (scores.collision_time[best] <= params.brake.time_threshold) & (
            jnp.hypot(ego.vx, ego.vy) <= params.brake.speed_threshold
        )
        num_stage1 = stage1.x.shape[0] * stage1.x.shape[1]
        first = jnp.minimum(best, num_stage1 - 1)
        chosen = _extend_stage1(paths, first, target_speed, stage1, seen, params)
        if stage2 is not None:
            row = jnp.maximum(best - num_stage1, 0)
            second = [v.reshape(-1, NUM_TRAJECTORY_STATES)[row] for v in stage2[:3]]
            chosen = [
                jnp.where(best < num_stage1, a, b) for a, b in zip(chosen, second, strict=True)
            ]
        brake = brake_trajectory(ego, vehicle, params.brake)
        pose = [jnp.where(braking, b, c) for b, c in zip(brake, chosen, strict=True)]
    return Decision(poses_only(*pose), best, braking, proposals, tracked, scores)


def poses_only(x: jax.Array, y: jax.Array, heading: jax.Array) -> EgoState:
    """States with everything but the pose zero, as the reference returns its plan."""
    rest = [name for name in EgoState.__dataclass_fields__ if name not in ("x", "y", "heading")]
    return EgoState(x=x, y=y, heading=heading, **{name: jnp.zeros_like(x) for name in rest})


def step(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
) -> tuple[PlanResult, PlannerState]:
    """Plans once: see, prepare paths, propose, track, score, choose, brake if needed.

    Args:
      scene: map and route (and recorded tracks for perfect prediction).
      given: ego and observation of this step.
      state: what `init` or the previous step left.
      params: traced settings.
      config: static settings.

    Returns:
      The plan and the state for the next step.

    Source: tuplan_garage `PDMClosedPlanner`; paper, Section "Spline-Fitting PDM".
    """
    ego = given.ego
    params = cast_params(params, ego.x.dtype)
    box = ego_box(ego, params.vehicle)
    with jax.named_scope("see"):
        seen = see(scene, given, state, params, config)
        lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
        lane = starting_lane(scene.map, scene.route, lanes, ego, params.vehicle)
        masks = area_masks(scene.map, scene.route.lane_on_route, lanes, parks)
    target_speed = target_speeds(scene.map.lanes.speed_limit[lane], params)

    route_paths = None
    if config.num_route_paths:
        with jax.named_scope("route_lanes"):
            state = _follow_lane_change(scene, state, ego, params, config)
            route_paths = route_lane_paths(
                scene.map.lanes,
                scene.route,
                state.slot,
                scene.map.lanes.roadblock[lane],
                jax.tree.map(lambda v: v[0], state.paths),
                state.goal,
                ego,
                params.spline,
                config.num_route_paths,
                config.max_path_points,
            )
    centerline = jax.tree.map(lambda v: v[0], state.paths)
    by_goal = config.progress_reference == "goal" or (
        config.progress_reference == "auto" and config.num_route_paths > 0
    )
    decision = decide(
        ego,
        state.paths,
        target_speed,
        seen,
        route_paths,
        scene.map.grid,
        masks,
        state.goal if by_goal else centerline,
        params,
        config,
    )
    tracked, raw = decision.tracked, decision.scores.progress_raw
    other = progress_of(tracked, centerline if by_goal else state.goal, params.vehicle)
    overflow = state.overflow | seen.red.overflow
    if route_paths is not None:
        overflow |= route_paths.overflow
    result = PlanResult(
        **decision._asdict(),
        progress_centerline=other if by_goal else raw,
        progress_goal=raw if by_goal else other,
        forecast=seen.forecast,
        target_speed=target_speed,
        starting_lane=lane,
        overflow=overflow,
    )
    following = state.replace(
        collided=_mark(state.collided, seen.forecast.track, seen.touching),
        passed_lights=_mark(state.passed_lights, seen.red.lane, seen.inside),
        overflow=overflow,
    )
    return result, following


def progress_of(tracked: EgoState, path: Path, vehicle: VehicleParams) -> jax.Array:
    """Raw progress `[P]` of tracked proposals along a path, m."""
    box = ego_box(tracked, vehicle)
    return progress(path, box.x, box.y)


def plan(
    scene: Scenario,
    params: PlannerParams,
    config: PlannerConfig,
    forecast: ForecastPoses | None = None,
) -> PlanResult:
    """Plans once at iteration 0.

    Args:
      scene: one scenario on the device.
      params: traced settings.
      config: static settings.
      forecast: for all tracks, used instead of `config.forecast` where given.
    """
    given = observe(scene, 0).replace(forecast=forecast)
    return step(scene, given, init(scene, params, config), params, config)[0]
