"""`spdm simulate` on changed scenarios: extras, scripts, verdicts, rows."""

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import polars
import pytest

import small_road as roads
from small_road import FRONT, LANE_WIDTH
from spdm_experiments import cli
from spdm_experiments.loading import Loader
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import bootstrap, load_run, summarise
from spdm_experiments.simulate_points import make_points
from spdm_experiments.simulate_rows import _changed, _lost_by_changes
from spdm_experiments.simulate_scene import UNREAD, Switches, run_scene
from spdm_experiments.simulate_scenes import find_scenes
from spdm_experiments.simulate_scripts import (
    ScriptRoom,
    check_points,
    room_of,
    scripts_of,
    verdicts_of,
)
from spdm_jax.batching import group_by_shape, leaf_type
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.interplan.extras import extras_path, write_extras
from spdm_jax.interplan.modification_file import modifications_from
from spdm_jax.interplan.modify import modify
from spdm_jax.interplan.score import InterplanMetrics, LaneChangesToGoal
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.metrics import SCORED
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.loop import SimulationConfig

TOKEN = "0123456789abcdef"
EGO_FRONT = roads.EGO_X + FRONT
GOAL = 75.0
"""x of the goal, m; the ego's centre starts at 61.461 m and drives 1 m per step."""
LANE_1 = -LANE_WIDTH
DETAILS = {
    "goal": {"straight": [GOAL, LANE_1]},
    "special_scenario": {
        "0": {
            "type": "jaywalking_pedestrian",
            "pedestrian": [[EGO_FRONT + 8.0, LANE_1, EGO_FRONT + 8.0, LANE_1 + 1, None]],
        },
        "1": {
            "type": "nudge_around_parked_vehicle",
            "config": "oc",
            "stopped_vehicle": [[68.0, 0.0, 0.0]],
        },
    },
}
CODES = ("gs", "s0", "s1")
NAMES = [f"{TOKEN}-{code}" for code in CODES]
DRIVE = ["--planner", "constant-velocity"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three changed scenarios and an unchanged one."""
    folder = tmp_path_factory.mktemp("pack")
    file = modifications_from({"modification_details_dictionary": {TOKEN: DETAILS}})
    write_scenario(folder / "plain.npz", *build_scenario(roads.road(token="plain")))
    for name in NAMES:
        raw, extras = modify(roads.road(token=TOKEN), file.changes(name))
        write_scenario(folder / f"{name}.npz", *build_scenario(raw))
        write_extras(extras_path(folder / f"{name}.npz"), extras)
    return folder


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """The same files, to be spoilt."""
    target = tmp_path / "copy"
    target.mkdir()
    for path in folder.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
    return target


def options(folder: Path, **more: Any) -> Simulate:
    return Simulate(scenes=folder, **more)


# --- extras


def test_extras_are_found_beside_the_files(folder: Path):
    found = find_scenes(options(folder))
    assert sorted(found.extras) == NAMES and not found.inventory.failures
    assert {entry.token for entry in found.inventory.entries} == {"plain", *NAMES}
    plain = find_scenes(options(folder / "plain.npz"))
    assert not plain.extras


def test_other_extras_make_another_run(copy: Path):
    digest = lambda: find_scenes(options(copy)).inventory.digest
    before = digest()
    path = extras_path(copy / f"{NAMES[0]}.npz")
    entries = json.loads(path.read_text())
    path.write_text(json.dumps({**entries, "end": entries["end"] - 1}))
    assert digest() != before


@pytest.mark.parametrize(
    "spoil, text",
    [
        (lambda path: path.unlink(), "without 0123456789abcdef-gs.interplan.json beside it"),
        (lambda path: path.write_text("{}"), "no record of an interPlan scenario"),
        (
            lambda path: path.write_text(extras_path(path.parent / f"{NAMES[1]}.npz").read_text()),
            f"is of scenario '{NAMES[1]}' and does not fit",
        ),
        (
            lambda path: path.write_text(
                json.dumps({**json.loads(path.read_text()), "stopped": ["nobody"]})
            ),
            "does not fit",
        ),
    ],
)
def test_scenarios_that_do_not_fit_their_extras_are_failures(spoil, text: str, copy: Path):
    spoil(extras_path(copy / f"{NAMES[0]}.npz"))
    found = find_scenes(options(copy))
    (failure,) = found.inventory.failures
    assert failure.token == NAMES[0] and text in failure.reason
    assert sorted(found.extras) == NAMES[1:]


@pytest.mark.parametrize(
    "given, wish",
    [
        (["--traffic", "replay"], "--traffic replay"),
        (["--traffic", "reactive", "replay"], "--traffic replay"),
        (["--mode", "closed", "open"], "--mode open"),
        (["--planner", "spdm", "--forecast", "perfect"], "--forecast perfect"),
    ],
)
def test_the_record_cannot_be_repeated(
    given: list[str], wish: str, folder: Path, tmp_path: Path, capsys
):
    arguments = ["simulate", str(folder), "--out", str(tmp_path / "run"), *given]
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert f"{wish} repeats the record" in said and NAMES[0] in said
    assert not (tmp_path / "run").exists()
    points = make_points(options(folder, traffic=("replay",)))
    check_points({}, points)


def test_room_grows_in_powers_of_two(folder: Path):
    extras = find_scenes(options(folder)).extras
    one = extras[NAMES[1]]
    assert room_of(list(extras.values())) == ScriptRoom(4, 512)
    many = dataclasses.replace(one, pedestrians=one.pedestrians * 5, course=((0.0, 0.0),) * 513)
    assert room_of([one, many]) == ScriptRoom(8, 1024)
    begun = tuple(dataclasses.replace(who, begins_at=3) for who in many.pedestrians)
    assert room_of([dataclasses.replace(many, pedestrians=begun)]) == ScriptRoom(4, 1024)


# --- rows


def verdict(changes: LaneChangesToGoal, final: float, **scores: float) -> InterplanMetrics:
    known = {**dict.fromkeys(SCORED, 1.0), "lane_changes_to_goal": changes.score, **scores}
    return InterplanMetrics(known, final, changes, 0.75 if scores else None)


def test_rows_say_what_interplan_thinks():
    row: dict[str, Any] = {"ego_progress_along_expert_route": 0.5}
    found = verdict(LaneChangesToGoal(2, 1, 0.5), 0.0, ego_sorts_stopped_vehicle=0.0)
    row |= _changed(found)
    assert row["interplan_score"] == 0.0 and row["lane_changes_to_goal"] == 0.5
    assert row["ego_sorts_stopped_vehicle"] == 0.0 and row["ego_sorts_construction_zone"] is None
    changes, obstacle = _lost_by_changes(found, row)
    assert changes["detail"] == "lane changes to the goal: 2 at the start, 1 left at the end"
    assert (
        obstacle["metric"] == "ego_sorts_stopped_vehicle"
        and "0.50 of the 0.75" in (obstacle["detail"])
    )
    unknown = verdict(LaneChangesToGoal(None, None, float("nan")), 1.0)
    row = {**row, **_changed(unknown)}
    assert row["lane_changes_to_goal"] is None and row["interplan_score"] == 1.0
    assert _lost_by_changes(unknown, row) == []


def test_means_are_over_the_rows_that_have_a_value():
    rng = np.random.default_rng(0)
    whole = rng.uniform(size=(40, 2))
    part = whole.copy()
    part[::2, 1] = np.nan
    ends = bootstrap(part, 1)
    np.testing.assert_array_equal(ends[:, 0], bootstrap(whole, 1)[:, 0])
    mean = np.nanmean(part[:, 1])
    assert ends[0, 1] < mean < ends[1, 1]
    # Half the values, a wider interval.
    assert np.diff(ends[:, 1]) > 1.1 * np.diff(bootstrap(whole, 1)[:, 1])
    part[1:, 1] = np.nan
    assert np.isnan(bootstrap(part, 1)[:, 1]).all()


# --- drives


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    assert cli.main(["simulate", str(folder), "--out", str(out), *DRIVE]) == 0
    return out


def rows(out: Path) -> dict[str, dict[str, Any]]:
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    return {row["token"]: row for row in table.iter_rows(named=True)}


@pytest.mark.slow
def test_drives_follow_the_script(whole: Path):
    found = rows(whole)
    assert {row["status"] for row in found.values()} == {"ok"}
    plain, goal, walker, parked = (found[name] for name in ("plain", *NAMES))
    own = ("interplan_score", "lane_changes_to_goal", "ego_sorts_jaywalking_pedestrian")
    assert all(plain[name] is None for name in own) and plain["samples"] == 19
    # The drive ends before the step past the goal.
    ends = int(GOAL - 0.1 - (roads.EGO_X + 1.461)) + 1
    assert goal["samples"] == ends and goal["ego_sorts_stopped_vehicle"] is None
    assert goal["lane_changes_to_goal"] == 1
    # The pedestrian is no more than a script, and it is there to be hit.
    assert walker["collision_object"] == "pedestrian-0"
    assert walker["collision_time"] == pytest.approx(0.8, abs=0.11)
    assert walker["interplan_score"] == 0
    # Without a goal of its own a drive ends where the recorded one did, 0.1 m short.
    assert parked["scenario_type"] == "nudge_around_parked_vehicle" and parked["samples"] == 18
    assert parked["ego_sorts_stopped_vehicle"] == parked["driving_direction_compliance"] == 1
    terms = sum(w * parked[n] for w, n in zip((5, 5, 4, 2), SCORED[4:], strict=True))
    assert parked["interplan_score"] == pytest.approx((terms + 4 + 1) / 21, abs=1e-5)
    assert parked["score"] == pytest.approx(terms / 16, abs=1e-5) and terms < 16


@pytest.mark.slow
def test_report_shows_interplans_score(whole: Path, tmp_path: Path):
    run = load_run(whole)
    assert run.about["num_interplan"] == 3
    (summary,) = summarise(run)
    mine = [rows(whole)[name]["interplan_score"] for name in NAMES]
    assert summary.scenarios == 4
    assert summary.means["interplan_score"] == pytest.approx(np.mean(mine))
    assert np.isnan(summary.means["ego_sorts_construction_zone"])
    page = tmp_path / "page.html"
    assert cli.main(["report", str(whole), "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "interPlan's score" in text and "NaN" not in text


@pytest.mark.slow
def test_room_and_neighbours_change_nothing(folder: Path, whole: Path):
    """The scripts of a batch through one mapped program, in more room than they need."""
    found = find_scenes(options(folder))
    entries = [entry for entry in found.inventory.entries if entry.token in found.extras]
    (shape,) = group_by_shape([entry.sizes for entry in entries])
    scenes = Loader(unread=UNREAD, dtype=np.float32).load(entries, shape.padding)
    assert scenes.batch is not None
    scripts = scripts_of(found.extras, scenes, ScriptRoom(8, 1024))
    room = AgentSizes(agents=8, replayed=8, path_points=401)
    switches = Switches(
        planner="constant-velocity",
        config=PlannerConfig(max_path_points=512),
        simulation=SimulationConfig(num_samples=19, traffic="reactive", sizes=room),
        num_iterations=20,
    )
    single = lambda tree: jax.tree.map(
        lambda v: np.asarray(v, leaf_type(np.asarray(v), np.dtype(np.float32))), tree
    )
    mapped = jax.jit(jax.vmap(partial(run_scene, static=switches), in_axes=(0, 0, None)))
    result = mapped(single(scenes.batch), single(scripts), single(PlannerParams()))
    result = cast(Any, jax.tree.map(np.asarray, result))
    verdicts = verdicts_of(found.extras, scenes, result)
    for i, entry in enumerate(entries):
        row = rows(whole)[entry.token]
        assert result.samples[i] == row["samples"]
        for name, score in zip(SCORED, result.metrics.scores[i], strict=True):
            assert score == pytest.approx(row[name], abs=1e-5), (entry.token, name)
        assert verdicts[i].final == pytest.approx(row["interplan_score"], abs=1e-5)
        assert verdicts[i].lane_changes.score == row["lane_changes_to_goal"]
