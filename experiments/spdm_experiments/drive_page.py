"""Recorded drives as one HTML page: map, objects, the ego's way, its plans, lost points in time."""

import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from spdm_experiments.simulate_terms import TITLES
from spdm_jax.config import VehicleParams
from spdm_jax.io.flatten import split_polylines
from spdm_jax.types import LightStatus, ObjectType, Scenario, ScenarioInfo
from spdm_jax.viz.scene_data import read_map
from spdm_jax.viz.style import MAP_COLORS, OBJECT_COLORS, OBJECT_NAMES

_MARGIN = 90.0  # map and objects around the way of the ego, m
_AREAS = ("road", "crosswalks", "route")


@dataclass(frozen=True)
class Drive:
    """One recorded run.

    Attributes:
      name: of the planner and the simulation.
      row: of the run folder.
      arrays: of the recorded run, see docs/simulate.md; leaves `[T, ...]`.
    """

    name: str
    row: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    @property
    def samples(self) -> int:
        """Real samples."""
        return int(self.arrays["samples"])


def render(
    scenes: Sequence[tuple[Scenario, ScenarioInfo, Sequence[Drive]]],
    title: str = "Drives",
    vehicle: VehicleParams | None = None,
) -> str:
    """Returns the page.

    Args:
      scenes: scenarios (NumPy leaves, in the frame of the drives) and their drives.
      title: of the page.
      vehicle: ego dimensions, if other than the default ones.
    """
    data = page_data(scenes, vehicle)
    # No "<" at all: neither a closing tag nor a comment can start inside the data.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    here = files("spdm_experiments")
    parts = {
        "title": html.escape(title),
        "data": text,
        "canvas": files("spdm_jax.viz").joinpath("canvas.js").read_text(encoding="utf-8"),
        "drive": here.joinpath("drive.js").read_text(encoding="utf-8"),
    }
    page = here.joinpath("drive.html").read_text(encoding="utf-8")
    # One pass, so that what is put in is not searched for marks again.
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], page)


def page_data(
    scenes: Sequence[tuple[Scenario, ScenarioInfo, Sequence[Drive]]],
    vehicle: VehicleParams | None = None,
) -> dict[str, Any]:
    """Returns all that the page shows, ready for JSON: cm and mrad, None where there is nothing.

    Args:
      scenes: see `render`.
      vehicle: see `render`.
    """
    vehicle = vehicle or VehicleParams()
    return {
        "vehicle": {
            "length": float(vehicle.length),
            "width": float(vehicle.width),
            "reach": float(vehicle.rear_axle_to_center),
        },
        "colors": MAP_COLORS,
        "kinds": [{"name": OBJECT_NAMES[k], "color": OBJECT_COLORS[k]} for k in ObjectType],
        "areas": list(_AREAS),
        "scenes": [_scene(*scene) for scene in scenes],
    }


def _scene(scene: Scenario, info: ScenarioInfo, drives: Sequence[Drive]) -> dict[str, Any]:
    ways = np.concatenate([d.arrays["ego"][: d.samples, :2] for d in drives]).astype(float)
    center = 0.5 * (ways.min(axis=0) + ways.max(axis=0))
    reach = float(np.ptp(ways, axis=0).max()) / 2 + _MARGIN
    world = read_map(scene, center, reach)
    lines: dict[str, list[np.ndarray]] = {
        name: [ring for area in getattr(world, name) for ring in area] for name in _AREAS
    }
    lines |= {"lane_edges": world.lane_edges, "centerlines": world.centerlines}
    shown: dict[int, int] = {}  # lane -> place among the connectors of the page
    entries = [_drive(drive, shown, center, reach) for drive in drives]
    return {
        "token": info.token,
        "type": info.scenario_type,
        # Lights change; the page draws them itself.
        "map": {
            **{name: [_whole(part, 100) for part in group] for name, group in lines.items()},
            "red": [],
            "stop_bars": [],
        },
        "connectors": _connectors(scene, list(shown)),
        "drives": entries,
    }


def _connectors(scene: Scenario, rows: Sequence[int]) -> list[list[list[int | None]]]:
    """Centre line and stop bar of lanes."""
    lanes = scene.map.lanes
    center, left, right = (
        split_polylines(line)
        for line in (lanes.centerline, lanes.left_boundary, lanes.right_boundary)
    )
    bar = lambda row: np.stack([left[row][0, :2], right[row][0, :2]])
    return [[_whole(center[row][:, :2], 100), _whole(bar(row), 100)] for row in rows]


def _drive(
    drive: Drive, connectors: dict[int, int], center: np.ndarray, reach: float
) -> dict[str, Any]:
    arrays, count = drive.arrays, drive.samples
    red = arrays["lights"][:count] == LightStatus.RED
    lights: list[list[Any]] = []
    for step in range(count):
        if step == 0 or (red[step] != red[step - 1]).any():
            lanes = np.flatnonzero(red[step]).tolist()
            lights.append([step, [connectors.setdefault(n, len(connectors)) for n in lanes]])
    plans = None
    if "plans" in arrays:
        plans = [_poses(plan) for plan in arrays["plans"][:count]]
    return {
        "name": drive.name,
        "score": _number(drive.row["total"]),
        "scores": [
            {"title": title, "value": _number(drive.row.get(name))}
            for name, title in TITLES.items()
            if drive.row.get(name) is not None
        ],
        "lost": [_lost(lost, arrays["time"][:count]) for lost in drive.row.get("lost") or ()],
        "ego": _poses(arrays["ego"][:count, :3]),
        "speed": [round(v, 2) for v in np.hypot(*arrays["ego"][:count, 3:5].T).tolist()],
        "plans": plans,
        "lights": lights,
        "objects": list(_objects(arrays, count, center, reach)),
    }


def _objects(arrays: Mapping[str, np.ndarray], count: int, center: np.ndarray, reach: float):
    """Yields the objects that come near the way of the ego."""
    poses = arrays["objects"][:count].astype(float)
    near = np.abs(poses[..., :2] - center).max(axis=-1) <= reach
    seen = arrays["object_valid"][:count]
    for row in np.flatnonzero((seen & near).any(axis=0)):
        steps = np.flatnonzero(seen[:, row])
        first, last = int(steps[0]), int(steps[-1])
        pose = np.where(seen[first : last + 1, row, None], poses[first : last + 1, row, :3], np.nan)
        yield {
            "id": str(arrays["object_id"][row]),
            "kind": int(arrays["object_type"][row]),
            "size": _whole(poses[first, row, 5:7], 100),
            "first": first,
            "pose": _poses(pose),
        }


def _lost(lost: Mapping[str, Any], time: np.ndarray) -> dict[str, Any]:
    step = None
    if lost["time"] is not None:
        step = int(np.argmin(np.abs(time - lost["time"])))
    who = f" with {lost['object_type']} {lost['object']}" if lost["object"] else ""
    return {
        "title": TITLES[lost["metric"]],
        "step": step,
        "detail": lost["detail"] + who,
        "object": lost["object"],
    }


def _poses(poses: np.ndarray) -> list[int | None]:
    """Flattens x, y, heading to cm, cm, mrad."""
    return _whole(poses, np.array([100.0, 100.0, 1000.0]))


def _whole(values: np.ndarray, factor: float | np.ndarray) -> list[int | None]:
    flat = (np.asarray(values, float) * factor).ravel().tolist()
    return [round(value) if math.isfinite(value) else None for value in flat]


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 5)
