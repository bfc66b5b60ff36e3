"""The PDM scorer: all sub-scores of a set of tracked proposals in one scene."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Path, ego_box
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.scoring.areas import AreaMasks, ego_areas
from spdm_jax.scoring.collision import first_contacts, no_at_fault_collision, time_to_collision
from spdm_jax.scoring.comfort import comfort_flags
from spdm_jax.scoring.driving import driving_direction, progress
from spdm_jax.types import AgentForecast, EgoState, PolygonGrid, SubScores


class World(NamedTuple):
    """What the scorer needs to know about one step.

    Attributes:
      grid: point-in-polygon index.
      masks: polygons that count at this step.
      forecast: objects.
      progress_path: where progress is measured.
    """

    grid: PolygonGrid
    masks: AreaMasks
    forecast: AgentForecast
    progress_path: Path


def score_trajectories(
    ego: EgoState,
    valid: jax.Array,
    world: World,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> SubScores:
    """Scores tracked proposals.

    Args:
      ego: `[P, T]` states at the rear axle, 0.1 s apart.
      valid: `[P]` bool.
      world: the scene at this step.
      vehicle: ego dimensions.
      params: weights and thresholds.

    Returns:
      `SubScores` `[P]`.

    Source: tuplan_garage `PDMScorer.score_proposals`.
    """
    steps = ego.x.shape[1]
    box = ego_box(ego, vehicle)
    with jax.named_scope("areas"):
        areas, crossing = ego_areas(world.grid, world.masks, ego, box)
    with jax.named_scope("contacts"):
        contacts = first_contacts(ego, world.forecast, vehicle, params)
        collision = no_at_fault_collision(ego, areas, world.forecast, contacts, vehicle, params)
        ttc = time_to_collision(ego, areas, crossing, world.forecast, contacts, params)
    with jax.named_scope("progress"):
        raw = progress(world.progress_path, box.x, box.y)
    with jax.named_scope("comfort"):
        flags = comfort_flags(ego, params)
    comfort = jnp.all(flags, axis=-1).astype(ego.x.dtype)
    drivable = jnp.where(jnp.any(areas.non_drivable, axis=-1), 0.0, 1.0).astype(ego.x.dtype)
    direction = driving_direction(box.x, box.y, areas.oncoming, params)
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
