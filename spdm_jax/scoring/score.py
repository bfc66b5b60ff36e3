"""The PDM scorer: all sub-scores of a set of tracked proposals in one scene."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Path, ego_box
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.scoring.areas import AreaMasks, EgoAreas, ego_areas
from spdm_jax.scoring.collision import (
    CollisionResult,
    TTCResult,
    first_contacts,
    no_at_fault_collision,
    time_to_collision,
)
from spdm_jax.scoring.comfort import comfort_flags
from spdm_jax.scoring.driving import driving_direction, lane_keeping, progress
from spdm_jax.scoring.history_comfort import EgoPast, history_comfort_flags
from spdm_jax.scoring.lights import RedConnectors, red_contact
from spdm_jax.scoring.profile import TUPLAN, Profile
from spdm_jax.types import AgentForecast, EgoState, PolygonGrid, SubScores


class World(NamedTuple):
    """What the scorer needs to know about one step.

    Attributes:
      grid: point-in-polygon index.
      masks: polygons that count at this step.
      forecast: objects `[A, S]`, or `[P, A, S]` poses where they react to each proposal.
      progress_path: where progress and lane keeping are measured.
      red: red connectors, for profiles that judge them.
      past: recorded past of the ego, for profiles that look at it.
    """

    grid: PolygonGrid
    masks: AreaMasks
    forecast: AgentForecast
    progress_path: Path
    red: RedConnectors | None = None
    past: EgoPast | None = None


class Judged(NamedTuple):
    """All sub-scores that do not compare trajectories, `[P]` unless said otherwise.

    Attributes:
      collision, ttc: outcomes with time and object.
      drivable: 0 or 1.
      direction: 0, 0.5 or 1.
      red_index: int32 first time index on an active red connector, T if none.
      lane_keeping: 0 or 1.
      comfort_flags: `[P, 6]` bool.
      progress_raw: m.
      areas: flags `[P, T]`.
    """

    collision: CollisionResult
    ttc: TTCResult
    drivable: jax.Array
    direction: jax.Array
    red_index: jax.Array
    lane_keeping: jax.Array
    comfort_flags: jax.Array
    progress_raw: jax.Array
    areas: EgoAreas


def _meet(
    ego: EgoState,
    areas: EgoAreas,
    crossing: jax.Array,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile,
) -> tuple[CollisionResult, TTCResult]:
    """Judges the contacts of proposals `[P, T]` with the same objects `[A, S]`."""
    contacts = first_contacts(ego, forecast, vehicle, params, profile)
    collision = no_at_fault_collision(ego, areas, forecast, contacts, vehicle, params, profile)
    return collision, time_to_collision(ego, areas, crossing, forecast, contacts, params, profile)


def _meet_own(
    ego: EgoState,
    areas: EgoAreas,
    crossing: jax.Array,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile,
) -> tuple[CollisionResult, TTCResult]:
    """Judges the contacts of each proposal with its own future of the objects `[P, A, S]`."""
    poses = {"x", "y", "heading", "sample_valid"}
    axes = AgentForecast(
        **{name: 0 if name in poses else None for name in AgentForecast.__dataclass_fields__}
    )

    def one(*given):
        *own, forecast = given
        ego, areas, crossing = jax.tree.map(lambda v: v[None], tuple(own))
        met = _meet(ego, areas, crossing, forecast, vehicle, params, profile)
        return jax.tree.map(lambda v: v[0], met)

    return jax.vmap(one, in_axes=(0, 0, 0, axes))(ego, areas, crossing, forecast)


def judge(
    ego: EgoState,
    world: World,
    vehicle: VehicleParams,
    params: ScoringParams,
    profile: Profile,
    direction_window: int | None = None,
) -> Judged:
    """Judges tracked trajectories, each on its own.

    Args:
      ego: `[P, T]` states at the rear axle, 0.1 s apart.
      world: the scene at this step.
      vehicle: ego dimensions.
      params: thresholds.
      profile: rules.
      direction_window: overrides the profile's, as nuPlan's metric judges a drive.

    Returns:
      `Judged` `[P]`; a sub-score that the profile does not know is 1.

    Source: tuplan_garage and NAVSIM `PDMScorer.score_proposals`.
    """
    steps, dtype = ego.x.shape[1], ego.x.dtype
    box = ego_box(ego, vehicle)
    with jax.named_scope("areas"):
        areas, crossings = ego_areas(world.grid, world.masks, ego, box)
    with jax.named_scope("contacts"):
        meet = _meet if world.forecast.x.ndim == 2 else _meet_own
        seen = (areas, crossings.rear_axle, world.forecast, vehicle, params, profile)
        collision, ttc = meet(ego, *seen)
    with jax.named_scope("progress"):
        raw = progress(world.progress_path, box.x, box.y)
    with jax.named_scope("comfort"):
        if profile.comfort == "history" and world.past is not None:
            flags = history_comfort_flags(ego, world.past, vehicle, params)
        else:
            flags = comfort_flags(ego, params)
    against = areas.oncoming
    if profile.crossings_excuse_direction:
        against &= ~crossings.center
    window = profile.direction_window if direction_window is None else direction_window
    assume_past = direction_window is not None
    direction = driving_direction(box.x, box.y, against, params, window, assume_past)
    red_index = jnp.full(raw.shape, steps, jnp.int32)
    if profile.judges("traffic_light") and world.red is not None:
        with jax.named_scope("red lights"):
            red_index = red_contact(box, world.red)
    keeps = jnp.ones_like(raw)
    if profile.judges("lane_keeping"):
        with jax.named_scope("lane keeping"):
            keeps = lane_keeping(world.progress_path, box.x, box.y, crossings.center)
    return Judged(
        collision=collision,
        ttc=ttc,
        drivable=jnp.where(jnp.any(areas.non_drivable, axis=-1), 0.0, 1.0).astype(dtype),
        direction=direction,
        red_index=red_index,
        lane_keeping=keeps,
        comfort_flags=flags,
        progress_raw=raw,
        areas=areas,
    )


def score_trajectories(
    ego: EgoState,
    valid: jax.Array,
    world: World,
    vehicle: VehicleParams,
    params: ScoringParams,
    direction_window: int | None = None,
) -> SubScores:
    """Scores tracked proposals.

    Args:
      ego: `[P, T]` states at the rear axle, 0.1 s apart.
      valid: `[P]` bool.
      world: the scene at this step.
      vehicle: ego dimensions.
      params: weights and thresholds.
      direction_window: of `driving_direction`; None is the published rule.

    Returns:
      `SubScores` `[P]`.

    Source: tuplan_garage `PDMScorer.score_proposals`.
    """
    steps = ego.x.shape[1]
    judged = judge(ego, world, vehicle, params, TUPLAN, direction_window)
    collision, ttc, areas = judged.collision, judged.ttc, judged.areas
    comfort = jnp.all(judged.comfort_flags, axis=-1).astype(ego.x.dtype)
    multiplier = collision.score * judged.drivable * judged.direction
    raw = judged.progress_raw
    combined = aggregate(multiplier, raw, ttc.score, comfort, valid, params)

    def seconds(index):
        return jnp.where(index < steps, index.astype(ego.x.dtype) * DT, jnp.inf)

    return SubScores(
        total=combined.total,
        no_at_fault_collision=collision.score,
        drivable_area=judged.drivable,
        driving_direction=judged.direction,
        progress=combined.progress,
        time_to_collision=ttc.score,
        comfort=comfort,
        progress_raw=raw,
        comfort_flags=judged.comfort_flags,
        collision_time=seconds(collision.time_index),
        collision_object=collision.object,
        collision_kind=collision.kind,
        ttc_time=seconds(ttc.time_index),
        ttc_object=ttc.object,
        multiple_lanes=areas.multiple_lanes,
        non_drivable=areas.non_drivable,
        oncoming=areas.oncoming,
        valid=valid,
    )
