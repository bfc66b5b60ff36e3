"""`spdm plan`, `score`, `show` and `demo`: chunks, the run folder, failures and interruption.

A fake planner stands in where the bookkeeping is under test; what it returns names the scene. The
slow tests run the real one.
"""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import polars
import pytest

from spdm_experiments import cli, doctor, runs, runtime
from spdm_experiments.chunks import Survey, chunks, keep, num_chunks, scenario_files, survey
from spdm_experiments.options import Plan
from spdm_experiments.planners import describe, make_planner
from spdm_experiments.trajectory_file import read_trajectories
from spdm_jax import PlanSet, ScenarioSet, functional, load, pdm_closed
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PaddingConfig

SCENES = ("curve", "lane_ends", "open_road", "parked_car", "straight")
TOKENS = [f"{name}-0" for name in SCENES]


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert cli.main(["pack", ",".join(SCENES), str(folder)]) == 0
    return folder


@pytest.fixture
def broken_pack(pack: Path, tmp_path: Path) -> Path:
    """The pack with a file in second place that is no scenario."""
    folder = tmp_path / "pack"
    shutil.copytree(pack, folder)
    (folder / "curve-1.npz").write_bytes(b"PK not a zip archive")
    return folder


@pytest.fixture(scope="module")
def found(pack: Path) -> Survey:
    return survey(scenario_files(pack))


def test_survey_holds_every_scene(pack: Path, found: Survey):
    assert found.tokens == TOKENS
    assert found.places == [0, 1, 2, 3, 4]
    assert (found.sources, found.num_files, found.failures) == (["synthetic"], 5, [])
    whole, alone = load(pack), [load(path, padding=found.padding) for path in found.paths]
    for scenes in alone:
        for mine, other in zip(
            jax.tree.leaves(scenes.batch), jax.tree.leaves(whole.batch), strict=True
        ):
            assert mine.shape[1:] == other.shape[1:]


def test_survey_names_what_it_leaves_out(broken_pack: Path):
    found = survey(scenario_files(broken_pack))
    assert found.tokens == TOKENS
    assert found.places == [0, 2, 3, 4, 5]
    ((token, reason),) = [(f.token, f.reason) for f in found.failures]
    assert token == "curve-1" and "damaged scenario file" in reason


def test_survey_refuses_one_scene_twice(pack: Path, tmp_path: Path):
    shutil.copy(pack / "curve-0.npz", tmp_path / "a.npz")
    shutil.copy(pack / "curve-0.npz", tmp_path / "b.npz")
    with pytest.raises(ScenarioError, match=r"b\.npz: holds scenario 'curve-0', and so does .*a"):
        survey(scenario_files(tmp_path))


def test_scene_beyond_the_largest_bucket_fails_alone(found: Survey):
    counts = [int(load(path).batch.map.lanes.centerline.valid.sum()) for path in found.paths]
    limit = sorted(counts)[2]
    assert limit < max(counts)  # else the test shows nothing
    allowed = dataclasses.replace(PaddingConfig(), centerline_points=(limit,))
    fitting = survey(found.paths, allowed)
    assert fitting.tokens == [t for t, n in zip(TOKENS, counts, strict=True) if n <= limit]
    assert all(f"largest bucket is {limit}" in failure.reason for failure in fitting.failures)


@pytest.mark.parametrize(
    "name, limit, text",
    [
        ("gone", None, "no such file or folder"),
        ("empty", None, "write them with: spdm pack"),
        (".", 0, "--limit is 0"),
    ],
)
def test_folder_without_scenarios(name: str, limit: int | None, text: str, tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=text):
        scenario_files(tmp_path / name, limit)


@pytest.mark.parametrize("count, size, expected", [(5, 5, 1), (1, 16, 1), (6, 5, 2), (5, 2, 5)])
def test_number_of_chunks(count: int, size: int, expected: int):
    assert num_chunks(count, size) == expected


def test_chunk_of_one_is_refused():
    with pytest.raises(ValueError, match="--chunk is 1"):
        num_chunks(5, 1)


