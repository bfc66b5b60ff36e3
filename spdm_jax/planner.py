"""PDM-Closed and SPDM: one planning step, as a pure function.

`init` and `step` carry what the planner remembers in closed loop; `plan` is the first step alone.
Read `step`: it spells the whole method.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.forecast import (
    ForecastPoses,
    React,
    constant_velocity,
    perfect,
    steady_ego,
    supplied,
)
from spdm_jax.agents.observation import Observation, red_lights, select_objects
from spdm_jax.config import NUM_TRAJECTORY_STATES, PlannerConfig, PlannerParams
from spdm_jax.decision import Seen, cast_params, decide, notice, progress_of, target_speeds
from spdm_jax.geometry import Path, ego_box, point_segment_sq
from spdm_jax.proposals.borrow import Surroundings, offered, surroundings
from spdm_jax.proposals.lanes import (
    area_masks,
    drivable_lanes,
    nearest_heading,
    parallel_path,
    polygons_containing,
    sequence_path,
    starting_lane,
)
from spdm_jax.proposals.oncoming import oncoming_lane
from spdm_jax.proposals.spline import route_lane_paths
from spdm_jax.types import AgentForecast, Array, EgoState, ProposalSet, Scenario, SubScores

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


def see(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
    react: React | None = None,
) -> Seen:
    """Selects objects, forecasts them and collects the red lights of the route.

    Where traffic reacts, this forecast is the one beside an ego that goes straight on.
    """
    ego = ego_box(given.ego, params.vehicle)
    observation = given.observation
    selected = select_objects(observation, ego.x, ego.y, state.collided, params.map_radius, config)
    if given.forecast is not None:
        poses = supplied(given.forecast, selected)
    elif react is not None:
        beside = react(steady_ego(given.ego, NUM_TRAJECTORY_STATES))
        poses = supplied(jax.tree.map(lambda v: v[0], beside), selected)
    elif config.forecast in ("perfect", "reactive"):
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


def _around(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
) -> Surroundings:
    """Looks for an oncoming lane to borrow and for what borrowing it depends on."""
    centerline = jax.tree.map(lambda v: v[0], state.paths)
    lane = oncoming_lane(
        scene.map.lanes, scene.route, centerline, given.ego, config.max_path_points
    )
    return surroundings(lane, centerline, given.ego, given.observation, params)


def step(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
    react: React | None = None,
) -> tuple[PlanResult, PlannerState]:
    """Plans once: see, prepare paths, propose, track, score, choose, brake if needed.

    Args:
      scene: map and route (and recorded tracks for perfect prediction).
      given: ego and observation of this step.
      state: what `init` or the previous step left.
      params: traced settings.
      config: static settings.
      react: how traffic would react; used where the forecast is "reactive".

    Returns:
      The plan and the state for the next step.

    Source: tuplan_garage `PDMClosedPlanner`; paper, Section "Spline-Fitting PDM".
    """
    ego = given.ego
    params = cast_params(params, ego.x.dtype)
    box = ego_box(ego, params.vehicle)
    react = react if config.forecast == "reactive" and given.forecast is None else None
    with jax.named_scope("see"):
        seen = see(scene, given, state, params, config, react)
        lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
        lane = starting_lane(scene.map, scene.route, lanes, ego, params.vehicle)
        masks = area_masks(scene.map, scene.route.lane_on_route, lanes, parks)
    target_speed = target_speeds(scene.map.lanes.speed_limit[lane], params)

    route_paths = around = None
    if config.num_route_paths:
        with jax.named_scope("route_lanes"):
            state = _follow_lane_change(scene, state, ego, params, config)
            around = _around(scene, given, state, params, config) if config.borrows else None
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
                None if around is None else offered(around),
            )
    centerline = jax.tree.map(lambda v: v[0], state.paths)
    by_goal = config.progress_reference == "goal" or (
        config.progress_reference == "auto" and config.num_route_paths > 0
    )

    def reacting(tracked: EgoState) -> AgentForecast:
        assert react is not None
        poses = react(tracked)
        rows = jax.tree.map(lambda v: v[:, seen.forecast.track], poses)
        return seen.forecast.replace(
            x=rows.x, y=rows.y, heading=rows.heading, sample_valid=rows.valid
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
        None if react is None else reacting,
        around,
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
