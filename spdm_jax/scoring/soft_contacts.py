"""Contacts with a gradient: signed separations instead of overlaps, the rules of fault as they are.

The rule of `spdm_jax.scoring.collision` looks at the first contact of each pair. Up to and with
that contact every (proposal, object, time) gets a margin here: the separation whose sign decides,
or none where the rule says that a contact at that moment does not count. Before the first contact
all separations are positive, so the smallest margin is negative exactly where the hard rule finds
a violation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.config import DT, ScoringParams, VehicleParams
from spdm_jax.geometry import Box, ego_box
from spdm_jax.scoring.areas import EgoAreas
from spdm_jax.scoring.collision import (
    LOOK_AHEAD,
    Contacts,
    cos_to_object,
    first_contacts,
    is_ahead,
    is_behind,
    object_boxes,
)
from spdm_jax.scoring.smooth import safe_sqrt, soft_min
from spdm_jax.types import AgentForecast, EgoState


class ContactMargins(NamedTuple):
    """Smallest margins of each proposal, `[P]`, in units of the temperature.

    Attributes:
      agent: to an at-fault collision with a vehicle, pedestrian or bicycle.
      static: to one with a static object.
      ttc: to a violation of the time-to-collision rule.
    """

    agent: jax.Array
    static: jax.Array
    ttc: jax.Array


def separation(a: Box, b: Box) -> jax.Array:
    """Largest gap between boxes over the four separating axes, m; negative where they overlap.

    The sign is that of `geometry.boxes_overlap`; between corners it is shorter than the distance.
    """
    dx, dy = b.x - a.x, b.y - a.y
    cos = jnp.abs(a.cos * b.cos + a.sin * b.sin)
    sin = jnp.abs(a.cos * b.sin - a.sin * b.cos)
    al, aw, bl, bw = a.half_length, a.half_width, b.half_length, b.half_width
    along_a = jnp.abs(dx * a.cos + dy * a.sin) - (al + bl * cos + bw * sin)
    across_a = jnp.abs(dy * a.cos - dx * a.sin) - (aw + bl * sin + bw * cos)
    along_b = jnp.abs(dx * b.cos + dy * b.sin) - (bl + al * cos + aw * sin)
    across_b = jnp.abs(dy * b.cos - dx * b.sin) - (bw + al * sin + aw * cos)
    return jnp.maximum(jnp.maximum(along_a, across_a), jnp.maximum(along_b, across_b))


def contact_margins(
    ego: EgoState,
    areas: EgoAreas,
    in_intersection: jax.Array,
    forecast: AgentForecast,
    vehicle: VehicleParams,
    params: ScoringParams,
    temperature: jax.Array,
) -> ContactMargins:
    """Margins of the collision rule and of the time-to-collision rule.

    What is discrete (first contacts, who is stopped, ahead, behind, out of its lane) is taken from
    the states as they are and has no gradient.

    Args:
      ego: tracked proposals `[P, T]`.
      areas: flags at every state.
      in_intersection: `[P, T]` bool, rear axle inside an intersection.
      forecast: objects `[A, S]`.
      vehicle: ego dimensions.
      params: thresholds.
      temperature: m.
    """
    fixed = jax.lax.stop_gradient(ego)
    contacts = first_contacts(fixed, forecast, vehicle, params)
    boxes, alive = object_boxes(forecast, ego.x.shape[1])  # [A, F, T]
    out_of_lane = areas.multiple_lanes | areas.non_drivable

    now = jax.tree.map(lambda v: v[:, 0], boxes), alive[:, 0]
    counts, margin = _collision_margins(
        ego, fixed, out_of_lane, forecast, contacts, *now, vehicle, params
    )
    at_risk = lambda flags: soft_min(margin / temperature, (1, 2), counts & flags[:, None])
    agent, static = at_risk(forecast.is_agent), at_risk(~forecast.is_agent)

    exposed = out_of_lane | in_intersection
    counts, margin = _ttc_margins(ego, fixed, exposed, contacts, boxes, alive, vehicle, params)
    return ContactMargins(agent, static, soft_min(margin / temperature, (1, 2, 3), counts))


def _collision_margins(
    ego: EgoState,
    fixed: EgoState,
    out_of_lane: jax.Array,
    forecast: AgentForecast,
    contacts: Contacts,
    boxes: Box,
    alive: jax.Array,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> tuple[jax.Array, jax.Array]:
    """Which moments count, and the separation that decides at each, `[P, A, T]`.

    Front contacts alone are at fault while the ego keeps its lane: there the gap of the front
    bumper decides, elsewhere and for stopped tracks that of the whole box.
    """
    steps = ego.x.shape[1]
    ego, fixed = (jax.tree.map(lambda v: v[:, None], states) for states in (ego, fixed))
    cos = cos_to_object(fixed.x, fixed.y, fixed.heading, boxes.x, boxes.y)
    stopped_ego = jnp.hypot(fixed.vx, fixed.vy) <= params.stopped_speed
    stopped_track = (~forecast.is_agent | (forecast.speed <= params.stopped_speed))[:, None]
    until_contact = jnp.arange(steps) <= contacts.time[..., None]
    counts = alive & until_contact & ~stopped_ego & (stopped_track | ~is_behind(cos, params))
    box = ego_box(ego, vehicle)
    # The bumper is the box without its length, moved to its front.
    to_front = jnp.where(stopped_track | out_of_lane[:, None], 0, box.half_length)
    touching = box._replace(
        x=box.x + to_front * box.cos,
        y=box.y + to_front * box.sin,
        half_length=box.half_length - to_front,
    )
    return counts, separation(touching, boxes)


def _ttc_margins(
    ego: EgoState,
    fixed: EgoState,
    exposed: jax.Array,
    contacts: Contacts,
    boxes: Box,
    alive: jax.Array,
    vehicle: VehicleParams,
    params: ScoringParams,
) -> tuple[jax.Array, jax.Array]:
    """Which moments count, and the separation of the projected ego, `[P, A, F, T]`."""
    steps = ego.x.shape[1]
    ego, fixed = (jax.tree.map(lambda v: v[:, None, None], states) for states in (ego, fixed))
    cos = cos_to_object(fixed.x, fixed.y, fixed.heading, boxes.x, boxes.y)
    guilty = is_ahead(cos, params) | (exposed[:, None, None] & ~is_behind(cos, params))
    moving = jnp.hypot(fixed.vx, fixed.vy) >= params.ttc_stopped_speed
    key = jnp.arange(steps) * len(LOOK_AHEAD) + jnp.arange(len(LOOK_AHEAD))[:, None]
    counts = alive & moving & guilty & (key <= contacts.ttc[..., None, None])
    speed = safe_sqrt(ego.vx * ego.vx + ego.vy * ego.vy)
    box = ego_box(ego, vehicle)
    reach = speed * (DT * jnp.asarray(LOOK_AHEAD, speed.dtype))[:, None]
    there = box._replace(x=box.x + reach * box.cos, y=box.y + reach * box.sin)
    return counts, separation(there, boxes)
