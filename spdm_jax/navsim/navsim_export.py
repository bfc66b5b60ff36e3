"""Writes NAVSIM's metric caches as plain arrays, one .npz file per token.

This file needs NAVSIM and NumPy only, not the package that it came with. Run it with the Python of
your NAVSIM installation (v1.1 for the PDM score, v2 for the extended one):

    python navsim_export.py METRIC_CACHE OUT [--part I/N]

METRIC_CACHE is the folder that `run_metric_caching.py` has filled. Files that are there already are
kept, so the same command goes on where it stopped. A token that cannot be exported is listed with
its reason; the exit code is then 1.

Objects are stored at the 2 Hz of the logs. Between two frames, and where a frame is missing, the
cache is linear in time, so that nothing is lost.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, Iterator, Sequence  # noqa: UP035 - NAVSIM runs on Python 3.9

import numpy as np

FORMAT = "navsim-scene"
VERSION = 1
MAP_KINDS = ("ROADBLOCK", "LANE", "LANE_CONNECTOR", "INTERSECTION", "CARPARK_AREA")
OBJECT_TYPES = (
    "VEHICLE",
    "PEDESTRIAN",
    "BICYCLE",
    "TRAFFIC_CONE",
    "BARRIER",
    "CZONE_SIGN",
    "GENERIC_OBJECT",
)
NUM_AGENT_TYPES = 3
SAMPLES_PER_FRAME = 5
NUM_FRAMES = 11
RED = "red_light"


def export(cache: Any, token: str) -> dict[str, np.ndarray]:
    """Turns a metric cache into arrays.

    Args:
      cache: NAVSIM's `MetricCache`, v1 or v2.
      token: of the scene.

    Returns:
      Name -> array; docs/navsim.md lists them.

    Raises:
      ValueError: the cache holds something that the arrays cannot.
    """
    extended = hasattr(cache, "past_human_trajectory")  # v2
    ego = cache.ego_state
    vehicle = ego.car_footprint.vehicle_parameters
    arrays = {
        "format": np.array(FORMAT),
        "version": np.array(VERSION),
        "devkit": np.array("v2" if extended else "v1"),
        "token": np.array(token),
        "log_name": np.array(str(getattr(cache, "log_name", ""))),
        "ego_state": state_row(ego),
        "start_time_us": np.array(ego.time_point.time_us, np.int64),
        "vehicle_params": np.array(
            [
                vehicle.width,
                vehicle.length,
                vehicle.wheel_base,
                vehicle.rear_axle_to_center,
                vehicle.front_length,
                vehicle.rear_length,
                vehicle.cog_position_from_rear_axle,
            ],
            np.float64,
        ),
        "centerline": centerline(cache.centerline.discrete_path),
        "reference": sampled(cache.trajectory, ego.time_point),
    }
    arrays.update(map_arrays(cache.drivable_area_map, cache.route_lane_ids))
    arrays.update(object_arrays(cache.observation))
    if extended:
        arrays.update(red_lights(cache.observation))
        past = cache.past_human_trajectory.get_sampled_trajectory()
        arrays["ego_past"] = np.stack([state_row(state) for state in past])
        arrays["ego_past_us"] = np.array([state.time_point.time_us for state in past], np.int64)
        human = cache.human_trajectory
        if human is not None:  # a synthetic scene has none
            arrays["human_poses"] = np.asarray(human.poses, np.float64)
    return arrays


def state_row(state: Any) -> np.ndarray:
    """Returns `[11]` of an ego state: rear-axle pose, velocity, acceleration, steering, yaw."""
    motion = state.dynamic_car_state
    velocity, acceleration = motion.rear_axle_velocity_2d, motion.rear_axle_acceleration_2d
    pose = state.rear_axle
    values = [pose.x, pose.y, pose.heading, velocity.x, velocity.y, acceleration.x, acceleration.y]
    values += [state.tire_steering_angle, motion.tire_steering_rate]
    values += [motion.angular_velocity, motion.angular_acceleration]
    return np.array(values, np.float64)


def centerline(path: Sequence[Any]) -> np.ndarray:
    """Returns `[C, 3]` of a discrete path, headings unwrapped."""
    line = np.array([[pose.x, pose.y, pose.heading] for pose in path], np.float64)
    line[:, 2] = np.unwrap(line[:, 2])
    return line


def sampled(trajectory: Any, start: Any) -> np.ndarray:
    """Returns `[41, 3]` of a trajectory at the instants that NAVSIM's evaluation takes."""
    seconds = np.arange(0.0, 4.1, 0.1) + start.time_s
    instants = [int(second * 1e6) for second in seconds[:41]]
    first, last = trajectory.start_time.time_us, trajectory.end_time.time_us
    points = [type(start)(int(np.clip(instant, first, last))) for instant in instants]
    return np.stack([state_row(state)[:3] for state in trajectory.get_state_at_times(points)])


