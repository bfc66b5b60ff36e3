"""Scenes and plans as one HTML file that needs nothing else: no server, no network, no library."""

import html
import json
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import spdm_jax
from spdm_jax.config import VehicleParams
from spdm_jax.io.scenario_file import write_atomically
from spdm_jax.results import ScenarioSet, ScoreSet
from spdm_jax.types import ObjectType
from spdm_jax.viz.plan_data import Moment, PlanView, check_plans, read_plan
from spdm_jax.viz.scene_data import (
    ObjectsView,
    ego_pose,
    read_map,
    read_objects,
    take_scene,
)
from spdm_jax.viz.style import (
    MAP_COLORS,
    NO_SCORE_COLOR,
    OBJECT_COLORS,
    OBJECT_NAMES,
    SCORE_COLORS,
    TERMS,
)

_REACH = 120.0  # half side of the map in the page, m
_SHORT = {
    "total": "Score",
    "no_at_fault_collision": "Coll",
    "drivable_area": "Area",
    "driving_direction": "Dir",
    "progress": "Prog",
    "time_to_collision": "TTC",
    "comfort": "Comf",
}
_AREAS = ("road", "crosswalks", "route")
_SHOWN = 21  # forecast samples up to the last state of a proposal
_HEIGHT = 760  # of the page within a notebook, px


def write_html(
    path: str | Path,
    scenes: ScenarioSet,
    plans: ScoreSet | Sequence[ScoreSet],
    *,
    provenance: Mapping[str, str] | None = None,
    title: str = "Driving proposals and their scores",
    index: int = 0,
    vehicle: VehicleParams | None = None,
) -> Path:
    """Writes a player for scenes and plans into one HTML file.

    It shows map, objects and all proposals coloured by score; pointing at a proposal tells what it
    lost and why, a click pins it, a slider moves ego and objects through 4 s, and several planners
    can be looked at side by side. It opens in any current browser, offline.

    Args:
      path: file to write; replaced at once if it exists.
      scenes: from `load` or `from_raw`.
      plans: what `plan` (or `score`) returned for these scenes, one or several.
      provenance: what the page says about its origin, in this order: suite, device, seed, commit.
      title: heading of the page.
      index: scene shown first.
      vehicle: ego dimensions, if other than the default ones.

    Returns:
      The path.

    Raises:
      ValueError: no plans, plans of other scenes, or a scene without any proposal.
    """
    page = render(scenes, plans, provenance=provenance, title=title, index=index, vehicle=vehicle)
    path = Path(path)
    write_atomically(path, page.encode())
    return path


def show(scenes: ScenarioSet, plans: ScoreSet | Sequence[ScoreSet], index: int = 0) -> Path | None:
    """Shows the player in a notebook; elsewhere writes it to a temporary file.

    Args:
      scenes: from `load` or `from_raw`.
      plans: see `write_html`.
      index: scene shown first.

    Returns:
      None in a notebook, else the path of the file.
    """
    shell = _notebook()
    if shell is None:
        folder = Path(tempfile.mkdtemp(prefix="spdm-"))
        return write_html(folder / "scenes.html", scenes, plans, index=index)
    from IPython.display import HTML, display  # pyright: ignore[reportMissingImports]

    page = html.escape(render(scenes, plans, index=index))
    display(
        HTML(
            f'<iframe srcdoc="{page}" style="width:100%;height:{_HEIGHT}px;border:0" '
            'title="driving proposals"></iframe>'
        )
    )
    return None


def _notebook() -> Any:
    """Returns the running notebook kernel's shell, or None in scripts and terminals."""
    import sys

    if "IPython" not in sys.modules:
        return None
    shell = sys.modules["IPython"].get_ipython()
    return shell if shell is not None and hasattr(shell, "kernel") else None


def render(
    scenes: ScenarioSet,
    plans: ScoreSet | Sequence[ScoreSet],
    *,
    provenance: Mapping[str, str] | None = None,
    title: str = "Driving proposals and their scores",
    index: int = 0,
    vehicle: VehicleParams | None = None,
) -> str:
    """Returns the page of `write_html` as text."""
    data = page_data(scenes, plans, provenance=provenance, index=index, vehicle=vehicle)
    # No "<" at all: neither a closing tag nor a comment can start inside the data.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    folder = files("spdm_jax.viz")
    page = folder.joinpath("player.html").read_text(encoding="utf-8")
    read = lambda name: folder.joinpath(name).read_text(encoding="utf-8")
    scripts = {name: read(f"{name}.js") for name in ("canvas", "draw", "player")}
    parts = {"title": html.escape(title), "data": text, **scripts}
    # One pass, so that what is put in is not searched for marks again.
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], page)


