"""Whether a recorded ego drove well enough to be an expert, judged with the whole record at hand.

The bounds are nuPlan's of comfort and time to collision, a little tightened, since the scores of
a run repeat the record only roughly. Collisions and the drivable area are checked to the end of
the record, everything else within the scenario's own window.
"""

import itertools

import numpy as np
import shapely

from spdm_jax.config import DT
from spdm_jax.io.raw import RawScenario
from spdm_jax.synthetic.traffic import EGO

LON_ACCEL = (-3.8, 2.2)  # m/s^2
LAT_ACCEL = 4.0  # m/s^2
LON_JERK = 3.8  # m/s^3
YAW_RATE = 0.85  # rad/s
YAW_ACCEL = 1.7  # rad/s^2
TTC_STEPS = 11  # steps of constant velocity, the bound is 0.95 s
TTC_TURNS = (-0.025, 0.0, 0.025)  # rad, deviations of the heading of whoever repeats the record
TTC_ANGLE = np.radians(150.0)  # from the ego's heading, objects beyond it are behind
NEAR = 40.0  # m, objects further away are not met within `TTC_STEPS`


def faults(raw: RawScenario) -> list[str]:
    """Returns what is wrong with the recorded ego's driving; nothing if it is an expert's."""
    begin = raw.num_history
    window = slice(begin, begin + raw.num_iterations)
    found = []
    ego = ego_boxes(raw.ego[begin:])
    tracks = raw.tracks
    for i, k in _near(raw, slice(begin, None)):
        box = boxes(tracks.pose[i, begin + k], tracks.size[i, begin + k])
        if shapely.intersects(ego[k], box):
            found.append(f"hits {tracks.ids[i]} at step {k}")
            break
    surface = shapely.union_all([area.polygon.buffer(1e-3) for area in raw.map.drivable])
    shapely.prepare(surface)
    if not shapely.covers(surface, ego).all():
        found.append("leaves the drivable area")
    limits = [lane.speed_limit for lane in raw.map.lanes.values() if lane.speed_limit is not None]
    if limits and raw.ego[window, 3].max() > min(limits):
        found.append("is too fast")
    found += [f"has {name} {worst:.2f}" for name, worst in discomfort(raw.ego[window]).items()]
    if (step := _close_call(raw, window)) is not None:
        found.append(f"comes too close at step {step}")
    return found


def discomfort(ego: np.ndarray) -> dict[str, float]:
    """Returns the comfort quantities that leave their bounds, with their worst values.

    Args:
      ego: `[T, 11]` states at 0.1 s, as in `RawScenario`.
    """
    heading = np.unwrap(ego[:, 2])
    yaw_rate, yaw_accel = ego[:, 9], ego[:, 10]
    # nuPlan's acceleration of the box centre.
    accel = ego[:, 5] + float(EGO.rear_axle_to_center) * (yaw_rate**2 + yaw_accel)
    accel = _parabolas(accel, 8, slope=False)
    # Curvature of a parabola over 5 samples.
    bend = np.array([2.0, -1.0, -2.0, -1.0, 2.0]) / 7.0 / DT**2
    values = {
        "acceleration": (accel, LON_ACCEL),
        "lateral acceleration": (ego[:, 6], (-LAT_ACCEL, LAT_ACCEL)),
        "jerk": (_parabolas(accel, 15, slope=True) / DT, (-LON_JERK, LON_JERK)),
        "yaw rate": (yaw_rate, (-YAW_RATE, YAW_RATE)),
        "yaw acceleration": (np.convolve(heading, bend, mode="valid"), (-YAW_ACCEL, YAW_ACCEL)),
    }
    return {
        name: float(series[np.argmax(np.abs(series))])
        for name, (series, (low, high)) in values.items()
        if series.min() <= low or series.max() >= high
    }


def _parabolas(values: np.ndarray, window: int, *, slope: bool) -> np.ndarray:
    """Returns `[T]` the values, or slopes per sample, of parabolas fitted to `window` samples.

    These are taken in the middle of each window, half a sample late if it is even, and towards
    the ends from the first and the last window.
    """
    ramp = np.arange(window) - (window - 1) / 2.0
    fit = np.linalg.pinv(np.stack([np.ones(window), ramp, ramp**2], axis=1))
    inner = np.convolve(values, fit[int(slope)][::-1], mode="valid")[1 - window % 2 :]
    at = np.stack(
        [np.zeros(window), np.ones(window), 2.0 * ramp] if slope else [ramp**0, ramp, ramp**2]
    )
    half = window // 2
    first, last = (fit @ values[:window]) @ at, (fit @ values[-window:]) @ at
    return np.concatenate([first[:half], inner, last[-half:]])


def ego_boxes(ego: np.ndarray) -> np.ndarray:
    """Returns `[T]` boxes (shapely) of rear-axle states `[T, 3+]`."""
    pose = ego[:, :3].copy()
    pose[:, :2] += float(EGO.rear_axle_to_center) * _direction(pose[:, 2])
    return boxes(pose, np.array([float(EGO.length), float(EGO.width)]))


def boxes(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Returns `[...]` boxes (shapely) with centre poses `[..., 3]` and sizes `[..., 2]`, m."""
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size[..., None, :] / 2
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + cos * corner[..., 0] - sin * corner[..., 1]
    y = pose[..., 1, None] + sin * corner[..., 0] + cos * corner[..., 1]
    return np.asarray(shapely.polygons(np.stack([x, y], axis=-1)))


def _near(raw: RawScenario, steps: slice) -> np.ndarray:
    """Returns `[N, 2]` (track, step counted from the first of `steps`) pairs near the ego."""
    offset = raw.tracks.pose[:, steps, :2] - raw.ego[steps, :2]
    near = np.linalg.norm(offset, axis=-1) < NEAR
    return np.argwhere(near & raw.tracks.valid[:, steps])


def _close_call(raw: RawScenario, window: slice) -> int | None:
    """Returns the first step at which the ego would soon hit something that is not behind it.

    nuPlan looks beside the ego only while it is between lanes; here it is always looked there.
    """
    pairs = _near(raw, window)
    track, step = pairs[:, 0], pairs[:, 1]
    ego = raw.ego[window][step]
    pose, velocity = raw.tracks.pose[:, window][track, step], raw.tracks.velocity[:, window]
    offset = pose[:, :2] - ego[:, :2]
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - ego[:, 2]
    kept = (np.cos(turn) > np.cos(TTC_ANGLE)) & (ego[:, 3] > 0.005)
    track, step, ego, pose = track[kept], step[kept], ego[kept], pose[kept]
    speed = np.linalg.norm(velocity[track, step], axis=-1)
    size = raw.tracks.size[:, window][track, step]
    first = np.inf
    for k, deviation in itertools.product(range(1, TTC_STEPS + 1), TTC_TURNS):
        then, there = ego[:, :3].copy(), pose.copy()
        then[:, 2] += deviation
        then[:, :2] += k * DT * ego[:, 3:4] * _direction(then[:, 2])
        there[:, :2] += k * DT * speed[:, None] * _direction(pose[:, 2])
        hit = shapely.intersects(ego_boxes(then), boxes(there, size))
        first = min(first, step[hit].min(initial=len(raw.ego)))
    return int(first) if first < len(raw.ego) else None


def _direction(heading: np.ndarray) -> np.ndarray:
    """Returns `[..., 2]` unit vectors."""
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)
