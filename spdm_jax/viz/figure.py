"""A scene with its scored proposals as a matplotlib figure, for papers and notebooks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from spdm_jax.config import DT, NUM_STATES, VehicleParams
from spdm_jax.results import ScenarioSet, ScoreSet
from spdm_jax.types import ObjectType, Scenario, ScenarioInfo
from spdm_jax.viz.plan_data import (
    Moment,
    PlanView,
    check_plans,
    object_poses,
    read_plan,
    telling_proposal,
)
from spdm_jax.viz.scene_data import (
    MapView,
    ObjectsView,
    Rings,
    box_corners,
    ego_center,
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_REACH = 60.0  # half side of the picture, m
_MIN_REACH = 30.0
_MARGIN = 15.0  # around the proposals, m
_SHOWN = (NUM_STATES + 1) // 2  # forecast samples up to the last state of a proposal

# Drawing order, bottom to top.
_ROAD, _ROUTE, _PAINT, _LIGHTS, _OBJECTS, _LINES, _CHOSEN, _EGO, _GHOSTS, _TEXT = range(1, 11)


def plot_scene(
    scenes: ScenarioSet,
    plans: ScoreSet | None = None,
    index: int = 0,
    ax: Axes | None = None,
    *,
    step: int = 0,
    color_by: str = "total",
    vehicle: VehicleParams | None = None,
) -> Axes:
    """Draws map, objects with their forecast, and all proposals coloured by score.

    The chosen proposal is thick. Where it breaks a rule, ego and object are outlined at that
    moment; where it breaks none, the best proposal that does is shown that way, dashed. Every
    group of artists carries a name (`get_gid`), which SVG files keep: "road", "route", "proposals",
    "chosen", "objects", "forecast", "ego", "failure", ...

    Args:
      scenes: from `load` or `from_raw`.
      plans: from `plan`, or from `score`; without them the recording alone is drawn.
      index: row of the scene.
      ax: where to draw; a new figure if None.
      step: moment at which ego and objects are drawn, 0.1 s each: along the chosen proposal and
        the forecast where there are plans (0 to 40), else along the recording.
      color_by: term of the score: "total", "progress", "comfort", ...
      vehicle: ego dimensions, if other than the default ones.

    Returns:
      The axes, 30 to 60 m around the proposals; save with `ax.figure.savefig`.

    Raises:
      ImportError: matplotlib is not installed (`pip install "spdm-jax[plot]"`).
      ValueError: no such row, step or term, or plans of other scenes.
    """
    if color_by not in TERMS:
        raise ValueError(f"color_by is {color_by!r}; it must be one of {', '.join(TERMS)}")
    vehicle = vehicle or VehicleParams()
    scene, info = take_scene(scenes, index), scenes.infos[index]
    objects = read_objects(scene, info.track_ids)
    view = None
    if plans is not None:
        check_plans(scenes, plans)
        view = read_plan(plans, index, objects, vehicle)
    _check_step(scene, step, view)

    if view is None:
        ego = ego_pose(scene, step, vehicle)
        objects = read_objects(scene, info.track_ids, step)
        poses = objects.pose
    else:
        ego = ego_center(view.states[view.best, step, :3], vehicle)
        poses = object_poses(objects, view.forecast, step)
    center, reach = _window(ego, view)
    seen = 0 if view is not None else step  # the plan knows the lights of iteration 0 only
    world = read_map(scene, center, reach, seen)

    if ax is None:
        from matplotlib.figure import Figure

        # Not through pyplot: nothing to close, and no window opens.
        ax = Figure(figsize=(7.2, 6.4), layout="constrained").add_subplot()
    _draw_map(ax, world)
    _draw_objects(ax, objects, poses, view)
    if view is not None:
        _draw_proposals(ax, view, color_by)
    _boxes(ax, ego[None], vehicle.length, vehicle.width, "ego", _EGO, MAP_COLORS["ego"], "white")
    _nose(ax, ego, vehicle)
    telling = None if view is None else telling_proposal(view)
    if view is not None and telling is not None:
        _draw_failure(ax, view, telling, objects, vehicle, center, reach)
    _finish(ax, center, reach, info, view, step)
    _legend(ax, objects, poses, center, reach, view, world)
    return ax


def _check_step(scene: Scenario, step: int, view: PlanView | None) -> None:
    last = NUM_STATES - 1
    if view is None:
        last = len(np.asarray(scene.ego_valid)) - 1 - int(scene.num_history)
    if not 0 <= step <= last:
        raise ValueError(f"step is {step}; this scene can be drawn at steps 0 to {last}")
    if view is None and not scene.ego_valid[int(scene.num_history) + step]:
        raise ValueError(f"step is {step}; the ego was not recorded at that step")


def _window(ego: np.ndarray, view: PlanView | None) -> tuple[np.ndarray, float]:
    """Centre and half side of the picture: all proposals, as far as they fit."""
    if view is None:
        return ego[:2], _MAX_REACH
    points = np.concatenate([view.states[..., :2].reshape(-1, 2), ego[None, :2]])
    points = points[np.isfinite(points).all(axis=1)]
    points = np.clip(points, ego[:2] - _MAX_REACH, ego[:2] + _MAX_REACH)
    low, high = points.min(axis=0), points.max(axis=0)
    reach = float(np.clip(0.5 * np.max(high - low) + _MARGIN, _MIN_REACH, _MAX_REACH))
    return 0.5 * (low + high), reach


def _draw_map(ax: Axes, world: MapView) -> None:
    color = MAP_COLORS
    _areas(ax, world.road, "road", _ROAD, color["road"], color["road_edge"])
    _areas(ax, world.route, "route", _ROUTE, color["route"], "none")
    _areas(ax, world.crosswalks, "crosswalks", _PAINT, color["crosswalk"], color["road_edge"], "//")
    _lines(ax, world.lane_edges, "lane_edges", _PAINT, colors=color["lane"], linewidths=1.1)
    _lines(
        ax,
        world.centerlines,
        "centerlines",
        _PAINT,
        colors=color["centerline"],
        linewidths=0.6,
        linestyles=(0, (4, 4)),
    )
    _lines(ax, world.red, "red_lanes", _LIGHTS, colors=color["red"], linewidths=1.2, alpha=0.55)
    _lines(ax, world.stop_bars, "red_stop_bars", _LIGHTS, colors=color["red"], linewidths=3.0)


def _areas(
    ax: Axes, areas: list[Rings], gid: str, order: int, face: str, edge: str, hatch: str = ""
) -> None:
    if not areas:
        return
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path

    paths = [Path.make_compound_path(*(Path(ring, closed=True) for ring in a)) for a in areas]
    patch = PathCollection(
        paths, facecolor=face, edgecolor=edge, linewidth=0.7, zorder=order, hatch=hatch
    )
    patch.set_gid(gid)
    ax.add_collection(patch, autolim=False)


def _lines(ax: Axes, lines: Iterable[np.ndarray], gid: str, order: int, **look) -> None:
    lines = list(lines)
    if not lines:
        return
    from matplotlib.collections import LineCollection

    group = LineCollection(lines, zorder=order, **look)
    group.set_capstyle("round")
    group.set_gid(gid)
    ax.add_collection(group, autolim=False)


def _boxes(ax: Axes, pose, length, width, gid: str, order: int, face, edge, **look) -> None:
    from matplotlib.collections import PolyCollection

    corners = box_corners(
        pose, np.broadcast_to(length, len(pose)), np.broadcast_to(width, len(pose))
    )
    group = PolyCollection(
        list(corners), facecolors=face, edgecolors=edge, zorder=order, **{"linewidths": 0.7, **look}
    )
    group.set_gid(gid)
    ax.add_collection(group, autolim=False)


def _nose(ax: Axes, ego: np.ndarray, vehicle: VehicleParams) -> None:
    """A small triangle that tells the ego's front from its rear."""
    from matplotlib.patches import Polygon

    length, width = 0.5 * float(vehicle.length), 0.5 * float(vehicle.width)
    shape = np.array(
        [[0.8 * length, 0.0], [0.2 * length, 0.6 * width], [0.2 * length, -0.6 * width]]
    )
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    points = ego[:2] + shape @ np.array([[cos, sin], [-sin, cos]])
    ax.add_patch(Polygon(points, facecolor="white", edgecolor="none", zorder=_EGO + 0.1))


