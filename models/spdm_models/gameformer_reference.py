"""The reference path of GameFormer's planner from a scene."""

import jax
import jax.numpy as jnp

from spdm_jax.agents.observation import is_agent
from spdm_jax.arrays import true_indices
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import box_at, ego_box
from spdm_jax.planner import StepInput
from spdm_jax.types import EgoState, Lanes, LightStatus, ObjectType, Polylines, Scenario

from .gameformer_paths import (
    Boundaries,
    ReferencePath,
    annotate,
    cheapest_course,
    discourage_lane_change,
    path_costs,
    path_objects,
)
from .lattice import POINT_SPACING, Polyline
from .route_lines import RouteLineConfig, RouteLines, first_speed_limit, route_lines
from .scene_features import local_pose

UNKNOWN_LIMIT = 15.0
"""Speed limit where the map has none, m/s."""
EDGE_REACH, EDGE_STEP = 30.0, 1.0
"""Edges of lanes are looked at so far along a candidate, at points so far apart, m."""
MAX_RED, RED_POINTS = 16, 240
"""Red connectors near the ego, and their points 0.25 m apart."""


def scene_reference(
    scene: Scenario, given: StepInput, config: RouteLineConfig
) -> tuple[ReferencePath, jax.Array]:
    """Builds the reference path of one step.

    Args:
      scene: one scenario.
      given: ego and objects of this step.
      config: of the candidate lanes.

    Returns:
      The path in the ego frame, and whether a fixed buffer was too small, `[]` bool.
    """
    ego, seen = given.ego, given.observation
    lines = route_lines(scene.map, scene.route, ego, config)
    boxes = box_at(seen.x, seen.y, seen.heading, 0.5 * seen.length, 0.5 * seen.width)
    blocks, moving = path_objects(
        boxes,
        seen.type == ObjectType.VEHICLE,
        ~is_agent(seen.type),
        jnp.hypot(seen.vx, seen.vy),
        ego_box(ego, VehicleParams()),
    )
    pose = (ego.x, ego.y, ego.heading)
    costs = path_costs(
        lines.line,
        lines.valid,
        pose,
        boxes,
        blocks & seen.valid,
        moving & seen.valid,
        _boundaries(scene.map.lanes, lines, ego),
    )
    known = jnp.any((seen.lights != LightStatus.UNKNOWN) & scene.map.lanes.has_traffic_light)
    stay = discourage_lane_change(known, jnp.sum(lines.valid), ego.vx)
    course, found = cheapest_course(lines.line, pose, costs.total(stay))
    limit = first_speed_limit(scene.map, scene.route, lines, UNKNOWN_LIMIT).astype(ego.x.dtype)
    red, red_overflow = _red_connectors(scene.map.lanes, seen.lights, ego)
    reference = annotate(course, found, limit, red)
    # Without a path the splines have no knots, and their rows may be anything.
    path = jnp.where(found & jnp.isfinite(reference.path), reference.path, 0)
    return reference.replace(path=path), lines.overflow | red_overflow


def _boundaries(lanes: Lanes, lines: RouteLines, ego: EgoState) -> Boundaries:
    """Edges along each candidate on sides without a neighbour lane, in the scene's frame."""
    steps = jnp.arange(round(EDGE_REACH / EDGE_STEP) + 1, dtype=ego.x.dtype) * EDGE_STEP

    def of_line(sequence, begin):
        length = jnp.where(sequence >= 0, lanes.length[sequence], 0)
        end = jnp.cumsum(length)
        arc = begin + steps
        part = jnp.minimum(jnp.sum(arc[:, None] >= end, axis=1), sequence.shape[0] - 1)
        lane = sequence[part]
        inside = arc - (end - length)[part]
        share = jnp.clip(inside / jnp.maximum(lanes.length[lane], 1e-3), 0, 1)
        sides = []
        for line, beside in (
            (lanes.left_boundary, lanes.left_neighbor),
            (lanes.right_boundary, lanes.right_neighbor),
        ):
            x, y = _along(line, lane, share)
            same = lane[1:] == lane[:-1]
            sides.append(
                (x[:-1], y[:-1], x[1:], y[1:], same & (lane[1:] >= 0) & (beside[lane[1:]] < 0))
            )
        return tuple(jnp.concatenate(both) for both in zip(*sides, strict=True))

    ax, ay, bx, by, valid = jax.vmap(of_line)(lines.sequence, lines.begin)
    return Boundaries(ax=ax, ay=ay, bx=bx, by=by, valid=valid & lines.valid[:, None])


def _along(lines: Polylines, row: jax.Array, share: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points `[N]` of polylines by the share of their points that lie before."""
    last = jnp.maximum(lines.count[row] - 1, 0)
    exact = share * last.astype(share.dtype)
    low = jnp.minimum(exact.astype(jnp.int32), jnp.maximum(last - 1, 0))
    at = jnp.clip(lines.start[row] + low, 0, lines.points.shape[0] - 1)
    after = jnp.clip(lines.start[row] + jnp.minimum(low + 1, last), 0, lines.points.shape[0] - 1)
    a, b = lines.points[at, :2], lines.points[after, :2]
    xy = a + (exact - low.astype(share.dtype))[:, None] * (b - a)
    return xy[:, 0], xy[:, 1]


def _red_connectors(lanes: Lanes, lights: jax.Array, ego: EgoState) -> tuple[Polyline, jax.Array]:
    """Centre lines of red connectors with points 0.25 m apart, in the ego frame."""
    red = (lights == LightStatus.RED) & lanes.is_connector & lanes.valid
    lane, valid = true_indices(red, MAX_RED)
    count = 1 + jnp.floor(lanes.length[lane] / POINT_SPACING).astype(jnp.int32)
    count = jnp.where(valid, jnp.minimum(count, RED_POINTS), 0)
    arc = jnp.arange(RED_POINTS, dtype=ego.x.dtype) * POINT_SPACING
    share = jnp.clip(arc / jnp.maximum(lanes.length[lane], 1e-3)[:, None], 0, 1)
    x, y = jax.vmap(lambda row, s: _along(lanes.centerline, jnp.full(s.shape, row), s))(lane, share)
    x, y, heading = local_pose(x, y, jnp.zeros_like(x), ego)
    return Polyline(x, y, heading, count), jnp.sum(red) > MAX_RED