def rings_of(geometry: Any, what: str) -> list[np.ndarray]:
    """Returns the closed rings `[V, 2]` of a polygon or of several."""
    rings = []
    for part in getattr(geometry, "geoms", [geometry]):
        if len(part.interiors):
            raise ValueError(f"{what} has a hole, which the exported arrays cannot hold")
        rings.append(np.asarray(part.exterior.coords, np.float64)[:, :2])
    return rings


def flat(rings: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns offsets `[R + 1]` and points `[V, 2]` of rings stored back to back."""
    offsets = np.cumsum([0] + [len(ring) for ring in rings], dtype=np.int64)
    return offsets, np.concatenate([*rings, np.zeros((0, 2))])


def map_arrays(drivable: Any, route: Sequence[str]) -> dict[str, np.ndarray]:
    """Returns the polygons of the drivable map, in its order."""
    on_route, rings, owner, kinds, routed = set(route), [], [], [], []
    # The map finds polygons by identifier, but two layers may use the same one.
    for row, layer in enumerate(drivable.map_types):
        identifier = drivable.tokens[row]
        if layer.name not in MAP_KINDS:
            raise ValueError(f"map object {identifier} is of the unknown layer {layer.name}")
        mine = rings_of(drivable._geometries[row], f"{layer.name} {identifier}")
        rings += mine
        owner += [row] * len(mine)
        kinds.append(MAP_KINDS.index(layer.name))
        routed.append(layer.name.startswith("LANE") and identifier in on_route)
    offsets, points = flat(rings)
    return {
        "map_ring_offsets": offsets,
        "map_ring_xy": points,
        "map_ring_object": np.array(owner, np.int64),
        "map_kind": np.array(kinds, np.int64),
        "map_on_route": np.array(routed, bool),
    }


def object_arrays(observation: Any) -> dict[str, np.ndarray]:
    """Returns all logged objects at 2 Hz: 11 frames of a v1 cache, 9 of a v2 one."""
    maps = observation._occupancy_maps[: SAMPLES_PER_FRAME * (NUM_FRAMES - 1) + 1]
    maps = maps[::SAMPLES_PER_FRAME]
    objects = observation.unique_objects
    row = {token: number for number, token in enumerate(objects)}
    pose = np.zeros((len(maps), len(row), 3))
    valid = np.zeros((len(maps), len(row)), bool)
    types, sizes, speeds = [], [], []
    for token, thing in objects.items():
        name = thing.tracked_object_type.name
        if name not in OBJECT_TYPES:
            raise ValueError(f"object {token} is of the unknown type {name}")
        kind = OBJECT_TYPES.index(name)
        types.append(kind)
        sizes.append([thing.box.length, thing.box.width])
        moves = kind < NUM_AGENT_TYPES
        speeds.append([thing.velocity.x, thing.velocity.y] if moves else [0.0, 0.0])
    for frame, occupied in enumerate(maps):
        for number, token in enumerate(occupied.tokens):
            if token.startswith(RED):
                continue
            # Corners: front left, rear left, rear right, front right.
            corners = np.asarray(occupied._geometries[number].exterior.coords)[:4, :2]
            ahead = corners[0] - corners[1] + corners[3] - corners[2]
            pose[frame, row[token], :2] = corners.mean(axis=0)
            pose[frame, row[token], 2] = np.arctan2(ahead[1], ahead[0])
            valid[frame, row[token]] = True
    velocity = np.array(speeds, np.float64).reshape(-1, 2)
    return {
        "obj_type": np.array(types, np.int64),
        "obj_is_agent": np.array(types, np.int64) < NUM_AGENT_TYPES,
        "obj_size": np.array(sizes, np.float64).reshape(-1, 2),
        "log_pose": pose,
        # The score asks for the speed at the first occurrence only.
        "log_velocity": np.where(valid[..., None], velocity, 0.0),
        "log_valid": valid,
    }


def red_lights(observation: Any) -> dict[str, np.ndarray]:
    """Returns the connectors of the route that are red in some frame, and in which ones."""
    frames = observation._occupancy_maps_tl[::SAMPLES_PER_FRAME]
    polygons: dict[str, Any] = {}
    for tokens, geometries in frames:
        for number, token in enumerate(tokens):
            polygons.setdefault(token, geometries[number])
    owners, rings = [], []
    # Whoever touches a part touches the connector: each part may stand for itself.
    for token, polygon in polygons.items():
        mine = rings_of(polygon, token)
        owners += [token] * len(mine)
        rings += mine
    red = np.zeros((len(owners), NUM_FRAMES), bool)
    for frame, (tokens, _) in enumerate(frames):
        red[:, frame] = [token in tokens for token in owners]
    offsets, points = flat(rings)
    return {"log_red": red, "red_offsets": offsets, "red_xy": points}


def write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes a file; a reader sees none or the whole one."""
    handle, partial = tempfile.mkstemp(dir=str(path.parent), suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
        os.chmod(partial, 0o644)
        os.replace(partial, str(path))
    except BaseException:
        os.unlink(partial)
        raise


def export_all(loader: Any, out: Path, part: str = "1/1") -> Iterator[tuple[str, str]]:
    """Exports every token of a metric cache.

    Args:
      loader: NAVSIM's `MetricCacheLoader`, or anything with `tokens` and `get_from_token`.
      out: folder to fill.
      part: "I/N" takes every N-th token, from the I-th on.

    Yields:
      Token and "" for each one that was written, or the reason why it was not.
    """
    number, count = (int(text) for text in part.split("/"))
    if not 1 <= number <= count:
        raise ValueError(f"--part is {part}; it must be I/N with 1 <= I <= N")
    out.mkdir(parents=True, exist_ok=True)
    for token in sorted(loader.tokens)[number - 1 :: count]:
        path = out / f"{token}.npz"
        if path.exists():
            continue
        try:
            write(path, export(loader.get_from_token(token), token))
            yield token, ""
        except (ValueError, AttributeError, IndexError, KeyError, OSError) as error:
            yield token, f"{type(error).__name__}: {error}"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("metric_cache", type=Path, help="folder of run_metric_caching.py")
    parser.add_argument("out", type=Path, help="folder to fill, one TOKEN.npz per token")
    parser.add_argument("--part", default="1/1", help="I/N: every N-th token, from the I-th on")
    options = parser.parse_args(argv)

    from navsim.common.dataloader import (  # pyright: ignore[reportMissingImports]
        MetricCacheLoader,
    )

    written, failed = 0, 0
    for token, reason in export_all(
        MetricCacheLoader(options.metric_cache), options.out, options.part
    ):
        written += not reason
        if reason:
            failed += 1
            print(f"failed: {token}: {reason}", file=sys.stderr)
    print(f"{options.out}: {written} scenes written, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
