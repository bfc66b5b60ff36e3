"""All closed-loop metrics of one run."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.geometry import principal
from spdm_jax.metrics.areas import DrivableArea, drivable_area
from spdm_jax.metrics.collisions import (
    Collisions,
    TimeToCollision,
    collisions,
    time_to_collision,
)
from spdm_jax.metrics.comfort import Comfort, comfort
from spdm_jax.metrics.driving import DrivingDirection, SpeedLimit, driving_direction, speed_limit
from spdm_jax.metrics.motion import Motion, motion
from spdm_jax.metrics.params import MetricConfig, MetricParams
from spdm_jax.metrics.progress import Progress, expert_chain, progress
from spdm_jax.metrics.routes import (
    CornerLanes,
    LaneChanges,
    corner_lanes,
    driven_route,
    lane_changes,
)
from spdm_jax.metrics.score import score
from spdm_jax.metrics.series import Summary, summarize
from spdm_jax.scoring.areas import Areas, areas_at
from spdm_jax.simulation.history import History
from spdm_jax.types import Array, EgoState, ScenarioMap


class Expert(NamedTuple):
    """The recorded drive that a run is compared with.

    Attributes:
      ego: `[N]` rear-axle states, one per iteration of the scenario.
      valid: `[N]` bool, a prefix; padded states are finite.
    """

    ego: EgoState
    valid: Array


class ExpertErrors(struct.PyTreeNode, kw_only=True):
    """Distance between ego and expert, sample by sample.

    Attributes:
      values: `[2, T]` m: of the box centres, and the same plus weighted heading errors.
      summary: statistics `[2]`.
    """

    values: Array
    summary: Summary


class ClosedLoopMetrics(struct.PyTreeNode, kw_only=True):
    """The closed-loop metrics of one run.

    Attributes:
      scores: `[8]` in the order of `metrics.SCORED`; NaN where one could not be computed.
      final: `[]` weighted score; NaN if one of them could not be computed.
      comfort, collisions, drivable_area, driving_direction, progress, time_to_collision,
        speed_limit, lane_changes, expert_errors: statistics, series and intermediate results.
      mean_speed: `[]` m/s.
      route: `[T, L]` bool, lanes or connectors of the ego's box centre.
      expert_route: `[N, L]` bool.
      corners: lanes of the ego's corners.
      valid: `[T]` bool, samples that count.
    """

    scores: Array
    final: Array
    comfort: Comfort
    collisions: Collisions
    drivable_area: DrivableArea
    driving_direction: DrivingDirection
    progress: Progress
    time_to_collision: TimeToCollision
    speed_limit: SpeedLimit
    lane_changes: LaneChanges
    expert_errors: ExpertErrors
    mean_speed: Array
    route: Array
    expert_route: Array
    corners: CornerLanes
    valid: Array


def _expert_errors(
    history: History, move: Motion, expert: EgoState, goal: Motion, params: MetricParams
) -> ExpertErrors:
    steps = history.valid.shape[0]
    # The expert outlasts the run by a sample; a longer run than expert has nothing to compare.
    other = jnp.minimum(jnp.arange(steps), expert.x.shape[0] - 1)
    distance = jnp.hypot(move.box.x - goal.box.x[other], move.box.y - goal.box.y[other])
    turn = jnp.abs(principal(history.ego.heading - expert.heading[other]))
    values = jnp.stack([distance, distance + params.heading_weight * turn])
    values = jnp.where(history.valid, values, 0)
    return ExpertErrors(values=values, summary=summarize(values, history.valid))


def _both(first: jax.Array, second: jax.Array) -> jax.Array:
    """Stacks `[T]` and `[N]` to `[2, max(T, N)]`; the shorter one repeats its last entry."""
    size = max(first.shape[0], second.shape[0])
    pad = lambda v: jnp.pad(v, (0, size - v.shape[0]), mode="edge")
    return jnp.stack([pad(first), pad(second)])


def closed_loop(
    history: History,
    scene_map: ScenarioMap,
    expert: Expert,
    params: MetricParams | None = None,
    config: MetricConfig | None = None,
) -> ClosedLoopMetrics:
    """Computes nuPlan's closed-loop metrics for one run.

    Args:
      history: `[T]` samples; `valid` is a prefix, what follows it does not count.
      scene_map: the world, in the frame of the history.
      expert: the recorded drive.
      params: thresholds and weights; the official ones if None.
      config: static settings.

    Returns:
      Metrics; those that the run is too short for are NaN.
    """
    params = MetricParams() if params is None else params
    config = MetricConfig() if config is None else config
    ego, valid, lanes = history.ego, history.valid, scene_map.lanes
    move = motion(ego, params.vehicle)
    goal = motion(expert.ego, params.vehicle)

    # Ego and expert side by side: one program for both.
    x, y = _both(move.box.x, goal.box.x), _both(move.box.y, goal.box.y)
    steps, size = valid.shape[0], x.shape[1]
    fill = lambda v: jnp.pad(v, (0, size - v.shape[0]))
    both_valid = jnp.stack([fill(valid), fill(jnp.asarray(expert.valid))])
    with jax.named_scope("routes"):
        points_x = jnp.concatenate([x.reshape(-1), move.corner_x.reshape(-1), ego.x])
        points_y = jnp.concatenate([y.reshape(-1), move.corner_y.reshape(-1), ego.y])
        found = areas_at(scene_map, points_x, points_y)
        centers = Areas(*(v[: 2 * size].reshape(2, size, *v.shape[1:]) for v in found))
        follow = jax.vmap(driven_route, in_axes=(None, 0, 0, 0, 0, None))
        routes = follow(lanes, centers, x, y, both_valid, params.near_connector)
        route, expert_route = routes[0, :steps], routes[1, : expert.ego.x.shape[0]]
        at_corners = found.lanes[2 * size : 2 * size + 4 * steps]
        corners = corner_lanes(lanes, at_corners.reshape(steps, 4, -1))
        changes = lane_changes(lanes, corners, history.time, valid)
    with jax.named_scope("contacts"):
        objects, in_lane = history.objects, corners.in_lane
        contacts = collisions(ego, move, objects, valid, in_lane, params)
        crossing = found.intersection[2 * size + 4 * steps :]
        ttc = time_to_collision(
            ego, move, objects, valid, in_lane, crossing, contacts, params, config
        )
    with jax.named_scope("lanes"):
        area = drivable_area(scene_map, move, corners.corners, route, valid, params)
        direction = driving_direction(lanes, move, route, history.time, valid, params)
        limit = speed_limit(lanes, move.speed, route, history.time, valid, params)
        chain = expert_chain(lanes, expert_route)
        along = progress(scene_map, chain, x, y, both_valid, params)
    with jax.named_scope("comfort"):
        ride = comfort(ego, history.time, valid, params)

    known = jnp.any(valid)
    scores = jnp.stack(
        [
            contacts.score,
            area.score,
            along.making_progress,
            direction.score,
            along.ratio,
            ttc.score,
            limit.score,
            ride.score,
        ]
    )
    scores = jnp.where(known, scores, jnp.nan)
    return ClosedLoopMetrics(
        scores=scores,
        final=score(scores, params.weights),
        comfort=ride,
        collisions=contacts,
        drivable_area=area,
        driving_direction=direction,
        progress=along,
        time_to_collision=ttc,
        speed_limit=limit,
        lane_changes=changes,
        expert_errors=_expert_errors(history, move, expert.ego, goal, params),
        mean_speed=summarize(move.speed[None], valid).mean[0],
        route=route,
        expert_route=expert_route,
        corners=corners,
        valid=valid,
    )