def page_data(
    scenes: ScenarioSet,
    plans: ScoreSet | Sequence[ScoreSet],
    *,
    provenance: Mapping[str, str] | None = None,
    index: int = 0,
    vehicle: VehicleParams | None = None,
) -> dict[str, Any]:
    """Returns all that the page shows, ready for JSON.

    Lengths are whole centimetres and angles whole milliradians; what is not finite is None.

    Args:
      scenes: see `write_html`.
      plans: see `write_html`.
      provenance: see `write_html`.
      index: see `write_html`.
      vehicle: see `write_html`.
    """
    given = [plans] if isinstance(plans, ScoreSet) else list(plans)
    if not given:
        raise ValueError("plans is empty; pass what `plan` returned")
    if not 0 <= index < len(scenes):
        raise ValueError(f"index is {index}; the set has {len(scenes)} scenarios, first one 0")
    for one in given:
        check_plans(scenes, one)
    vehicle = vehicle or VehicleParams()
    scene_entries: list[dict[str, Any]] = []
    planner_entries: list[list[dict[str, Any]]] = [[] for _ in given]
    names: list[str] = []
    for i in range(len(scenes)):
        entry, objects = _scene(scenes, i, vehicle)
        scene_entries.append(entry)
        views = [read_plan(one, i, objects, vehicle) for one in given]
        names = [view.name for view in views]
        for entries, view in zip(planner_entries, views, strict=True):
            entries.append(_plan(view))
    names = _distinct(names, given)
    about = {"version": f"spdm-jax {spdm_jax.__version__}", "planner": ", ".join(names)}
    about = {**about, **(provenance or {}), "scenes": str(len(scenes))}
    return {
        "about": [[str(name), str(value)] for name, value in about.items()],
        "index": index,
        "vehicle": {
            "length": float(vehicle.length),
            "width": float(vehicle.width),
            "reach": float(vehicle.rear_axle_to_center),
        },
        "terms": [{"key": k, "title": title, "short": _SHORT[k]} for k, title in TERMS.items()],
        "scale": list(SCORE_COLORS),
        "noScore": NO_SCORE_COLOR,
        "colors": MAP_COLORS,
        "kinds": [{"name": OBJECT_NAMES[k], "color": OBJECT_COLORS[k]} for k in ObjectType],
        "areas": list(_AREAS),
        "scenes": scene_entries,
        "planners": [
            {"name": name, "scenes": entries}
            for name, entries in zip(names, planner_entries, strict=True)
        ],
    }


def _distinct(names: list[str], plans: Sequence[ScoreSet]) -> list[str]:
    """Tells planners of one name apart by their number of proposals, else by their order."""
    for suffix in (
        [f" {one.scores.valid.shape[1]}" for one in plans],
        [f" ({i + 1})" for i in range(len(plans))],
    ):
        if len(set(names)) < len(names):
            names = [
                name + (end if names.count(name) > 1 else "")
                for name, end in zip(names, suffix, strict=True)
            ]
    return names


def _scene(
    scenes: ScenarioSet, index: int, vehicle: VehicleParams
) -> tuple[dict[str, Any], ObjectsView]:
    scene, info = take_scene(scenes, index), scenes.infos[index]
    ego = ego_pose(scene, 0, vehicle)
    world, objects = read_map(scene, ego[:2], _REACH), read_objects(scene, info.track_ids)
    lines: dict[str, list[np.ndarray]] = {
        name: [ring for area in getattr(world, name) for ring in area] for name in _AREAS
    }
    for name in ("lane_edges", "centerlines", "red", "stop_bars"):
        lines[name] = getattr(world, name)
    entry = {
        "token": info.token,
        "type": info.scenario_type,
        "source": info.source,
        "ego": _poses(ego),
        "map": {name: [_whole(line, 100) for line in group] for name, group in lines.items()},
        "objects": [
            {"id": name, "kind": int(kind), "pose": _poses(pose), "size": _whole(size, 100)}
            for name, kind, pose, size in zip(
                objects.ids, objects.type, objects.pose, objects.size, strict=True
            )
        ],
    }
    return entry, objects


def _plan(view: PlanView) -> dict[str, Any]:
    return {
        "status": view.status,
        "braking": view.braking,
        "best": view.best,
        "row": view.row.tolist(),
        "stage": view.stage.tolist(),
        "path": view.path.tolist(),
        "speed": _rounded(view.target_speed, 2),
        "lane": view.lane,
        "scores": {name: _rounded(values, 4) for name, values in view.scores.items()},
        "states": [_poses(states[:, :3]) for states in view.states],
        "lost": [list(told.lost) for told in view.explanations],
        "moments": [None if m is None else _moment(m) for m in view.moments],
        "forecast": [
            _poses(f) if np.isfinite(f).any() else None for f in view.forecast[:, :_SHOWN]
        ],
        "ignored": view.ignored.tolist(),
    }


def _moment(moment: Moment) -> dict[str, Any]:
    poses = {"ego": moment.ego, "ahead": moment.ahead, "pose": moment.object_pose}
    return {
        "step": moment.step,
        "label": moment.label,
        "object": moment.object,
        **{name: None if pose is None else _poses(pose) for name, pose in poses.items()},
    }


def _poses(poses: np.ndarray) -> list[int | None]:
    """Flattens x, y, heading to cm, cm, mrad."""
    return _whole(poses, np.array([100.0, 100.0, 1000.0]))


def _whole(values: np.ndarray, factor: float | np.ndarray) -> list[int | None]:
    """Flattens to whole multiples of 1 / factor; None where not finite."""
    flat = (np.asarray(values, float) * factor).ravel().tolist()
    return [round(value) if math.isfinite(value) else None for value in flat]


def _rounded(values: np.ndarray, digits: int) -> list[float | None]:
    flat = values.ravel().tolist()
    return [round(value, digits) if math.isfinite(value) else None for value in flat]
