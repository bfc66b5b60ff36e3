"""Random raw scenarios: a chain of roadblocks far from zero, odd areas, gaps in the recording."""

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock, RawScenario, RawTracks

BLOCK_LENGTH = 20.0
LANE_WIDTH = 4.0


def world(
    seed: int = 0, *, blocks: int = 5, lanes: int = 2, agents: int = 3, areas: int = 3
) -> RawScenario:
    """Returns a straight road of `blocks` roadblocks that runs on 40 blocks beyond the route.

    Args:
      seed: of everything random.
      blocks: roadblocks of the route.
      lanes: lanes of each roadblock.
      agents: tracks.
      areas: polygons of each further layer, strewn along the road.
    """
    rng = np.random.default_rng(seed)
    frame = _Frame(rng.uniform(-np.pi, np.pi), rng.uniform(-4e6, 4e6, 2))
    raw_map = _road(rng, frame, blocks + 40, lanes)
    layers = ("intersections", "car_parks", "drivable", "crosswalks", "walkways", "stop_lines")
    for layer in layers:
        shapes = [_area(rng, frame) for _ in range(areas)]
        made = [RawArea(f"{layer}-{i}", s, int(rng.integers(4))) for i, s in enumerate(shapes)]
        getattr(raw_map, layer).extend(made)
    for lane in raw_map.lanes.values():
        if areas and rng.random() < 0.3:
            lane.intersection = f"intersections-{rng.integers(areas)}"
            lane.stop_line = f"stop_lines-{rng.integers(areas)}"

    history, iterations = int(rng.integers(1, 5)), int(rng.integers(4, 8))
    steps = history + iterations + int(rng.integers(3))
    time_us = 1_600_000_000_000_000 + np.cumsum(rng.integers(90_000, 110_000, steps))
    ego = rng.normal(size=(steps, 11))
    ego[:, :3] = frame.poses(np.stack([np.linspace(2, 9, steps), *np.zeros((2, steps))], 1))
    valid = rng.random(steps) < 0.8
    valid[history : history + iterations] = True
    ego[~valid] = np.nan
    seen = rng.random((agents, steps)) < 0.7
    pose = frame.poses(rng.uniform(-40, 40, (agents, steps, 3)))
    pose[~seen] = np.nan
    return RawScenario(
        token=f"world{seed}",
        log_name="log",
        scenario_type="random",
        source="test",
        map=raw_map,
        time_us=time_us,
        num_history=history,
        num_iterations=iterations,
        ego=ego,
        ego_valid=valid,
        tracks=RawTracks(
            ids=[f"track{i}" for i in range(agents)],
            type=rng.integers(0, 7, agents),
            pose=pose,
            velocity=rng.normal(size=(agents, steps, 2)),
            size=rng.uniform(0.3, 5, (agents, steps, 2)),
            valid=seen,
        ),
        lights=[{key: int(rng.integers(4)) for key in list(raw_map.lanes)[:3]} for _ in time_us],
        route_roadblocks=[f"b{i}" for i in range(blocks)],
        mission_goal=frame.poses(np.array([60.0, 0.0, 0.1])) if rng.random() < 0.5 else None,
        notes=["made up"],
    )


class _Frame:
    """Rotation, then translation."""

    def __init__(self, angle: float, origin: np.ndarray):
        self.angle, self.origin = angle, origin

    def points(self, xy: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return xy @ np.array([[cos, sin], [-sin, cos]]) + self.origin

    def poses(self, pose: np.ndarray) -> np.ndarray:
        return np.concatenate([self.points(pose[..., :2]), pose[..., 2:] + self.angle], -1)

    def shape(self, polygon: BaseGeometry) -> BaseGeometry:
        return shapely.transform(polygon, self.points)


def _road(rng: np.random.Generator, frame: _Frame, blocks: int, lanes: int) -> RawMap:
    raw_lanes: dict[str, RawLane] = {}
    raw_blocks: dict[str, RawRoadblock] = {}
    order = rng.permutation(blocks * lanes)  # the source's order of lanes is any
    half = LANE_WIDTH / 2
    for n in order.tolist():
        b, k = divmod(n, lanes)
        x = np.linspace(b * BLOCK_LENGTH, (b + 1) * BLOCK_LENGTH, int(rng.integers(2, 6)))
        y = np.full_like(x, -LANE_WIDTH * k)
        left, right = np.stack([x, y + half], 1), np.stack([x, y - half], 1)
        ring = np.concatenate([right, left[::-1]])
        if rng.random() < 0.5:
            ring = np.concatenate([ring, ring[:1]])
        raw_lanes[f"b{b}l{k}"] = RawLane(
            id=f"b{b}l{k}",
            is_connector=b % 2 == 1,
            roadblock=f"b{b}",
            centerline=frame.poses(np.stack([x, y, np.zeros_like(x)], 1)),
            left_boundary=frame.points(left),
            right_boundary=frame.points(right),
            polygon=frame.points(ring),
            successors=[f"b{b + 1}l{k}", "nowhere"],
            predecessors=[f"b{b - 1}l{k}"],
            left_neighbor=f"b{b}l{k - 1}" if k else None,
            right_neighbor=f"b{b}l{k + 1}" if k + 1 < lanes else None,
            speed_limit=float(rng.uniform(5, 20)) if rng.random() < 0.5 else None,
            has_traffic_light=bool(rng.random() < 0.3),
        )
    for b in rng.permutation(blocks).tolist():
        box = shapely.box(b * BLOCK_LENGTH, half - lanes * LANE_WIDTH, (b + 1) * BLOCK_LENGTH, half)
        raw_blocks[f"b{b}"] = RawRoadblock(
            id=f"b{b}",
            is_connector=b % 2 == 1,
            polygon=frame.shape(box),
            lanes=[f"b{b}l{k}" for k in range(lanes)],
            successors=[f"b{b + 1}"],
            predecessors=[f"b{b - 1}"],
        )
    return RawMap(name="road", lanes=raw_lanes, roadblocks=raw_blocks)


def _area(rng: np.random.Generator, frame: _Frame) -> BaseGeometry:
    """Returns a box, a box with a hole, or two apart; either direction, anywhere on the road."""
    box = shapely.box(0, 0, *rng.uniform(3, 30, 2))
    x, y = rng.uniform(-50, 40 * BLOCK_LENGTH), rng.uniform(-60, 60)
    kind = rng.integers(3)
    if kind == 1:
        box = box.difference(affinity.scale(box, 0.5, 0.5))
    elif kind == 2:
        box = shapely.MultiPolygon([box, affinity.translate(box, 40)])
    if rng.random() < 0.5:
        box = shapely.reverse(box)
    return frame.shape(affinity.translate(box, x, y))