@pytest.mark.parametrize("size", [2, 3, 4, 5, 9])
def test_chunks_are_of_one_shape_and_hold_every_scene_once(size: int, found: Survey):
    shapes, seen = set(), []
    longest = found.tokens[found.longest]
    for rows, scenes in chunks(found, size):
        shapes.add(tuple(leaf.shape for leaf in jax.tree.leaves(scenes.batch)))
        names = [info.token for info in scenes.infos]
        assert len(names) <= size
        assert longest in names  # so that every chunk gets path buffers of one size
        assert names[: len(rows)] == [found.tokens[i] for i in rows]
        assert set(names[len(rows) :]) <= {longest}
        seen += rows
    assert len(shapes) == 1
    assert seen == list(range(5))


def test_longest_route_decides_the_path_buffer(found: Survey):
    from spdm_jax.api import fit_config

    room = lambda scenes: fit_config(scenes, pdm_closed().config).max_path_points
    whole = room(load(found.paths, padding=found.padding))
    alone = [room(load(path, padding=found.padding)) for path in found.paths]
    assert alone[found.longest] == whole == max(alone)
    assert {room(scenes) for _, scenes in chunks(found, 2)} == {whole}


def test_file_that_changes_meanwhile_is_named(broken_pack: Path):
    found = survey(scenario_files(broken_pack))
    (broken_pack / "straight-0.npz").write_bytes(b"gone")
    with pytest.raises(ScenarioError, match="straight-0: changed while it was in use"):
        list(chunks(found, 3))


Fake = Callable[..., PlanSet]


@pytest.fixture(scope="module")
def shapes(found: Survey) -> Any:
    """Shapes of a plan with 15 proposals; traced, not compiled."""
    scenes = load(found.paths[0], padding=found.padding)
    planner = pdm_closed()
    device = functional.to_device(scenes.batch).replace(origin=jnp.zeros((1, 2)))
    scene = jax.tree.map(lambda leaf: leaf[0], device)
    return jax.eval_shape(
        partial(functional.plan, config=planner.config), scene, params=planner.params
    )


