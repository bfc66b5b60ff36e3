"""A small NAVSIM scene as plain arrays, and stand-ins of the devkit's objects made from arrays."""

import itertools
from collections.abc import Mapping
from types import SimpleNamespace as Thing
from typing import Any

import numpy as np
from shapely.geometry import MultiPolygon, Polygon

from spdm_jax.navsim.navsim_export import MAP_KINDS, NUM_AGENT_TYPES, OBJECT_TYPES

VEHICLE = (2.297, 5.176, 3.089, 1.461, 4.049, 1.127, 1.67)
ORIGIN = np.array([664_000.0, 3_998_000.0])
START_US = 1_650_000_000_500_000


class TimePoint:
    """nuPlan's instant."""

    def __init__(self, time_us: int):
        self.time_us = time_us

    @property
    def time_s(self) -> float:
        return self.time_us * 1e-6


class Trajectory:
    """nuPlan's interpolated trajectory, as far as an export asks: linear between its states."""

    def __init__(self, states: list[Thing]):
        self._states = states
        self.start_time, self.end_time = states[0].time_point, states[-1].time_point

    def get_sampled_trajectory(self) -> list[Thing]:
        return self._states

    def get_state_at_times(self, points: list[TimePoint]) -> list[Thing]:
        times = [state.time_point.time_us for state in self._states]
        rows = np.array([row_of(state) for state in self._states])
        rows[:, 2] = np.unwrap(rows[:, 2])
        columns = [np.interp([p.time_us for p in points], times, column) for column in rows.T]
        return [
            ego_state(row, p.time_us) for row, p in zip(np.stack(columns, 1), points, strict=True)
        ]


def row_of(state: Thing) -> list[float]:
    pose, motion = state.rear_axle, state.dynamic_car_state
    return [
        pose.x,
        pose.y,
        pose.heading,
        motion.rear_axle_velocity_2d.x,
        motion.rear_axle_velocity_2d.y,
        motion.rear_axle_acceleration_2d.x,
        motion.rear_axle_acceleration_2d.y,
        state.tire_steering_angle,
        motion.tire_steering_rate,
        motion.angular_velocity,
        motion.angular_acceleration,
    ]


def ego_state(row: np.ndarray, time_us: int, vehicle: Any = VEHICLE) -> Thing:
    x, y, heading, vx, vy, ax, ay, steering, rate, yaw_rate, yaw_acceleration = map(float, row)
    names = ("width", "length", "wheel_base", "rear_axle_to_center", "front_length", "rear_length")
    sizes = dict(zip((*names, "cog_position_from_rear_axle"), map(float, vehicle), strict=True))
    return Thing(
        rear_axle=Thing(x=x, y=y, heading=heading),
        time_point=TimePoint(int(time_us)),
        tire_steering_angle=steering,
        car_footprint=Thing(vehicle_parameters=Thing(**sizes)),
        dynamic_car_state=Thing(
            rear_axle_velocity_2d=Thing(x=vx, y=vy),
            rear_axle_acceleration_2d=Thing(x=ax, y=ay),
            tire_steering_rate=rate,
            angular_velocity=yaw_rate,
            angular_acceleration=yaw_acceleration,
        ),
    )


def box_polygon(pose: np.ndarray, size: np.ndarray) -> Polygon:
    """Corners front left, rear left, rear right, front right, as nuPlan orders them."""
    x, y, heading = pose
    along = 0.5 * size[0] * np.array([np.cos(heading), np.sin(heading)])
    left = 0.5 * size[1] * np.array([-np.sin(heading), np.cos(heading)])
    here = np.array([x, y])
    return Polygon([here + along + left, here - along + left, here - along - left,
                    here + along - left])  # fmt: skip