def _draw_objects(ax: Axes, objects: ObjectsView, poses: np.ndarray, view: PlanView | None) -> None:
    real = np.isfinite(poses).all(axis=1)
    if real.any():
        colors = [OBJECT_COLORS[ObjectType(int(kind))] for kind in objects.type[real]]
        size = objects.size[real]
        ink = MAP_COLORS["ink"]
        _boxes(ax, poses[real], size[:, 0], size[:, 1], "objects", _OBJECTS, colors, ink)
    if view is None:
        return
    futures = [f[np.isfinite(f).all(axis=1), :2] for f in view.forecast[:, :_SHOWN]]
    moving = [i for i, f in enumerate(futures) if len(f) > 1 and np.ptp(f, axis=0).max() > 0.5]
    colors = [OBJECT_COLORS[ObjectType(int(objects.type[i]))] for i in moving]
    _lines(ax, [futures[i] for i in moving], "forecast", _OBJECTS, colors=colors, linewidths=1.0)


def _draw_proposals(ax: Axes, view: PlanView, color_by: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patheffects import withStroke

    scale = LinearSegmentedColormap.from_list("score", list(SCORE_COLORS))
    scale = scale.with_extremes(bad=NO_SCORE_COLOR)
    values = np.ma.masked_invalid(view.scores[color_by])
    colors = scale(values)
    xy = view.states[..., :2]
    # Proposals of one path lie on each other; the shorter ones go on top so that each shows its
    # own colour as far as it reaches alone.
    way = np.nansum(np.hypot(*np.moveaxis(np.diff(xy, axis=1), -1, 0)), axis=1)
    order = np.argsort(-way, kind="stable")
    widths = 0.8 + 0.8 * values.filled(0)  # dark lines of low scores would dominate otherwise
    _lines(ax, xy[order], "proposals", _LINES, colors=colors[order], linewidths=widths[order])
    ends = ax.scatter(*xy[order, -1].T, c=colors[order], s=11, linewidths=0, zorder=_LINES + 0.2)
    ends.set_gid("end_points")
    ink = MAP_COLORS["ink"]
    look = {"color": colors[view.best], "zorder": _CHOSEN}
    (line,) = ax.plot(*xy[view.best].T, lw=2.6, gid="chosen", **look)
    line.set_path_effects([withStroke(linewidth=4.2, foreground=ink)])
    ax.plot(*xy[view.best, -1], "o", ms=6, mec=ink, mew=0.8, gid="chosen_end", **look)
    figure = ax.get_figure()
    assert figure is not None
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, 1), scale), ax=ax, shrink=0.75, pad=0.02, aspect=28
    )
    bar.set_label(TERMS[color_by])
    bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue]


