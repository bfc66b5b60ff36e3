"""The oncoming lane beside the ego's own, as far as it may be borrowed (an extension of SPDM)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from spdm_jax.arrays import prefix_count
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Path, ego_box, interpolate, make_path, project
from spdm_jax.types import EgoState, Lanes, Route

STATIONS = 41
"""Stations at which the lane beside is looked for, from the ego onwards."""
STATION_STEP = 2.5
"""Distance between them, m."""
MIN_SPACING, MAX_SPACING = 2.0, 5.25
"""Distance between the middles of two lanes that lie side by side, m: up to 1.5 usual widths."""
OPPOSITE = -0.9
"""Cosine of the angle between the lanes' directions from which on they are opposite."""
_NEAR = 5.0  # m along the lane, to the nearest stored point of the lane beside


class OncomingLane(NamedTuple):
    """An oncoming lane that lies beside the centreline, in the ego's direction of travel.

    Attributes:
      path: `Path` `[M]`, the lane's middle, from beside the ego to where it stops lying there.
      own: `Path` `[STATIONS]`, the centreline from beside the ego.
      side: `[]` 1 where it lies to the left, -1 to the right.
      border: `[]` m from the centreline to the border between the two, beside the ego.
      lane: `[]` int32 row of the oncoming lane, -1 if there is none.
      usable: `[]` bool.
    """

    path: Path
    own: Path
    side: jax.Array
    border: jax.Array
    lane: jax.Array
    usable: jax.Array


def lateral_offset(path: Path, x: jax.Array, y: jax.Array) -> jax.Array:
    """Lateral offset of points `[...]` from a path, left positive, m."""
    px, py, heading = interpolate(path, project(path, x, y))
    return (y - py) * jnp.cos(heading) - (x - px) * jnp.sin(heading)


def oncoming_lane(
    lanes: Lanes, route: Route, centerline: Path, ego: EgoState, max_points: int
) -> OncomingLane:
    """Finds the oncoming lane beside the centreline.

    It is off route and no connector, so that nothing is borrowed within a junction; it runs against
    the centreline, its middle is at most `MAX_SPACING` away, and nothing but the drivable area says
    whether one may cross over. Where several do, the nearest counts, on either side.

    Args:
      lanes: lane table.
      route: route tables.
      centerline: stage-1 centreline.
      ego: current state, scalars.
      max_points: M, room for a path's points.
    """
    station = project(centerline, ego.x, ego.y) + STATION_STEP * jnp.arange(STATIONS)
    x, y, heading = interpolate(centerline, station)
    cos, sin = jnp.cos(heading)[:, None], jnp.sin(heading)[:, None]
    line = lanes.centerline
    offered = lanes.valid & ~lanes.is_connector & ~route.lane_on_route
    dx, dy = line.points[:, 0] - x[:, None], line.points[:, 1] - y[:, None]
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    turn = line.points[:, 2] - heading[:, None]
    # What the lane beside is off at the station itself, not at its nearest stored point.
    left = left - ahead * jnp.tan(turn)
    beside = (
        (line.valid & offered[line.row])
        & (jnp.cos(turn) < OPPOSITE)
        & (jnp.abs(ahead) < _NEAR)
        & (jnp.abs(left) > MIN_SPACING)
        & (jnp.abs(left) < MAX_SPACING)
    )
    distance = jnp.where(beside, jnp.hypot(ahead, left), jnp.inf)
    nearest = jnp.argmin(distance, axis=1)
    spacing = jnp.take_along_axis(left, nearest[:, None], axis=1)[:, 0]
    found = jnp.any(beside, axis=1) & (station <= centerline.length)
    side = jnp.where(spacing[0] < 0, -1, 1).astype(x.dtype)
    found &= spacing * side > 0
    count = jnp.sum(prefix_count(~found) == 0, dtype=jnp.int32)
    usable = count > 1

    def padded(values):
        return jnp.pad(values, (0, max(max_points - STATIONS, 0)))[:max_points]

    count = jnp.clip(count, 2, max_points)
    x_beside, y_beside = x - spacing * sin[:, 0], y + spacing * cos[:, 0]
    return OncomingLane(
        path=make_path(padded(x_beside), padded(y_beside), padded(heading), count),
        own=make_path(x, y, heading, jnp.asarray(STATIONS, jnp.int32)),
        side=side,
        border=0.5 * jnp.abs(spacing[0]),
        lane=jnp.where(usable, line.row[nearest[0]], -1).astype(jnp.int32),
        usable=usable,
    )


def beyond_border(oncoming: OncomingLane, ego: EgoState, vehicle: VehicleParams) -> jax.Array:
    """Whether the ego's centre `[...]` is in the oncoming lane."""
    box = ego_box(ego, vehicle)
    offset = lateral_offset(oncoming.own, box.x, box.y)
    return oncoming.usable & (offset * oncoming.side > oncoming.border)
