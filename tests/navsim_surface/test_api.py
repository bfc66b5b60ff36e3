"""NAVSIM's profiles as a user calls them: score, explain, tables, errors."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import small_road as roads
import spdm_jax
from navsim_stand_in import straight
from spdm_jax import NavsimScoreSet, NavsimSet
from spdm_jax.config import PlannerConfig
from spdm_jax.navsim import evaluate
from spdm_jax.navsim.results import COMPONENTS

# Keeps its speed; runs the red light; stops hard; grazes the parked car.
DRIVES = np.concatenate([straight(8.0), straight(16.0), straight(0.5), straight(8.0, left=-0.6)])


def run(frames: NavsimSet, trajectories: Any = DRIVES, **options: Any) -> NavsimScoreSet:
    return spdm_jax.score(frames, trajectories, profile="navsim2", precision="f64", **options)


def same(one: NavsimScoreSet, other: NavsimScoreSet, tolerance: float = 1e-9) -> None:
    for name in COMPONENTS:
        got, want = getattr(one, name), getattr(other, name)
        np.testing.assert_allclose(got, want, rtol=0, atol=tolerance, err_msg=name)


@pytest.fixture(scope="module")
def result(frames: NavsimSet) -> NavsimScoreSet:
    return run(frames)


def test_scores_are_what_the_scene_was_made_for(result: NavsimScoreSet):
    assert result.total.shape == (2, 4) and result.status == ["ok", "ok"]
    assert result.total[0, 0] == pytest.approx(1.0)
    assert result.traffic_light[0].tolist() == [1, 0, 1, 1]
    assert result.no_at_fault_collision[0].tolist() == [1, 1, 1, 0]
    assert result.total[0, 1] == result.total[0, 3] == 0
    assert result.comfort[0, 2] == 0 and 0 < result.total[0, 2] < 1
    assert result.progress[0, 2] == pytest.approx(
        result.progress_raw[0, 2] / result.progress_raw[0, 0], abs=1e-6
    )
    assert not result.scores.has_extended_comfort.any()
    with pytest.raises(AttributeError, match="no attribute 'speed'"):
        result.speed  # noqa: B018


def test_lost_terms_are_named_with_their_time(result: NavsimScoreSet):
    assert result.explain(0, 0).lost == () and result.explain(0, 0).rule is None
    light = result.explain(0, 1)
    assert light.rule == "traffic_light" and light.step == result.scores.red_light_index[0, 1]
    at = 0.1 * result.scores.red_light_index[0, 1]
    assert f"on a red connector at {at:.1f} s: traffic_light 0" in light.lost
    hit = result.explain(0, 3)
    assert hit.rule == "no_at_fault_collision" and str(hit).startswith("scene fast, proposal 3: 0")
    assert any(line.startswith("less than 1 s to a collision at") for line in hit.lost)
    stop = "\n".join(result.explain(0, 2).lost)
    assert "uncomfortable: longitudinal acceleration" in stop and "m of progress" in stop


def test_what_the_human_lost_as_well_is_said(frames: NavsimSet, result: NavsimScoreSet):
    scores = result.scores
    raw = scores.raw.replace(lane_keeping=np.zeros_like(scores.raw.lane_keeping))
    changed = dataclasses.replace(result, scores=scores.replace(raw=raw))
    assert changed.explain(0, 0).lost == (
        "more than 0.5 m beside the centreline for 2 s; the human failed here too, so it costs "
        "nothing",
    )


def test_vocabulary_and_sets_dense_poses_and_frames_agree(
    frames: NavsimSet, result: NavsimScoreSet
):
    same(run(frames, np.stack([DRIVES, DRIVES])), result)
    dense = np.concatenate([np.zeros_like(DRIVES[:, :1]), DRIVES], axis=1)
    at = np.linspace(0, 8, 41)
    dense = np.stack([[np.interp(at, np.arange(9), c) for c in d.T] for d in dense]).swapaxes(1, 2)
    same(run(frames, dense, dt=0.1), result)
    moved = np.stack([DRIVES, DRIVES])
    for row, frame in enumerate(frames.frames):
        moved[row, ..., :2] += frame.origin + np.array([frame.ego.x, frame.ego.y])
    same(run(frames, moved, frame="global"), result)


def test_blocks_do_not_matter(
    frames: NavsimSet, result: NavsimScoreSet, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(evaluate, "BLOCK_SIZES", (16,))
    many = run(frames, np.tile(DRIVES, (5, 1, 1)))
    assert many.total.shape == (2, 20) and many.scores.oncoming.shape == (2, 20, 41)
    np.testing.assert_array_equal(many.total, np.tile(result.total, (1, 5)))


def test_previous_plans(frames: NavsimSet, result: NavsimScoreSet):
    steady = straight(8.0)[0]
    swerves = steady + np.array([0, 1.5, 0.4]) * (-1.0) ** np.arange(8)[:, None]
    found = run(frames, previous=np.stack([steady, np.full((8, 3), np.nan)]))
    assert found.scores.has_extended_comfort.tolist() == [True, False]
    np.testing.assert_array_equal(found.total[1], result.total[1])
    assert found.extended_comfort[0, 0] == 1 and found.total[0, 0] == pytest.approx(1)
    found = run(frames, previous=np.stack([swerves, steady]))
    assert found.extended_comfort[0, 0] == 0
    assert found.total[0, 0] == pytest.approx(14 / 16)
    assert found.total_without_extended_comfort[0, 0] == pytest.approx(1)
    assert "differs from the plan of the frame before: extended_comfort 0" in (
        found.explain(0, 0).lost
    )


def test_table(frames: NavsimSet, result: NavsimScoreSet):
    table = dataclasses.replace(result, failures=[spdm_jax.Failure("gone", "why")]).to_table()
    assert table.height == 9 and {"token", "proposal", *COMPONENTS} <= set(table.columns)
    row = table.filter(token="fast", proposal=1).to_dicts()[0]
    assert row["profile"] == "navsim2" and row["red_light_time"] == pytest.approx(
        0.1 * result.scores.red_light_index[0, 1]
    )
    assert row["collision_time"] == float("inf")
    assert table.row(8, named=True)["reason"] == "why"


@pytest.mark.parametrize(
    "options, text",
    [
        ({"tracker": "none"}, "tracker does not apply to NAVSIM's profiles"),
        ({"config": PlannerConfig()}, "config does not apply"),
        ({"forecast": np.zeros(3)}, "forecast does not apply"),
        ({"trajectories": DRIVES[:, :6]}, "6 steps at 0.1 s"),
        ({"trajectories": DRIVES * np.nan}, r"trajectories\[0, 0, 0, 0\] is nan"),
        ({"trajectories": DRIVES[None]}, "trajectories holds 1 scenes, the scenario set 2"),
        ({"previous": DRIVES}, r"previous has shape \(4, 8, 3\); expected \[2, 8, 3\]"),
        ({"profile": "navsim3"}, "profile is 'navsim3'; it must be one of tuplan, navsim1"),
        ({"profile": "navsim1"}, "frame fast: exported with NAVSIM v2, .* not navsim1"),
        ({"profile": "tuplan"}, "the scenes are NAVSIM's frames; pass profile='navsim1'"),
    ],
)
def test_bad_input_is_refused(frames: NavsimSet, options: dict[str, Any], text: str):
    given = {"trajectories": DRIVES, "profile": "navsim2", **options}
    with pytest.raises(ValueError, match=text):
        spdm_jax.score(frames, **given)


def test_previous_plan_that_is_known_in_part(frames: NavsimSet):
    plans = np.stack([straight(8.0)[0]] * 2)
    plans[1, 3] = np.nan
    with pytest.raises(ValueError, match=r"previous\[1\] has values that are not finite"):
        run(frames, previous=plans)


def test_tuplan_knows_no_previous_plan():
    scenes = spdm_jax.from_raw([roads.road()], padding=roads.PADDING)
    with pytest.raises(ValueError, match="previous is for profile='navsim2'"):
        spdm_jax.score(scenes, DRIVES, dt=0.5, previous=DRIVES[:1])  # pyright: ignore[reportCallIssue, reportArgumentType]