def _draw_failure(
    ax: Axes,
    view: PlanView,
    row: int,
    objects: ObjectsView,
    vehicle: VehicleParams,
    center: np.ndarray,
    reach: float,
) -> None:
    moment = view.moments[row]
    assert moment is not None
    look = {"linewidths": 1.6, "linestyles": "-" if row == view.best else (0, (3, 1.6))}
    red, long, wide = MAP_COLORS["failure"], vehicle.length, vehicle.width
    if row != view.best:
        way = view.states[row, :, :2]
        _lines(ax, [way], "failing_proposal", _GHOSTS, colors=red, linewidths=1.0, linestyles=":")
    _boxes(ax, moment.ego[None], long, wide, "failure_ego", _GHOSTS, "#ffffffb0", red, **look)
    if moment.ahead is not None:
        thin = {"linewidths": 1.0, "linestyles": ":"}
        _boxes(ax, moment.ahead[None], long, wide, "failure_ahead", _GHOSTS, "none", red, **thin)
    if moment.object >= 0 and moment.object_pose is not None:
        color = OBJECT_COLORS[ObjectType(int(objects.type[moment.object]))]
        length, width = objects.size[moment.object]
        pose = moment.object_pose[None]
        _boxes(ax, pose, length, width, "failure_object", _GHOSTS, color + "b0", red, **look)
    _failure_text(ax, view, row, moment, objects, center, reach)


def _failure_text(
    ax: Axes,
    view: PlanView,
    row: int,
    moment: Moment,
    objects: ObjectsView,
    center: np.ndarray,
    reach: float,
) -> None:
    text = moment.label
    if moment.object >= 0:
        kind = OBJECT_NAMES[ObjectType(int(objects.type[moment.object]))]
        name = objects.ids[moment.object]
        text += f"\n{kind} {name if len(name) <= 12 else name[:8] + '…'}"
    whose = "chosen" if row == view.best else "best failing"
    text += f"\n({whose} proposal, score {view.scores['total'][row]:.2f})"
    at = moment.ego if moment.object_pose is None else moment.object_pose
    corner = _free_corner(view, objects, at, center, reach)
    note = ax.annotate(
        text,
        (float(at[0]), float(at[1])),
        xytext=(0.5 + 0.48 * corner[0], 0.5 + 0.48 * corner[1]),
        textcoords="axes fraction",
        ha="right" if corner[0] > 0 else "left",
        va="top" if corner[1] > 0 else "bottom",
        fontsize=8,
        color=MAP_COLORS["ink"],
        zorder=_TEXT,
        bbox={"boxstyle": "round,pad=0.35", "fc": "white", "ec": MAP_COLORS["failure"], "lw": 0.9},
        arrowprops={"arrowstyle": "-", "color": MAP_COLORS["failure"], "lw": 0.9},
        annotation_clip=False,
    )
    note.set_gid("failure")
    note.set_in_layout(False)