@pytest.fixture
def fake(shapes: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replaces the planner: proposal 2 of the scene with token i of `TOKENS` scores 0.1 i.

    Entries: "calls", tokens of every call; "overflow", tokens that overflow; "before", called
    first.
    """
    state: dict[str, Any] = {"calls": [], "overflow": (), "before": lambda: None}

    def plan(scenes: ScenarioSet, planner: Any, *, precision: str) -> PlanSet:
        state["before"]()
        names = [info.token for info in scenes.infos]
        state["calls"].append(names)
        result = jax.tree.map(lambda s: np.zeros((len(names), *s.shape), s.dtype), shapes)
        total = result.scores.total
        total[:, 2] = [0.1 * TOKENS.index(name) for name in names]
        result.scores.valid[:, :12] = True
        result.proposals.path[:, 2] = 1
        result.best[:] = 2
        overflow = np.isin(names, state["overflow"])
        return PlanSet(
            scores=result.scores,
            tracked=result.tracked,
            forecast=result.forecast,
            infos=scenes.infos,
            overflow=overflow,
            plans=result,
            name=planner.name,
        )

    monkeypatch.setattr(runs, "plan_scenes", plan)
    return state


def run_plan(source: Path, out: Path, *more: str) -> int:
    return cli.main(["plan", str(source), "--out", str(out), "--planner", "pdm-closed", *more])


def test_keep_drops_the_filling_rows(found: Survey, fake: dict[str, Any]):
    scenes = load(found.paths[:3], padding=found.padding)
    result = cast(Any, runs).plan_scenes(scenes, pdm_closed(), precision="f32")
    kept = keep(result, 2)
    assert [info.token for info in kept.infos] == TOKENS[:2]
    assert {leaf.shape[0] for leaf in jax.tree.leaves((kept.scores, kept.plans, kept.tracked))} == {
        2
    }
    assert len(kept.status) == 2


def test_plan_writes_rows_plans_and_a_description(
    pack: Path, tmp_path: Path, fake: dict[str, Any], capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    assert run_plan(pack, out, "--chunk", "3") == 0
    assert len(fake["calls"]) == 3
    table = polars.read_parquet(out / "rows.parquet")
    assert table.height == 5 * 12  # padded proposals are no rows
    chosen = table.filter(polars.col("chosen"))
    assert chosen["token"].to_list() == TOKENS
    assert chosen["total"].to_list() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert set(chosen["num_proposals"]) == {12}
    about = json.loads((out / "run.json").read_text())
    assert (about["scenarios"], about["scenarios_done"], about["scenarios_failed"]) == (5, 5, 0)
    assert about["finished"] and about["planners"][0]["name"] == "PDM-Closed"
    assert about["suite"].endswith("(built-in scenes)")
    plans = np.load(out / "trajectories.npz")
    assert plans["tokens"].tolist() == TOKENS
    # The fake stays at 0 in the local frame, which is the origin in map coordinates.
    origins = load(pack).batch.origin
    np.testing.assert_array_equal(plans["trajectories"][:, 0, 7, :2], origins)
    printed = capsys.readouterr().out
    assert "5 of 5 scenarios done, 0 failed; mean score 0.2000" in printed
    assert "-1.0 m" in printed
    assert all(str(out / name) in printed for name in ("rows.parquet", "trajectories.npz"))


def test_failed_scenes_are_listed_and_the_others_finished(
    broken_pack: Path, tmp_path: Path, fake: dict[str, Any], capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    fake["overflow"] = ("open_road-0",)
    assert run_plan(broken_pack, out, "--chunk", "4") == 1
    table = polars.read_parquet(out / "rows.parquet")
    assert table.filter(polars.col("status") == "ok")["token"].n_unique() == 4
    failed = table.filter(polars.col("status") == "failed")
    assert failed["token"].to_list() == ["curve-1", "open_road-0"]
    assert failed["total"].null_count() == 2
    about = json.loads((out / "run.json").read_text())
    assert set(about["failures"]) == {"curve-1", "open_road-0"}
    assert (about["scenarios"], about["scenarios_done"], about["scenarios_failed"]) == (6, 4, 2)
    assert "open_road-0" not in np.load(out / "trajectories.npz")["tokens"]
    printed = capsys.readouterr().out
    assert "4 of 6 scenarios done, 2 failed; mean score 0.2000" in printed
    assert "open_road-0: more path points or red lights" in printed


def test_interrupt_keeps_what_is_done(
    pack: Path, tmp_path: Path, fake: dict[str, Any], capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    fake["before"] = lambda: signal.raise_signal(signal.SIGINT)
    before = signal.getsignal(signal.SIGINT)
    assert run_plan(pack, out, "--chunk", "3") == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert len(fake["calls"]) == 1
    table = polars.read_parquet(out / "rows.parquet")
    assert table["token"].unique(maintain_order=True).to_list() == TOKENS[:2]
    about = json.loads((out / "run.json").read_text())
    assert not about["finished"] and about["scenarios_done"] == 2
    printed = capsys.readouterr()
    assert "2 of 5 scenarios done" in printed.out
    assert "stopping after this chunk" in printed.err and "interrupted" in printed.err


def test_second_interrupt_stops_at_once(pack: Path, tmp_path: Path, fake: dict[str, Any]):
    def twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    fake["before"] = twice
    assert run_plan(pack, tmp_path / "run") == 130
    assert not fake["calls"]


def test_new_run_replaces_the_old_one(pack: Path, tmp_path: Path, fake: dict[str, Any]):
    out = tmp_path / "run"
    assert run_plan(pack, out) == 0
    assert run_plan(pack, out, "--limit", "2") == 0
    assert polars.read_parquet(out / "rows.parquet")["token"].n_unique() == 2
    assert not [path for path in out.iterdir() if path.name.endswith(".tmp")]


@pytest.mark.parametrize(
    "arguments, count",
    [
        ("", 60),
        ("--num-proposals 15", 15),
        ("--planner pdm-closed", 15),
        ("--planner pdm-closed --num-proposals 30", 30),
        ("--speeds 0.5 1 --offsets 0 --num-proposals 8", 8),
        ("--planner pdm-closed --offsets 0 1 --speeds 1", 2),
    ],
)
def test_options_make_the_planner(
    arguments: str, count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    seen: list[Plan] = []
    monkeypatch.setattr("spdm_experiments.commands.plan", lambda o: seen.append(o) or True)
    assert cli.main(["plan", str(tmp_path), "--forecast", "none", *arguments.split()]) == 0
    planner = describe(make_planner(seen[0]))
    assert planner["num_proposals"] == count
    assert planner["forecast"] == "none"


def test_impossible_number_of_proposals_is_refused(pack: Path, capsys: pytest.CaptureFixture[str]):
    assert cli.main(["plan", str(pack), "--num-proposals", "17"]) == 2
    assert "num_proposals is 17" in capsys.readouterr().err


def straight(*lead: int) -> np.ndarray:
    poses = np.zeros((*lead, 41, 3))
    poses[..., 0] = 0.5 * np.arange(41)
    return poses


def store(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_trajectories_follow_tokens(tmp_path: Path, found: Survey):
    values = straight(6, 2) + np.arange(6)[:, None, None, None]
    names = [*reversed(TOKENS), "another"]
    path = store(tmp_path / "t.npz", trajectories=values, tokens=np.array(names))
    read = read_trajectories(path, 0.1, found)
    np.testing.assert_array_equal(read, values[[4, 3, 2, 1, 0]])


def test_trajectories_follow_the_files(tmp_path: Path, broken_pack: Path):
    values = straight(6, 2) + np.arange(6)[:, None, None, None]
    np.save(tmp_path / "t.npy", values)
    read = read_trajectories(tmp_path / "t.npy", 0.1, survey(scenario_files(broken_pack)))
    np.testing.assert_array_equal(read, values[[0, 2, 3, 4, 5]])  # file 1 is broken


def test_one_set_serves_all(tmp_path: Path, found: Survey):
    np.save(tmp_path / "t.npy", straight(7))
    assert read_trajectories(tmp_path / "t.npy", 0.1, found).shape == (7, 41, 3)


@pytest.mark.parametrize(
    "arrays, text",
    [
        ({"poses": straight(2)}, 'holds poses; name the poses "trajectories"'),
        ({"trajectories": straight(4, 2)}, "of 4 scenarios, but there are 5"),
        ({"trajectories": straight(5, 2)[:, :, :20]}, "20 steps"),
        ({"trajectories": straight(5, 2)[..., :2]}, "has shape"),
        ({"trajectories": np.full((5, 2, 41, 3), np.nan)}, "must be finite"),
        ({"trajectories": straight(2).astype(complex)}, "complex128"),
        ({"trajectories": straight(2), "tokens": np.array(TOKENS[:2])}, "goes without tokens"),
        ({"trajectories": straight(2, 2), "tokens": np.array(TOKENS[:2])}, "(3 are missing)"),
        ({"trajectories": straight(2, 2), "tokens": np.array(TOKENS)}, "tokens has shape"),
    ],
)
def test_unfit_trajectories_are_named(
    arrays: dict[str, Any], text: str, tmp_path: Path, found: Survey
):
    path = store(tmp_path / "t.npz", **arrays)
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        read_trajectories(path, 0.1, found)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("content", [b"no array", b""])
def test_file_that_is_no_array(content: bytes, tmp_path: Path, found: Survey):
    (tmp_path / "t.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"t\.npy: not a \.npy or \.npz file"):
        read_trajectories(tmp_path / "t.npy", 0.1, found)


def test_score_agrees_with_the_stored_numbers(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    np.save(tmp_path / "t.npy", doctor.stored_trajectories())
    out = tmp_path / "run"
    scene = pack / "parked_car-0.npz"
    assert cli.main(["score", str(scene), str(tmp_path / "t.npy"), "--out", str(out)]) == 0
    table = polars.read_parquet(out / "rows.parquet")
    assert table["total"].to_list() == pytest.approx([0, 0.779493, 1, 0], abs=1e-4)
    assert table["progress_raw"].to_list() == pytest.approx(
        [34.17699, 19.48466, 41.38774, 19.91633], abs=1e-3
    )
    about = json.loads((out / "run.json").read_text())
    assert about["trajectories_shape"] == [4, 41, 3] and about["dt"] == 0.1
    assert "1 of 1 scenarios done, 0 failed; mean score 0.4449" in capsys.readouterr().out


def test_clock_tells_compiling_from_running():
    clock = runtime.Clock()
    double = jax.jit(lambda x: 2 * x + 1)
    with clock.computing():
        double(jnp.ones(3)).block_until_ready()
    compiled = clock.compile
    assert compiled > 0
    with clock.computing():
        double(jnp.ones(3)).block_until_ready()
    assert clock.compile == compiled
    assert clock.run > 0
    assert set(clock.seconds()) == {"load_s", "compile_s", "run_s"}


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_commit_counts_only_where_the_program_is_tracked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if shutil.which("git") is None:
        pytest.skip("no git on this machine")
    program = tmp_path / "program.py"
    program.write_text("1")
    monkeypatch.setattr(runtime, "__file__", str(program))
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert runtime.commit() is None
    git(tmp_path, "init", "-q")
    (tmp_path / "other").touch()
    git(tmp_path, "add", "other")
    git(tmp_path, "commit", "-q", "-m", "one")
    assert runtime.commit() is None  # somebody else's repository
    git(tmp_path, "add", "program.py")
    git(tmp_path, "commit", "-q", "-m", "two")
    assert runtime.commit() == git(tmp_path, "rev-parse", "--short=12", "HEAD")
    program.write_text("2")
    assert runtime.commit() == git(tmp_path, "rev-parse", "--short=12", "HEAD") + "-dirty"


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG")


def check_rows(folder: Path, planners: Sequence[str], tokens: Sequence[str]) -> None:
    chosen = polars.read_parquet(folder / "rows.parquet").filter(polars.col("chosen"))
    assert sorted(zip(chosen["token"], chosen["planner"], strict=True)) == sorted(
        (token, planner) for token in tokens for planner in planners
    )
    assert chosen["total"].is_between(0, 1).all()


@pytest.mark.slow
def test_demo_compares_both_planners(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "demo"
    command = ["demo", "--out", str(out), "--scenes", "parked_car", "straight"]
    assert cli.main(command) == 0
    tokens = ["parked_car-0", "straight-0"]
    check_rows(out, ["PDM-Closed", "SPDM"], tokens)
    about = json.loads((out / "run.json").read_text())
    assert about["suite"] == "built-in scenes" and about["seed"] == 0
    assert about["times"]["compile_s"] > 0 and about["times"]["run_s"] > 0
    page = (out / "scenes.html").read_text()
    assert all(token in page for token in tokens)
    assert is_png(out / "parked_car-0.png")  # SPDM passes where PDM-Closed stops behind
    printed = capsys.readouterr().out
    written = [Path(line.strip()) for line in printed.split("written:")[1].splitlines() if line]
    assert sorted(written) == sorted(out.iterdir())


@pytest.mark.slow
def test_plan_score_and_show_agree(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    plan, score = tmp_path / "plan", tmp_path / "score"
    command = ["plan", str(pack), "--out", str(plan), "--chunk", "3", "--html", "1", "--png", "1"]
    assert cli.main(command) == 0
    check_rows(plan, ["SPDM"], TOKENS)
    assert is_png(plan / "curve-0.png") and "curve-0" in (plan / "scenes.html").read_text()
    command = ["score", str(pack), str(plan / "trajectories.npz"), "--out", str(score)]
    options = ["--frame", "global", "--progress-reference", "goal", "--chunk", "3"]
    assert cli.main([*command, *options]) == 0
    chosen = polars.read_parquet(plan / "rows.parquet").filter(polars.col("chosen"))
    rows = polars.read_parquet(score / "rows.parquet")
    assert rows["token"].to_list() == chosen["token"].to_list()
    names = ["no_at_fault_collision", "drivable_area", "driving_direction", "time_to_collision"]
    for name in names:
        assert rows[name].to_list() == chosen[name].to_list()
    assert rows["progress_raw"].to_list() == pytest.approx(chosen["progress_raw"], abs=2e-3)
    page, picture = tmp_path / "one.html", tmp_path / "one.png"
    command = ["show", str(pack), "--token", "straight-0"]
    assert cli.main([*command, "--html", str(page), "--png", str(picture)]) == 0
    assert is_png(picture) and "straight-0" in page.read_text()
    assert "scene straight-0, proposal" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, text", [(["--index", "5"], "--index is 5"), (["--token", "x"], "token 'x'")]
)
def test_show_names_a_scene_that_is_not_there(
    arguments: list[str], text: str, pack: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["show", str(pack), *arguments]) == 2
    assert text in capsys.readouterr().err


def test_a_checkout_on_the_path_has_no_version():
    assert runtime.version_of("numpy") == np.__version__
    assert runtime.version_of("no-such-package") == "not installed"
