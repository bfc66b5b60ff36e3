"""The public functions: load, plan, score, explanations, tables."""

import dataclasses
from pathlib import Path as FilePath
from typing import Any

import jax
import numpy as np
import pytest

import small_road as roads
import spdm_jax
from spdm_jax.config import PlannerConfig, spdm
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.results import PlanSet, ScenarioSet, ScoreSet
from spdm_jax.types import EgoState, SubScores

STEPS = np.arange(41) * 0.1
NUM = 8


def straight(speeds: np.ndarray, dt: float = 0.1, steps: int = 41) -> np.ndarray:
    """`[P, T, 3]` straight ahead in the ego frame."""
    out = np.zeros((len(speeds), steps, 3))
    out[..., 0] = speeds[:, None] * dt * np.arange(steps)
    return out


TRAJECTORIES = straight(np.linspace(0, 14, NUM))
RAW = [
    roads.road(things=[roads.parked(25.0)], token="blocked"),
    roads.moved(roads.road(token="free"), 0.6, (3.3e5 + 0.2, 4.7e6)),
]


@pytest.fixture(scope="module")
def scenes() -> ScenarioSet:
    """A blocked lane, and a free one somewhere else in another direction."""
    return spdm_jax.from_raw(RAW, padding=roads.PADDING)


@pytest.fixture(scope="module")
def plans(scenes: ScenarioSet) -> PlanSet:
    return spdm_jax.plan(scenes, spdm(20))


def run(scenes: ScenarioSet, trajectories: Any = TRAJECTORIES, **options: Any) -> ScoreSet:
    return spdm_jax.score(scenes, trajectories, precision="f64", **options)


def standing(scenes: ScenarioSet) -> np.ndarray:
    """`[B, A, 41, 3]` the parked car where it is, nobody else."""
    tracks, at = scenes.batch.tracks, int(scenes.batch.num_history[0])
    forecast = np.full((2, tracks.valid.shape[1], 41, 3), np.nan)
    forecast[0, 0] = tracks.x[0, 0, at], tracks.y[0, 0, at], tracks.heading[0, 0, at]
    return forecast


def same(one: ScoreSet, other: ScoreSet, tolerance: float = 1e-9) -> None:
    for name in SubScores.__dataclass_fields__:
        a, b = getattr(one.scores, name), getattr(other.scores, name)
        if a.dtype.kind == "f":
            np.testing.assert_allclose(a, b, atol=tolerance, err_msg=name)
        else:
            np.testing.assert_array_equal(a, b, err_msg=name)


def test_files_and_raw_scenarios_give_the_same_set(scenes: ScenarioSet, tmp_path: FilePath):
    for raw in RAW:
        write_scenario(tmp_path / f"{raw.token}.npz", *build_scenario(raw))
    loaded = spdm_jax.load(tmp_path, padding=roads.PADDING)
    assert [info.token for info in loaded.infos] == ["blocked", "free"]
    for a, b in zip(jax.tree.leaves(loaded.batch), jax.tree.leaves(scenes.batch), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(spdm_jax.load(tmp_path, limit=1)) == 1
    picked = spdm_jax.load(tmp_path, tokens=["free", "blocked"])
    assert [info.token for info in picked.infos] == ["free", "blocked"]
    assert len(spdm_jax.load(tmp_path / "free.npz")) == 1
    assert len(spdm_jax.load([tmp_path / "free.npz", str(tmp_path / "blocked.npz")])) == 2
    later = spdm_jax.load(tmp_path, iteration=5)
    np.testing.assert_array_equal(later.batch.num_history, scenes.batch.num_history + 5)


def test_plan_chooses_in_every_scene(plans: PlanSet):
    assert plans.name == "SPDM" and len(plans) == 2 and plans.status == ["ok", "ok"]
    np.testing.assert_array_equal(plans.num_proposals, [20, 20])
    total = plans.scores.total
    np.testing.assert_array_equal(plans.best, total.argmax(axis=1))
    assert np.asarray(plans.plans.proposals.stage)[0, plans.best[0]] == 2  # round the parked car
    assert plans.trajectory.x.shape == (2, 81) and plans.tracked.x.shape == (2, 20, 41)
    leaves = jax.tree.leaves((plans.scores, plans.trajectory))
    assert all(isinstance(leaf, np.ndarray) for leaf in leaves)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(plans.trajectory)} == {"float32"}
    assert plans.total is plans.scores.total
    with pytest.raises(AttributeError, match="PlanSet has no attribute 'totl'"):
        _ = plans.totl


def test_plan_table_has_one_row_per_real_proposal(plans: PlanSet):
    table = plans.to_table()
    assert table.height == 40
    chosen = table.filter(table["chosen"])
    assert chosen["token"].to_list() == ["blocked", "free"]
    assert chosen["proposal"].to_list() == plans.best.tolist()
    assert set(table["stage"]) == {1, 2} and set(table["status"]) == {"ok"}
    np.testing.assert_array_equal(table["total"].to_numpy(), plans.scores.total.reshape(-1))


