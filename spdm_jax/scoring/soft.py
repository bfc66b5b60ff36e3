"""The PDM score with a gradient: every rule as a sigmoid of its margin over a temperature.

As the temperature goes to 0 every term goes to that of `spdm_jax.scoring.score`, away from the
thresholds themselves.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.geometry import Path, box_corners, ego_box, project
from spdm_jax.scoring.areas import ego_areas
from spdm_jax.scoring.comfort import comfort_bounds, comfort_filters, filtered
from spdm_jax.scoring.score import World
from spdm_jax.scoring.smooth import safe_sqrt, soft_min
from spdm_jax.scoring.soft_areas import Layer, inside_margin
from spdm_jax.scoring.soft_contacts import contact_margins
from spdm_jax.types import Array, EgoState, Polygons


class SoftScores(struct.PyTreeNode, kw_only=True):
    """Smooth counterparts of `SubScores`, `[P]` each; padded proposals score 0.

    Attributes:
      total: smooth score in [0, 1].
      no_at_fault_collision: towards 0, 0.5 or 1.
      drivable_area: towards 0 or 1.
      driving_direction: towards 0, 0.5 or 1.
      progress: relative to the best of the set.
      time_to_collision: towards 0 or 1.
      comfort: towards 0 or 1.
      progress_raw: m along the progress reference.
    """

    total: Array
    no_at_fault_collision: Array
    drivable_area: Array
    driving_direction: Array
    progress: Array
    time_to_collision: Array
    comfort: Array
    progress_raw: Array


class SoftWorld(NamedTuple):
    """What the smooth scorer needs to know about one step.

    Attributes:
      hard: what the scorer needs.
      lanes: areas of lanes and connectors.
      car_parks: their areas.
      lane_drivable: `[L]` bool, lanes of this step's drivable map.
      park_drivable: `[C]` bool, car parks of it.
      lane_on_route: `[L]` bool.
    """

    hard: World
    lanes: Polygons
    car_parks: Polygons
    lane_drivable: jax.Array
    park_drivable: jax.Array
    lane_on_route: jax.Array


def soft_score_trajectories(
    ego: EgoState,
    valid: jax.Array,
    world: SoftWorld,
    vehicle: VehicleParams,
    params: ScoringParams,
    temperature: jax.Array,
) -> SoftScores:
    """Smooth scores of tracked proposals.

    Args:
      ego: `[P, T]` states at the rear axle, 0.1 s apart.
      valid: `[P]` bool.
      world: the scene at this step.
      vehicle: ego dimensions.
      params: weights and thresholds.
      temperature: `[]`, m for distances, a fraction of the bound for comfort.

    Returns:
      `SoftScores` `[P]`.
    """
    world = jax.lax.stop_gradient(world)
    hard = world.hard
    fixed = jax.lax.stop_gradient(ego)
    box = ego_box(ego, vehicle)
    areas, crossings = ego_areas(hard.grid, hard.masks, fixed, ego_box(fixed, vehicle))
    margins = contact_margins(
        ego, areas, crossings.rear_axle, hard.forecast, vehicle, params, temperature
    )
    collision = _sigmoid(margins.agent) * (0.5 + 0.5 * _sigmoid(margins.static))

    road = (
        Layer(world.lanes, world.lane_drivable),
        Layer(world.car_parks, world.park_drivable),
    )
    corners = inside_margin(road, *box_corners(box), temperature)
    drivable = _sigmoid(soft_min(corners, (1, 2)))
    route = (Layer(world.lanes, world.lane_drivable & world.lane_on_route),)
    oncoming = _sigmoid(-inside_margin(route, box.x, box.y, temperature))
    direction = soft_direction(box.x, box.y, oncoming, params, temperature)

    raw = soft_progress(hard.progress_path, box.x, box.y)
    comfort = _sigmoid(comfort_margin(ego, params, temperature))
    ttc = _sigmoid(margins.ttc)
    multiplier = jnp.where(valid, collision * drivable * direction, 0)
    progress = relative_progress(multiplier, raw, params, temperature)
    weights = params.progress_weight + params.ttc_weight + params.comfort_weight
    mean = (
        params.progress_weight * progress
        + params.ttc_weight * ttc
        + params.comfort_weight * comfort
    ) / weights
    return SoftScores(
        total=multiplier * mean,
        no_at_fault_collision=collision,
        drivable_area=drivable,
        driving_direction=direction,
        progress=progress,
        time_to_collision=ttc,
        comfort=comfort,
        progress_raw=raw,
    )


_sigmoid = jax.nn.sigmoid


def soft_direction(
    center_x: jax.Array,
    center_y: jax.Array,
    oncoming: jax.Array,
    params: ScoringParams,
    temperature: jax.Array,
) -> jax.Array:
    """Smooth `driving.driving_direction`, `[P]`.

    The way driven against traffic is r_t = o_t (r_{t-1} + step_t) with o_t in [0, 1]: an
    uninterrupted run adds up, any state on the route ends it.

    Args:
      center_x: `[P, T]` ego centre, m.
      center_y: `[P, T]`.
      oncoming: `[P, T]` in [0, 1], how surely the centre is in no on-route polygon.
      params: thresholds.
      temperature: m.
    """
    dx, dy = jnp.diff(center_x, axis=-1), jnp.diff(center_y, axis=-1)
    step = safe_sqrt(dx * dx + dy * dy)

    def drive(run, xs):
        share, way = xs
        run = share * (run + way)
        return run, run

    start = jnp.zeros_like(step[:, 0])
    _, runs = jax.lax.scan(drive, start, (oncoming[:, 1:].T, step.T))
    left = lambda bound: soft_min((bound - runs) / temperature, 0)
    compliant, violation = params.driving_direction_compliant, params.driving_direction_violation
    return 0.5 * (_sigmoid(left(compliant)) + _sigmoid(left(violation)))


def soft_progress(path: Path, center_x: jax.Array, center_y: jax.Array) -> jax.Array:
    """`driving.progress` by a search that can be differentiated, `[P]` m."""
    start = project(path, center_x[:, 0], center_y[:, 0])
    end = project(path, center_x[:, -1], center_y[:, -1])
    return jnp.maximum(end - start, 0)


def comfort_margin(ego: EgoState, params: ScoringParams, temperature: jax.Array) -> jax.Array:
    """Smallest distance of the six signals to their bounds, `[P]`, in units of the temperature.

    Each is a fraction of its bound, so that one temperature serves m/s^2, m/s^3 and rad/s.
    """
    magnitude = safe_sqrt(ego.ax * ego.ax + ego.ay * ego.ay)
    signals = comfort_filters(ego, magnitude, filtered)
    margins = []
    for name, (low, high) in comfort_bounds(params).items():
        margins += [(signals[name] - low) / jnp.abs(low), (high - signals[name]) / jnp.abs(high)]
    return soft_min(jnp.stack(margins) / temperature, (0, 2))


def relative_progress(
    multiplier: jax.Array, raw: jax.Array, params: ScoringParams, temperature: jax.Array
) -> jax.Array:
    """Smooth counterpart of the normalisation in `aggregate.aggregate`, `[P]`.

    Args:
      multiplier: `[P]` product of the multiplying terms, 0 for padding.
      raw: `[P]` m.
      params: the way below which nobody made progress.
      temperature: m.
    """
    weighted = raw * multiplier
    best = jnp.max(weighted)
    moved = _sigmoid((best - params.progress_threshold) / temperature)
    # Where all stand, the share of the best would have an endless gradient.
    relative = weighted / jnp.maximum(best, params.progress_threshold)
    admissible = -jnp.expm1(-multiplier / temperature)
    return moved * relative + (1 - moved) * admissible