def _free_corner(
    view: PlanView, objects: ObjectsView, at: np.ndarray, center: np.ndarray, reach: float
) -> tuple[int, int]:
    """Corner of the picture where a text hides least; the lower left one has the scale bar."""
    points = np.concatenate([view.states[..., :2].reshape(-1, 2), objects.pose[:, :2]])

    def cost(corner: tuple[int, int]) -> tuple[int, float]:
        middle = center + reach * np.array([0.6, 0.85]) * corner
        hidden = (np.abs(points - middle) < reach * np.array([0.4, 0.15])).all(axis=1)
        return int(hidden.sum()), float(np.hypot(*(middle - at[:2])))

    return min(((1, 1), (1, -1), (-1, 1)), key=cost)


def _finish(
    ax: Axes,
    center: np.ndarray,
    reach: float,
    info: ScenarioInfo,
    view: PlanView | None,
    step: int,
) -> None:
    ax.set_aspect("equal")
    ax.set_xlim(center[0] - reach, center[0] + reach)
    ax.set_ylim(center[1] - reach, center[1] + reach)
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)
        spine.set_color(MAP_COLORS["road_edge"])
    title = f"{info.scenario_type} ({info.token})"
    if view is not None:
        title += (
            f"\n{view.name}: {len(view.row)} proposals, best {view.scores['total'][view.best]:.3f}"
        )
        title += ", emergency brake" if view.braking else ""
        title += "" if view.status == "ok" else f", {view.status}"
    if step:
        title += f", t = {DT * step:.1f} s"
    ax.set_title(title, fontsize=10)
    # A scale bar instead of coordinates, which mean nothing outside the local frame.
    size = 10 if reach < 45 else 20
    x, y = center - 0.93 * reach
    ax.plot([x, x + size], [y, y], color=MAP_COLORS["ink"], lw=2, zorder=_TEXT, gid="scale_bar")
    ax.text(x + size / 2, y + 0.02 * reach, f"{size} m", ha="center", va="bottom", fontsize=8)


def _legend(
    ax: Axes,
    objects: ObjectsView,
    poses: np.ndarray,
    center: np.ndarray,
    reach: float,
    view: PlanView | None,
    world: MapView,
) -> None:
    """Names what can be seen in the picture, below it."""
    from matplotlib.artist import Artist
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ink = MAP_COLORS["ink"]
    entries: list[Artist] = [
        Patch(fc=MAP_COLORS["ego"], ec="white", label="ego"),
        Patch(fc=MAP_COLORS["route"], label="route"),
    ]
    near = (np.abs(poses[:, :2] - center) < reach).all(axis=1)
    for kind in sorted({int(k) for k in objects.type[near]}):
        color, name = OBJECT_COLORS[ObjectType(kind)], OBJECT_NAMES[ObjectType(kind)]
        entries.append(Patch(fc=color, ec=ink, lw=0.7, label=name))
    if world.crosswalks:
        edge = MAP_COLORS["road_edge"]
        entries.append(Patch(fc=MAP_COLORS["crosswalk"], ec=edge, hatch="///", label="crosswalk"))
    if world.red:
        entries.append(Line2D([], [], color=MAP_COLORS["red"], lw=2.5, label="red light"))
    if view is not None:
        entries.append(
            Line2D([], [], color=SCORE_COLORS[4], lw=1.3, marker="o", ms=3, label="proposal")
        )
        entries.append(Line2D([], [], color=ink, lw=4.5, label="chosen"))
        if telling_proposal(view) is not None:
            entries.append(
                Patch(fc="white", ec=MAP_COLORS["failure"], lw=1.4, label="where a rule is broken")
            )
    ax.legend(
        handles=entries,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.01),
        ncols=min(len(entries), 5),
        fontsize=8,
        frameon=False,
        handlelength=1.6,
        columnspacing=1.4,
    )
