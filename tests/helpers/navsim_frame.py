"""A small frame of NAVSIM's in map coordinates, as the arrays that `from_arrays` reads.

A road along x: the route's lane (|y| < 1.75) and an oncoming lane left of it share a road block.
Right of it runs a lane that no block covers. An intersection lies across from x = 60 to 80 m,
reaching farther left than the block. The ego stands at (0, 0) of the frame and drives at 10 m/s.
"""

from typing import Any

import numpy as np

ORIGIN = np.array([664_000.0, 3_997_000.0])
START_US = 1_623_707_858_950_113
FRAMES, STEPS = 11, 41
SPEED = 10.0
VEHICLE = np.array([2.297, 5.176, 3.089, 1.461, 4.049, 1.127, 1.67])
REACH, LENGTH, WIDTH = 1.461, 5.176, 2.297
BLOCK, LANE, CONNECTOR, INTERSECTION = range(4)
AREAS = (
    (BLOCK, False, (-60, -1.75, 140, 5.25)),
    (LANE, True, (-60, -1.75, 140, 1.75)),
    (LANE, False, (-60, 1.75, 140, 5.25)),
    (LANE, False, (-60, -5.25, 140, -1.75)),
    (INTERSECTION, False, (60, -1.75, 80, 12)),
)
RED_AREA = (20.0, -1.75, 30.0, 1.75)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    """Closed ring `[5, 2]`."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def straight(speed: float, y: float = 0.0) -> np.ndarray:
    """Poses `[8, 3]` at one speed, moved to the left by y at once."""
    time = 0.5 * np.arange(1, 9)
    return np.stack([speed * time, np.full(8, y), np.zeros(8)], 1)


def logged(
    x: Any,
    y: Any = 0.0,
    *,
    heading: float = 0.0,
    speed: Any = 0.0,
    frames: Any = slice(None),
    kind: int = 0,
    size: tuple[float, float] = (4.0, 2.0),
) -> dict[str, Any]:
    """An object: box centres (one or `[11]`), speed along its heading, and when it is recorded."""
    each = lambda v: np.broadcast_to(np.asarray(v, float), (FRAMES,))
    direction = np.array([np.cos(heading), np.sin(heading)])
    valid = np.zeros(FRAMES, bool)
    valid[frames] = True
    return {
        "pose": np.stack([each(x), each(y), each(heading)], 1),
        "velocity": each(speed)[:, None] * direction,
        "valid": valid,
        "kind": kind,
        "size": size,
    }


def driving(x0: float, speed: float, y: float = 0.0, heading: float = 0.0, **more) -> dict:
    """An object at constant speed from x0 at the start."""
    time = 0.5 * np.arange(FRAMES)
    return logged(
        x0 + speed * time * np.cos(heading),
        y + speed * time * np.sin(heading),
        heading=heading,
        speed=speed,
        **more,
    )


def frame(
    *objects: dict,
    y: float = 0.0,
    x: float = 0.0,
    speed: float = SPEED,
    red: Any = None,
    reference_speed: float = SPEED,
    past_accel: float = 0.0,
    areas: tuple = AREAS,
) -> dict[str, Any]:
    """Arrays of one frame.

    Args:
      objects: from `logged` or `driving`.
      y: lateral place of the ego.
      x: its place along the road.
      speed: its speed, m/s.
      red: frames at which the connector `RED_AREA` is red; None has no connector.
      reference_speed: of PDM-Closed's trajectory.
      past_accel: acceleration that the past records, m/s^2.
      areas: kind, on route, and rectangle of the map's objects.
    """
    ego = np.zeros(11)
    ego[:2], ego[3] = ORIGIN + np.array([x, y]), speed
    times = np.array([-1_500_000, -1_000_000, -500_000, 0]) + START_US
    past = np.repeat(ego[None], 4, axis=0)
    past[:, 0] += speed * (times - START_US) * 1e-6
    past[:, 5] = past_accel
    past[-1] = ego
    reference = np.zeros((STEPS, 3))
    reference[:, :2] = ego[:2]
    reference[:, 0] += 0.1 * reference_speed * np.arange(STEPS)
    rings = [rectangle(*area) + ORIGIN for _, _, area in areas]
    count = len(objects)
    gather = lambda name, shape: (
        np.stack([o[name] for o in objects], 1) if count else np.zeros((FRAMES, 0, *shape))
    )
    pose = gather("pose", (3,))
    pose[..., :2] += ORIGIN
    line = np.array([[-60, 0, 0], [20, 0, 0], [20, 0, 0], [140, 0, 0.0]])
    line[:, :2] += ORIGIN
    lights = 0 if red is None else 1
    log_red = np.zeros((lights, FRAMES), bool)
    if lights:
        log_red[0, red] = True
    return {
        "ego_state": ego,
        "start_time_us": np.array(START_US),
        "vehicle_params": VEHICLE,
        "centerline": line,
        "reference": reference,
        "map_ring_offsets": np.arange(len(rings) + 1) * 5,
        "map_ring_xy": np.concatenate(rings),
        "map_ring_object": np.arange(len(rings)),
        "map_kind": np.array([kind for kind, _, _ in areas]),
        "map_on_route": np.array([routed for _, routed, _ in areas]),
        "obj_type": np.array([o["kind"] for o in objects], int),
        "obj_size": np.array([o["size"] for o in objects], float).reshape(-1, 2),
        "log_pose": pose,
        "log_velocity": gather("velocity", (2,)),
        "log_valid": gather("valid", ()).astype(bool),
        "log_red": log_red,
        "red_offsets": np.arange(lights + 1) * 5,
        "red_xy": (rectangle(*RED_AREA) + ORIGIN)[: 5 * lights],
        "ego_past": past,
        "ego_past_us": times,
    }
