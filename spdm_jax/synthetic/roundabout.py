"""The scene at a roundabout: a one-lane ring that four arms lead into and out of."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import shapely
from shapely.geometry import JOIN_STYLE, Polygon

from spdm_jax.synthetic.junctions import ARMS, add_arms, approach, pavement_walks, target_arm
from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import (
    INTERSECTION_PLAIN,
    LANE_WIDTH,
    MARGIN,
    LaneShape,
    MapBuilder,
    lane_between,
)
from spdm_jax.synthetic.stage import Stage, queue
from spdm_jax.synthetic.traffic import EGO_FRONT

RADIUS = 17.0
"""Of the ring's centre line, m."""
SPLAY = np.radians(36.0)
"""Angle between an arm and the places on the ring where its traffic joins and leaves."""
ARM_START = RADIUS + 15.0
"""Distance of the arms' inner ends from the centre, m."""


def roundabout(
    rng: np.random.Generator,
    *,
    turn: str | None = None,
    distance: float = 30.0,
    speed: float = 7.0,
    speed_limit: float = 8.3,
    spacing: float = 32.0,
) -> Stage:
    """A roundabout with one lane; whoever enters gives way to the ring.

    Options: `turn` "left", "straight" or "right" (drawn if None); `distance` in m from the ego's
    front bumper to the roundabout at iteration 0.

    Raises:
      ValueError: an unknown turn, or a distance outside 2 ... 150 m.
    """
    turn = turn or str(rng.choice(["left", "straight", "right"]))
    target = target_arm(turn)
    builder = MapBuilder("synthetic")
    arms = add_arms(rng, builder, lanes=1, radius=ARM_START, speed_limit=speed_limit)
    _add_ring(builder, arms)
    stage = approach(builder, _way("south", target), distance, speed, speed_limit)
    line = stage.ego.station + EGO_FRONT + distance - 1.0
    stage.ego = dataclasses.replace(stage.ego, give_way=line)
    for source, exit_arm in (("west", "north"), ("north", "south"), ("east", "west")):
        connectors = _way(source, exit_arm)
        lanes = builder.follow(f"{source}~:0/0", connectors)
        path = builder.path(lanes)
        end = path.station_of(builder.lanes[connectors[0]].centerline[0, :2])
        stage.followers += queue(
            rng,
            path,
            end - 110.0,
            end - 15.0,
            spacing,
            speed=speed,
            desired_speed=0.9 * speed_limit,
            give_way=end - 1.0,
        )
    pavement_walks(rng, stage, arms, 1)
    return stage


def _way(source: str, target: str) -> list[str]:
    """Returns the connectors from one arm to another."""
    first = ARMS.index(source)
    passed = [ARMS[(first + k) % len(ARMS)] for k in range(1, len(ARMS) + 1)]
    between = passed[: passed.index(target)]
    return [f"{source}>ring/0", *(f"ring@{arm}/0" for arm in between), f"ring>{target}/0"]


def _add_ring(builder: MapBuilder, arms: Mapping[str, Path]) -> None:
    """Adds the ring, whose lane after an arm is called `ring:{arm}`, and its connectors.

    At each arm, traffic enters by `{arm}>ring`, leaves by `ring>{arm}` or passes by `ring@{arm}`.
    """
    angles = [float(np.arctan2(path.xy[0, 1], path.xy[0, 0])) for path in arms.values()]
    names = list(arms)
    for i, arm in enumerate(names):
        angle, ahead = angles[i], angles[(i + 1) % len(names)]
        span = (ahead - angle) % (2.0 * np.pi)
        shape = _arc(angle + SPLAY, angle + span - SPLAY)
        builder.add_block(f"ring:{arm}", {0: shape}, speed_limit=None)
        builder.add_road_surface(f"ring:{arm}", _surface([shape], MARGIN))
    for i, (arm, path) in enumerate(arms.items()):
        before = f"ring:{names[i - 1]}/0"
        inward, outward = path.pose(0.0), path.pose(0.0)
        inward[:2] = builder.lanes[f"{arm}~:1/0"].centerline[-1, :2]
        inward[2] += np.pi
        outward[:2] = builder.lanes[f"{arm}:0/0"].centerline[0, :2]
        shapes = {
            f"{arm}>ring": lane_between(inward, _ring_pose(angles[i] + SPLAY)),
            f"ring>{arm}": lane_between(_ring_pose(angles[i] - SPLAY), outward),
            f"ring@{arm}": _arc(angles[i] - SPLAY, angles[i] + SPLAY),
        }
        area = _surface(list(shapes.values()), MARGIN)
        builder.add_intersection(f"junction.{arm}", area, INTERSECTION_PLAIN)
        for block, shape in shapes.items():
            builder.add_block(block, {0: shape}, speed_limit=None, intersection=f"junction.{arm}")
        builder.link(f"{arm}~:1/0", f"{arm}>ring/0")
        builder.link(f"{arm}>ring/0", f"ring:{arm}/0")
        builder.link(before, f"ring@{arm}/0")
        builder.link(f"ring@{arm}/0", f"ring:{arm}/0")
        builder.link(before, f"ring>{arm}/0")
        builder.link(f"ring>{arm}/0", f"{arm}:0/0")


def _ring_pose(angle: float) -> np.ndarray:
    """Returns `[3]` the pose on the ring's centre line at `angle`."""
    return np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), angle + np.pi / 2])


def _arc(start: float, end: float) -> LaneShape:
    """Returns the lane along the ring between two angles."""
    angles = np.linspace(start, end, max(round(RADIUS * (end - start)), 2) + 1)
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    half = LANE_WIDTH / 2
    return LaneShape(*((RADIUS + d) * direction for d in (0.0, -half, half)))


def _surface(shapes: list[LaneShape], margin: float) -> Polygon:
    """Returns the area of lanes and `margin` m around them, with the islands between filled."""
    rings = [Polygon(np.concatenate([s.left, s.right[::-1]])) for s in shapes]
    union = shapely.union_all(rings).buffer(margin, join_style=JOIN_STYLE.mitre)
    return Polygon(shapely.get_exterior_ring(union))
