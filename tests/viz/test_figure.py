"""The matplotlib figure: what is drawn, where, and in which colour."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest

import spdm_jax
from spdm_jax.config import VehicleParams
from spdm_jax.results import PlanSet, ScenarioSet
from spdm_jax.synthetic import make_scene, scene_names
from spdm_jax.viz import plot_scene
from spdm_jax.viz.scene_data import ego_center, ego_pose, take_scene
from spdm_jax.viz.style import TERMS

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("agg")

BEST, PADDED, NUM = 6, (1, 2), 10  # as in conftest.py
VEHICLE = VehicleParams()


def by_name(ax) -> dict:
    return {artist.get_gid(): artist for artist in ax.get_children() if artist.get_gid()}


def center_of(collection) -> np.ndarray:
    return collection.get_paths()[0].vertices[:4].mean(axis=0)


@pytest.mark.parametrize("index, kind", list(enumerate(scene_names())))
def test_every_scene_shows_map_objects_and_proposals(
    scenes: ScenarioSet, plans: PlanSet, index: int, kind: str
):
    ax = plot_scene(scenes, plans, index)
    artists = by_name(ax)
    always = {"road", "route", "lane_edges", "centerlines", "ego", "proposals", "chosen"}
    assert always | {"end_points", "chosen_end", "failure", "failure_ego", "scale_bar"} <= {
        *artists
    }
    now = int(scenes.batch.num_history[index])
    observed = int(scenes.batch.tracks.valid[index, :, now].sum())
    assert ("objects" in artists) == (observed > 0)
    assert len(artists["objects"].get_paths() if observed else []) == observed
    assert len(artists["proposals"].get_segments()) == NUM - len(PADDED)
    assert len(artists["end_points"].get_offsets()) == NUM - len(PADDED)
    best = np.stack([plans.tracked.x[index, BEST], plans.tracked.y[index, BEST]], -1)
    np.testing.assert_array_equal(artists["chosen"].get_xydata(), best)
    ego = ego_pose(take_scene(scenes, index), 0, VEHICLE)[:2]
    np.testing.assert_allclose(center_of(artists["ego"]), ego, atol=1e-6)
    assert kind in ax.get_title() and "8 proposals, best 1.000" in ax.get_title()


def test_red_lights_are_shown_where_they_are(scenes: ScenarioSet):
    for index, kind in enumerate(scene_names()):
        artists = by_name(plot_scene(scenes, None, index))
        assert ("red_stop_bars" in artists) == ("red_lanes" in artists) == (kind == "red_light")


def test_axes_are_equal_and_close_to_the_ego(scenes: ScenarioSet, plans: PlanSet):
    for index in range(len(scenes)):
        ax = plot_scene(scenes, plans, index)
        (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
        ego = ego_pose(take_scene(scenes, index), 0, VEHICLE)
        assert ax.get_aspect() == 1 and right - left == pytest.approx(high - low)
        assert 60 <= right - left <= 120
        assert left < ego[0] < right and low < ego[1] < high
        assert max(abs(v) for v in (left - ego[0], right - ego[0])) <= 120


def test_colours_follow_the_chosen_term(scenes: ScenarioSet, plans: PlanSet):
    total = by_name(plot_scene(scenes, plans, 1))
    progress = by_name(plot_scene(scenes, plans, 1, color_by="progress"))
    comfort = by_name(plot_scene(scenes, plans, 1, color_by="comfort"))
    assert len({tuple(c) for c in progress["proposals"].get_colors()}) == NUM - len(PADDED)
    assert len({tuple(c) for c in comfort["proposals"].get_colors()}) == 1
    assert not np.array_equal(total["proposals"].get_colors(), progress["proposals"].get_colors())
    bars = [ax.get_ylabel() for ax in plot_scene(scenes, plans, 1).figure.axes[1:]]
    assert bars == [TERMS["total"]]


def test_the_scale_brightens_evenly():
    from matplotlib.colors import LinearSegmentedColormap

    from spdm_jax.viz.style import SCORE_COLORS

    scale = LinearSegmentedColormap.from_list("score", list(SCORE_COLORS))
    lightness = scale(np.linspace(0, 1, 50))[:, :3] ** 2.2 @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness ** (1 / 3)) > 0).all()


def test_shorter_proposals_lie_on_top(scenes: ScenarioSet, plans: PlanSet):
    segments = by_name(plot_scene(scenes, plans, 0))["proposals"].get_segments()
    lengths = [np.hypot(*np.diff(s, axis=0).T).sum() for s in segments]
    assert lengths == sorted(lengths, reverse=True)


def test_a_score_that_is_no_number_is_grey(scenes: ScenarioSet, plans: PlanSet):
    total = np.array(plans.scores.total)
    total[0, 0] = np.nan
    ax = plot_scene(scenes, replace(plans, scores=plans.scores.replace(total=total)), 0)
    colors = by_name(ax)["proposals"].get_colors()
    assert sum(np.allclose(c, matplotlib.colors.to_rgba("#8a8f98")) for c in colors) == 1
    assert "failed" in ax.get_title()


def test_the_failure_is_marked_with_rule_and_time(scenes: ScenarioSet, plans: PlanSet):
    index = scene_names().index("straight")
    artists = by_name(plot_scene(scenes, plans, index))
    text = artists["failure"].get_text()
    assert "t = 1.1 s" in text and "best failing proposal" in text
    assert any(name in text for name in scenes.infos[index].track_ids)
    assert "failure_object" in artists
    dashed = artists["failure_ego"].get_linestyles()[0][1]
    assert dashed is not None
    lost = np.array(plans.scores.drivable_area)
    lost[:, BEST] = 0
    failing = replace(plans, scores=plans.scores.replace(drivable_area=lost))
    artists = by_name(plot_scene(scenes, failing, index))
    assert "(chosen proposal" in artists["failure"].get_text()
    assert artists["failure_ego"].get_linestyles()[0][1] is None
    assert "failure_object" not in artists


def test_steps_move_ego_and_objects(scenes: ScenarioSet, plans: PlanSet):
    index = scene_names().index("platoon")
    start, later = (by_name(plot_scene(scenes, plans, index, step=s)) for s in (0, 20))
    rear = [getattr(plans.tracked, n)[index, BEST, 20] for n in ("x", "y", "heading")]
    np.testing.assert_allclose(
        center_of(later["ego"]), ego_center(np.array(rear), VEHICLE)[:2], atol=1e-6
    )
    assert np.hypot(*(center_of(later["objects"]) - center_of(start["objects"]))) > 0.5


def test_the_recording_is_drawn_without_plans(scenes: ScenarioSet):
    index = scene_names().index("platoon")
    ax = plot_scene(scenes, None, index, step=30)
    artists = by_name(ax)
    assert not {"proposals", "chosen", "failure", "forecast"} & {*artists}
    ego = ego_pose(take_scene(scenes, index), 30, VEHICLE)[:2]
    np.testing.assert_allclose(center_of(artists["ego"]), ego, atol=1e-6)
    assert "t = 3.0 s" in ax.get_title()


def test_axes_of_the_caller_are_used_and_pyplot_is_left_alone(scenes: ScenarioSet, plans: PlanSet):
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    axes = matplotlib.figure.Figure().subplots(1, 2)
    assert plot_scene(scenes, plans, 0, axes[1]) is axes[1]
    assert not by_name(axes[0]) and "proposals" in by_name(axes[1])
    plot_scene(scenes, plans, 0)
    assert pyplot.get_fignums() == before


@pytest.mark.parametrize("form, start", [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")])
def test_files_for_print(scenes: ScenarioSet, plans: PlanSet, form: str, start: bytes):
    file = BytesIO()
    figure = plot_scene(scenes, plans, scene_names().index("red_light")).get_figure(root=True)
    assert figure is not None
    figure.savefig(file, format=form)
    content = file.getvalue()
    assert content.startswith(start) and len(content) > 10_000
    if form == "svg":
        assert all(f'id="{name}"'.encode() in content for name in ("route", "proposals", "chosen"))


def test_wrong_arguments_are_named(scenes: ScenarioSet, plans: PlanSet):
    with pytest.raises(ValueError, match=r"color_by is 'speed'; it must be one of total, "):
        plot_scene(scenes, plans, color_by="speed")
    with pytest.raises(ValueError, match=r"step is 41; this scene can be drawn at steps 0 to 40"):
        plot_scene(scenes, plans, step=41)
    with pytest.raises(ValueError, match=r"step is 10000; this scene can be drawn at steps 0 to"):
        plot_scene(scenes, step=10_000)
    with pytest.raises(ValueError, match=r"index is 12"):
        plot_scene(scenes, plans, 12)


@pytest.mark.slow
def test_real_plans_can_be_drawn():
    scene = spdm_jax.from_raw([make_scene("parked_car")])
    result = spdm_jax.plan(scene, spdm_jax.pdm_closed(3))
    artists = by_name(plot_scene(scene, result))
    assert len(artists["proposals"].get_segments()) == 3
