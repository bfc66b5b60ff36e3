"""One planning decision on given paths: propose, track, score, choose, brake if needed.

Nothing here looks at lanes or keeps memory; that is `spdm_jax.planner`'s part.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import ForecastPoses, assemble
from spdm_jax.agents.observation import (
    Observation,
    RedLights,
    SelectedObjects,
    ego_contacts,
    ego_inside,
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
from spdm_jax.geometry import Path, ego_box, interpolate, project
from spdm_jax.proposals import idm
from spdm_jax.proposals.borrow import Surroundings, drive_borrowing
from spdm_jax.proposals.spline import RouteLanePaths, drive
from spdm_jax.scoring.areas import AreaMasks
from spdm_jax.scoring.driving import METRIC_WINDOW, progress
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.types import AgentForecast, EgoState, PolygonGrid, ProposalSet, SubScores


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
    x, y, heading = forecast.x[:, 0], forecast.y[:, 0], forecast.heading[:, 0]
    touching = forecast.valid & ego_contacts(box, x, y, heading, forecast.length, forecast.width)
    inside = ego_inside(red, box)
    return Seen(
        forecast.replace(ignored=touching),
        red.replace(ignored=red.ignored | inside),
        touching,
        inside,
    )


class Stage1(NamedTuple):
    """Stage-1 proposals and what the winner's extension needs."""

    x: jax.Array  # [L, K, T]
    y: jax.Array
    heading: jax.Array
    rollout: idm.IDMRollout
    contents: idm.CorridorContents


def stage1_proposals(
    paths: Path,
    ego: EgoState,
    target_speed: jax.Array,
    seen: Seen,
    params: PlannerParams,
) -> Stage1:
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
    return Stage1(x, y, heading, rolled, contents)


def extend_stage1(
    paths: Path,
    index: jax.Array,
    target_speed: jax.Array,
    stage1: Stage1,
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


def merge(stage1: Stage1, stage2: tuple | None, route_paths: RouteLanePaths | None):
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
    reacting: Callable[[EgoState], AgentForecast] | None = None,
    around: Surroundings | None = None,
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
      reacting: how the objects of `seen` would move beside each tracked proposal `[P, T]`; scores
        alone ask for it.
      around: what borrowing the oncoming lane depends on, or None. Where it is given, proposals are
        judged by the final metric's rule for driving against traffic.
    """
    vehicle = params.vehicle
    with jax.named_scope("propose"):
        stage1 = stage1_proposals(paths, ego, target_speed, seen, params)
        stage2 = None
        if route_paths is not None:
            given, steps = (route_paths, ego, target_speed), NUM_TRAJECTORY_STATES
            if around is None:
                stage2 = drive(*given, params.spline, steps)
            else:
                stage2 = drive_borrowing(*given, params, steps, around)
        proposals = merge(stage1, stage2, route_paths)
    with jax.named_scope("track"):
        reference = (proposals.x, proposals.y, proposals.heading)
        tracked, _ = track(*reference, ego, vehicle, params.tracker, config.tracker)
    with jax.named_scope("score"):
        forecast = seen.forecast if reacting is None else reacting(tracked)
        world = World(grid, masks, forecast, progress_path)
        window = None if around is None else METRIC_WINDOW
        scores = score_trajectories(
            tracked, proposals.valid, world, vehicle, params.scoring, window
        )
    with jax.named_scope("choose"):
        best = jnp.argmax(scores.total).astype(jnp.int32)
        braking = (scores.collision_time[best] <= params.brake.time_threshold) & (
            jnp.hypot(ego.vx, ego.vy) <= params.brake.speed_threshold
        )
        num_stage1 = stage1.x.shape[0] * stage1.x.shape[1]
        first = jnp.minimum(best, num_stage1 - 1)
        chosen = extend_stage1(paths, first, target_speed, stage1, seen, params)
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


def progress_of(tracked: EgoState, path: Path, vehicle: VehicleParams) -> jax.Array:
    """Raw progress `[P]` of tracked proposals along a path, m."""
    box = ego_box(tracked, vehicle)
    return progress(path, box.x, box.y)