@pytest.mark.slow
def test_planned_proposals_score_the_same_alone(scenes: ScenarioSet, plans: PlanSet):
    """Reference poses scored from outside, in the frame they come in, by the same rules."""
    pose = [np.asarray(getattr(plans.plans.proposals, n), float) for n in ("x", "y", "heading")]
    config = PlannerConfig(progress_reference="goal")
    again = spdm_jax.score(scenes, np.stack(pose, -1), frame="local", config=config)
    np.testing.assert_allclose(again.scores.total, plans.scores.total, atol=2e-3)
    for name in ("no_at_fault_collision", "drivable_area", "driving_direction"):
        np.testing.assert_array_equal(getattr(again.scores, name), getattr(plans.scores, name))


def test_faster_is_better_until_it_hits(scenes: ScenarioSet):
    result = run(scenes)
    free, blocked = result.scores.total[1], result.scores.no_at_fault_collision[0]
    np.testing.assert_array_equal(blocked, [1, 1, 1, 0, 0, 0, 0, 0])
    assert np.all(np.diff(result.scores.collision_time[0, 3:]) < 0)
    assert np.all(np.diff(result.scores.progress_raw[1]) > 0)
    assert free.argmax() >= 4
    assert result.status == ["ok", "ok"] and result.total.shape == (2, NUM)


def test_vocabulary_is_shared_by_all_scenes(scenes: ScenarioSet):
    each = np.broadcast_to(TRAJECTORIES, (2, *TRAJECTORIES.shape))
    same(run(scenes), run(scenes, each), 0)
    same(run(scenes), run(scenes, jax.numpy.asarray(TRAJECTORIES)), 0)


@pytest.mark.parametrize("frame", ["local", "global"])
def test_frames_say_the_same(scenes: ScenarioSet, frame):
    moved = []
    for raw in RAW:
        x, y, heading = raw.ego[raw.num_history, :3]
        cos, sin = np.cos(heading), np.sin(heading)
        pose = np.array(TRAJECTORIES)
        pose[..., 0] = x + cos * TRAJECTORIES[..., 0] - sin * TRAJECTORIES[..., 1]
        pose[..., 1] = y + sin * TRAJECTORIES[..., 0] + cos * TRAJECTORIES[..., 1]
        pose[..., 2] = TRAJECTORIES[..., 2] + heading
        if frame == "local":
            pose[..., :2] -= np.round([x, y])
        moved.append(pose)
    same(run(scenes), run(scenes, np.stack(moved), frame=frame), 1e-6)


@pytest.mark.parametrize("steps", [8, 9, 17])
def test_poses_every_half_second(scenes: ScenarioSet, steps: int):
    """8 poses from 0.5 s on, 9 with the current one, or a longer horizon."""
    coarse = straight(np.linspace(0, 14, NUM), 0.5, 17)
    coarse = coarse[:, 1:9] if steps == 8 else coarse[:, :steps]
    same(run(scenes), run(scenes, coarse, dt=0.5), 1e-9)


def test_longer_trajectories_are_cut(scenes: ScenarioSet):
    same(run(scenes), run(scenes, straight(np.linspace(0, 14, NUM), steps=81)), 0)


def test_trackers(scenes: ScenarioSet):
    speeds = np.linspace(0, 14, NUM)
    reference = run(scenes)
    none = run(scenes, tracker="none", forecast=standing(scenes))
    # Untracked poses are where they were said to be; tracked ones start at the ego's speed.
    np.testing.assert_allclose(
        none.tracked.x[0], TRAJECTORIES[..., 0] + none.tracked.x[0, :, :1], atol=1e-9
    )
    np.testing.assert_allclose(none.tracked.vx[0, :, 1:], speeds[:, None] + np.zeros(40), atol=1e-9)
    np.testing.assert_allclose(reference.tracked.vx[:, :, 0], 10.0)
    assert np.abs(reference.tracked.x[0] - none.tracked.x[0]).max() > 0.5


@pytest.mark.slow
def test_corrected_tracker_differs(scenes: ScenarioSet):
    # A start with a growing acceleration, which the published fit does not follow exactly.
    start = straight(np.linspace(0, 14, NUM))
    start[..., 0] += 0.1 * STEPS**3
    results = [run(scenes, start, tracker=name) for name in ("reference", "corrected")]
    gap = np.abs(results[0].tracked.vx - results[1].tracked.vx).max()
    assert 1e-3 < gap < 1.0


def test_full_states_are_scored_as_they_are(scenes: ScenarioSet):
    tracked = run(scenes)
    states = np.stack([getattr(tracked.tracked, n) for n in EgoState.__dataclass_fields__], -1)
    for tracker in ("reference", "none"):
        again = run(scenes, states, frame="local", tracker=tracker, forecast=standing(scenes))
        same(tracked, again, 1e-6)
        np.testing.assert_allclose(again.tracked.steering, tracked.tracked.steering, atol=1e-12)