def metric_cache(given: Mapping[str, np.ndarray], devkit: str = "v2", human: bool = True) -> Thing:
    """Returns a metric cache as NAVSIM would have made it of a scene.

    Args:
      given: arrays of an exported scene, with objects as the cache has them, every 0.1 s:
        `obj_pose [S, n, 3]`, `obj_valid [S, n]`.
      devkit: "v1" or "v2".
      human: whether there is a human future.
    """
    start = int(given["start_time_us"])
    count = 51 if devkit == "v1" else 41
    tokens = [f"track{i:03d}" for i in range(len(given["obj_type"]))]
    red_rings = split(given["red_offsets"], given["red_xy"])
    lights, maps = [], []
    for k in range(count):
        active = np.flatnonzero(given["log_red"][:, k // 5])
        lights.append(([f"red_light_{m}" for m in active], [Polygon(red_rings[m]) for m in active]))
        there = np.flatnonzero(given["obj_valid"][k])
        boxes = [box_polygon(given["obj_pose"][k, i], given["obj_size"][i]) for i in there]
        names = [tokens[i] for i in there]
        if devkit == "v2":
            names, boxes = names + lights[k][0], boxes + lights[k][1]
        maps.append(Thing(tokens=names, _geometries=boxes))
    first = np.argmax(given["log_valid"], axis=0)
    seen = {}
    for i in np.flatnonzero(given["obj_valid"][:count].any(axis=0)):
        length, width = given["obj_size"][i]
        seen[tokens[i]] = Thing(
            tracked_object_type=Thing(name=OBJECT_TYPES[given["obj_type"][i]]),
            box=Thing(length=length, width=width),
        )
        if given["obj_type"][i] < NUM_AGENT_TYPES:
            x, y = given["log_velocity"][first[i], i]
            seen[tokens[i]].velocity = Thing(x=x, y=y)
    observation = Thing(_occupancy_maps=maps, unique_objects=seen)
    rings = split(given["map_ring_offsets"], given["map_ring_xy"])
    parts: list[list[Polygon]] = [[] for _ in given["map_kind"]]
    for owner, ring in zip(given["map_ring_object"], rings, strict=True):
        parts[owner].append(Polygon(ring))
    ids = [f"area{i}" for i in range(len(parts))]
    reference = np.zeros((41, 11))
    reference[:, :3] = given["reference"]
    instants = ((np.arange(0.0, 4.1, 0.1)[:41] + start * 1e-6) * 1e6).astype(np.int64)
    instants[0] = start
    cache = Thing(
        ego_state=ego_state(given["ego_state"], start, given["vehicle_params"]),
        trajectory=Trajectory(
            [ego_state(row, at) for row, at in zip(reference, instants, strict=True)]
        ),
        centerline=Thing(
            discrete_path=[Thing(x=x, y=y, heading=h) for x, y, h in given["centerline"].tolist()]
        ),
        drivable_area_map=Thing(
            tokens=ids,
            map_types=[Thing(name=MAP_KINDS[kind]) for kind in given["map_kind"]],
            _geometries=[p[0] if len(p) == 1 else MultiPolygon(p) for p in parts],
        ),
        route_lane_ids=[ids[i] for i in np.flatnonzero(given["map_on_route"])],
        observation=observation,
    )
    if devkit == "v2":
        cache.log_name = "a log"
        observation._occupancy_maps_tl = lights
        past = zip(given["ego_past"], given["ego_past_us"], strict=True)
        cache.past_human_trajectory = Trajectory([ego_state(row, at) for row, at in past])
        cache.human_trajectory = Thing(poses=given["human_poses"]) if human else None
    return cache


class Loader:
    """NAVSIM's loader of metric caches."""

    def __init__(self, caches: Mapping[str, Any]):
        self._caches = caches
        self.tokens = list(caches)

    def get_from_token(self, token: str) -> Any:
        return self._caches[token]


def split(offsets: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    return [points[a:b] for a, b in itertools.pairwise(offsets)]


def rectangle(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], float)


def road_scene(speed: float = 8.0) -> dict[str, np.ndarray]:
    """A straight road along x, in map coordinates, every array of an exported scene.

    Two lanes of 3.5 m, the right one (its centre at y = 0) on the route; an intersection from
    x = 45 m on with a connector that is red from frame 4 on; a parked car ahead to the right and
    half in the lane at x = 30 m, one car in the left lane, a cone that is logged once. The
    reference drives on at constant speed.
    """
    areas = [
        (0, False, rectangle(-60, 45, -1.75, 5.25)),
        (1, True, rectangle(-60, 45, -1.75, 1.75)),
        (1, False, rectangle(-60, 45, 1.75, 5.25)),
        (2, True, rectangle(45, 90, -1.75, 1.75)),
        (3, False, rectangle(45, 90, -12, 12)),
    ]
    rings = [ring + ORIGIN for _, _, ring in areas]
    time = np.arange(11) * 0.5
    pose = np.zeros((11, 3, 3))
    pose[:, 0] = [35.0, -2.2, 0.0]
    pose[:, 1, 0], pose[:, 1, 1] = 5.0 + 6.0 * time, 3.5
    pose[:, 2] = [20.0, -6.0, 0.3]
    velocity = np.zeros((11, 3, 2))
    velocity[:, 1, 0] = 6.0
    valid = np.ones((11, 3), bool)
    valid[1:, 2] = False
    valid[3, 1] = False
    pose[..., :2] += ORIGIN
    pose[~valid], velocity[~valid] = 0.0, 0.0
    line = np.zeros((141, 3))
    line[:, 0] = np.arange(-50.0, 91.0)
    line[:, :2] += ORIGIN
    ego = np.zeros(11)
    ego[:2], ego[3] = ORIGIN, speed
    past = np.tile(ego, (4, 1))
    past[:, 0] += speed * np.array([-1.5, -1.0, -0.5, 0.0])
    reference = np.zeros((41, 3))
    reference[:, 0] = speed * 0.1 * np.arange(41)
    reference[:, :2] += ORIGIN
    human = np.zeros((8, 3))
    human[:, 0] = speed * 0.5 * np.arange(1, 9)
    red = np.zeros((1, 11), bool)
    red[0, 4:9] = True
    return {
        "format": np.array("navsim-scene"),
        "version": np.array(1),
        "devkit": np.array("v2"),
        "token": np.array("0123456789abcdef"),
        "log_name": np.array("a log"),
        "ego_state": ego,
        "start_time_us": np.array(START_US),
        "vehicle_params": np.array(VEHICLE),
        "centerline": line,
        "reference": reference,
        "map_ring_offsets": 5 * np.arange(len(rings) + 1),
        "map_ring_xy": np.concatenate(rings),
        "map_ring_object": np.arange(len(rings)),
        "map_kind": np.array([kind for kind, _, _ in areas]),
        "map_on_route": np.array([on for _, on, _ in areas]),
        "obj_type": np.array([0, 0, 3]),
        "obj_is_agent": np.array([True, True, False]),
        "obj_size": np.array([[4.8, 2.0], [4.8, 2.0], [0.5, 0.5]]),
        "log_pose": pose,
        "log_velocity": velocity,
        "log_valid": valid,
        "log_red": red,
        "red_offsets": np.array([0, 5]),
        "red_xy": rings[3],
        "ego_past": past,
        "ego_past_us": START_US + np.array([-1_500_000, -1_000_000, -500_000, 0]),
        "human_poses": human,
    }


def replay(scene: Mapping[str, np.ndarray], samples: int) -> dict[str, np.ndarray]:
    """Adds `obj_pose` and `obj_valid`: objects every 0.1 s as a metric cache has them."""
    count = len(scene["obj_type"])
    pose, valid = np.zeros((samples, count, 3)), np.zeros((samples, count), bool)
    wanted = 0.1 * np.arange(samples)
    frames = (samples - 1) // 5 + 1
    for i in range(count):
        there = np.flatnonzero(scene["log_valid"][:frames, i])
        if len(there) == 1:
            pose[:, i], valid[:, i] = scene["log_pose"][there[0], i], True
        elif len(there):
            known = scene["log_pose"][there, i].copy()
            known[:, 2] = np.unwrap(known[:, 2])
            columns = [np.interp(wanted, 0.5 * there, column) for column in known.T]
            pose[:, i] = np.stack(columns, axis=-1)
            valid[:, i] = (wanted > 0.5 * there[0] - 1e-9) & (wanted < 0.5 * there[-1] + 1e-9)
    return {**scene, "obj_pose": pose, "obj_valid": valid}


def straight(*speeds: float, left: float = 0.0) -> np.ndarray:
    """`[P, 8, 3]` straight ahead, reaching `left` m to the left at 4 s."""
    share = np.arange(1, 9) / 8
    poses = np.zeros((len(speeds), 8, 3))
    poses[..., 0] = 4 * np.array(speeds)[:, None] * share
    poses[..., 1] = left * share
    return poses
