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
from spdm_jax.scoring.driving import driving_direction, progress
from spdm_jax.types import AgentForecast, EgoState, PolygonGrid, SubScores


class World(NamedTuple):
    """What the scorer needs to know about one step.

    Attributes:
      grid: point-in-polygon index.
      masks: polygons that count at this step.
      forecast: objects `[A, S]`, or `[P, A, S]` poses where they react to each proposal.
      progress_path: where progress is measured.
    """

    grid: PolygonGrid
    masks: AreaMasks
    forecast: AgentForecast
    progress_path: Path


def _meet(
    ego: EgoState,
    areas: EgoAreas,
    crossing: jax.Array,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> tuple[CollisionResult, TTCResult]:
    """Judges the contacts of proposals `[P, T]` with the same objects `[A, S]`."""
    contacts = first_contacts(ego, forecast, vehicle, params)
    collision = no_at_fault_collision(ego, areas, forecast, contacts, vehicle, params)
    return collision, time_to_collision(ego, areas, crossing, forecast, contacts, params)


def _meet_own(
    ego: EgoState,
    areas: EgoAreas,
    crossing: jax.Array,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> tuple[CollisionResult, TTCResult]:
    """Judges the contacts of each proposal with its own future of the objects `[P, A, S]`."""
    poses = {"x", "y", "heading", "sample_valid"}
    axes = AgentForecast(
        **{name: 0 if name in poses else None for name in AgentForecast.__dataclass_fields__}
    )

    def one(*given):
        *own, forecast = given
        ego, areas, crossing = jax.tree.map(lambda v: v[None], tuple(own))
        met = _meet(ego, areas, crossing, forecast, vehicle, params)
        return jax.tree.map(lambda v: v[0], met)

    return jax.vmap(one, in_axes=(0, 0, 0, axes))(ego, areas, crossing, forecast)


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
    box = ego_box(ego, vehicle)
    with jax.named_scope("areas"):
        areas, crossing = ego_areas(world.grid, world.masks, ego, box)
    with jax.named_scope("contacts"):
        meet = _meet if world.forecast.x.ndim == 2 else _meet_own
        collision, ttc = meet(ego, areas, crossing, world.forecast, vehicle, params)
    with jax.named_scope("progress"):
        raw = progress(world.progress_path, box.x, box.y)
    with jax.named_scope("comfort"):
        flags = comfort_flags(ego, params)
    comfort = jnp.all(flags, axis=-1).astype(ego.x.dtype)
    drivable = jnp.where(jnp.any(areas.non_drivable, axis=-1), 0.0, 1.0).astype(ego.x.dtype)
    direction = driving_direction(box.x, box.y, areas.oncoming, params, direction_window)
    combined = aggregate(
        collision.score * drivable * direction, raw, ttc.score, comfort, valid, params
    )

    def seconds(index):
        return jnp.where(index < steps, index.astype(ego.x.dtype) * DT, jnp.inf)

    return SubScores(
        total=combined.total,
        no_at_fault_collision=collision.score,
        drivable_area=drivable,
        driving_direction=direction,
        progress=combined.progress,
        time_to_collision=ttc.score,
        comfort=comfort,
        progress_raw=raw,
        comfort_flags=flags,
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