def test_supplied_forecast_replaces_the_own_one(scenes: ScenarioSet):
    tracked = run(scenes).tracked
    states = np.stack([getattr(tracked, n) for n in EgoState.__dataclass_fields__], -1)
    forecast = standing(scenes)
    stays = run(scenes, states, frame="local", forecast=forecast)
    assert (stays.scores.no_at_fault_collision < 1).any()
    nobody = run(scenes, states, frame="local", forecast=np.full_like(forecast, np.nan))
    np.testing.assert_array_equal(nobody.scores.no_at_fault_collision, 1)
    np.testing.assert_array_equal(nobody.scores.time_to_collision, 1)
    # The parked car drives away at 20 m/s.
    forecast[0, 0, :, 0] += 4.0 * np.arange(41)
    away = run(scenes, states, frame="local", forecast=forecast)
    np.testing.assert_array_equal(away.scores.no_at_fault_collision, 1)


def test_explanation_names_rule_object_and_time(scenes: ScenarioSet):
    result = run(scenes)
    text = result.explain(0, NUM - 1)
    assert text.rule == "no_at_fault_collision" and text.agent == "parked"
    assert text.step == round(10 * result.scores.collision_time[0, NUM - 1])
    assert text.token == "blocked" and text.proposal == NUM - 1
    first = text.lost[0]
    assert "at-fault collision" in first and "vehicle parked" in first and "stopped track" in first
    assert "scene blocked, proposal 7: 0.000" in str(text)
    best = int(result.scores.progress_raw[1].argmax())
    fine = result.explain(1, best)
    assert fine.agent is None and "progress" not in " ".join(fine.lost)
    off = straight(np.full(NUM, 8.0))
    off[..., 1] = np.linspace(0, 30, 41)
    off[..., 2] = np.arctan2(30, 32)
    lost = run(scenes, off).explain(1, 0)
    assert any("leaves the drivable area" in line for line in lost.lost)
    assert lost.rule == "drivable_area"


def test_explanation_lists_every_lost_term(scenes: ScenarioSet):
    result = run(scenes)
    for scene in range(2):
        for proposal in range(NUM):
            lost = result.explain(scene, proposal).lost
            words = " ".join(lost)
            terms = {
                "at-fault": result.scores.no_at_fault_collision,
                "drivable": result.scores.drivable_area,
                "less than 1 s": result.scores.time_to_collision,
                "uncomfortable": result.scores.comfort,
                "of the best": np.round(result.scores.progress, 6),
            }
            for word, values in terms.items():
                assert (word in words) == (values[scene, proposal] < 1), (word, words)


def test_score_table(scenes: ScenarioSet):
    result = run(scenes)
    table = result.to_table()
    assert table.height == 2 * NUM
    assert table["token"].to_list() == ["blocked"] * NUM + ["free"] * NUM
    np.testing.assert_array_equal(
        table["progress_raw"].to_numpy(), result.scores.progress_raw.ravel()
    )


def test_overflow_is_reported(scenes: ScenarioSet):
    result = run(scenes)
    flagged = dataclasses.replace(result, overflow=np.array([True, False]))
    assert flagged.status == ["overflow", "ok"]
    broken = dataclasses.replace(
        result, scores=result.scores.replace(total=result.scores.total * [[1.0], [np.nan]])
    )
    assert broken.status == ["ok", "failed"]


def test_set_says_what_it_holds(scenes: ScenarioSet):
    assert repr(scenes) == "ScenarioSet(2 scenarios: straight; padded to 16 tracks, 16 lanes)"


@pytest.mark.slow
def test_precisions_agree(scenes: ScenarioSet, plans: PlanSet):
    double = spdm_jax.plan(scenes, spdm(20), precision="f64")
    np.testing.assert_array_equal(double.best, plans.best)
    np.testing.assert_allclose(plans.trajectory.x, double.trajectory.x, atol=5e-3)
    np.testing.assert_allclose(plans.trajectory.y, double.trajectory.y, atol=5e-3)
    np.testing.assert_allclose(plans.scores.total, double.scores.total, atol=2e-3)
    low = spdm_jax.score(scenes, TRAJECTORIES)
    np.testing.assert_allclose(low.scores.total, run(scenes).scores.total, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["perfect", "none"])
def test_forecast_modes_of_the_planner(scenes: ScenarioSet, plans: PlanSet, mode):
    other = spdm_jax.plan(scenes, spdm(20, config=PlannerConfig(forecast=mode)))
    if mode == "perfect":  # the car is parked in the recording, too
        np.testing.assert_array_equal(other.best, plans.best)
    else:
        np.testing.assert_array_equal(other.scores.no_at_fault_collision, 1)
        assert not np.asarray(other.forecast.valid).any()
