"""`spdm sweep`: grids, the run folder, failures, shards; and its rows against single plans.

A cheap function stands in for the planner where the bookkeeping is under test. The slow tests run
the real one.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from polars.testing import assert_frame_equal

import sweep_child as child
import sweep_pack as packs
from spdm_experiments import cli, run_folder, sweep_stages, sweep_work, work
from spdm_experiments.inventory import Shard, take_inventory
from spdm_experiments.sweep_work import SweepEngine
from spdm_experiments.terminal import RateLine
from spdm_jax.io.scenario_file import read_scenario

COUNT = 7
TOKENS = [f"scene-{i:02d}" for i in range(COUNT)]


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert packs.write_pack(folder, COUNT) == TOKENS
    return folder


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_work, "read_scene", child.cheap_read)


def run(pack: Path, out: Path, *more: str) -> int:
    return cli.main(["sweep", str(pack), "--out", str(out), *more])


def rows(*outs: Path) -> polars.DataFrame:
    parts = [polars.read_parquet(out / "rows" / "part-*.parquet") for out in outs]
    return polars.concat(parts).drop("run_ms").sort("token", "point")


# --- the run folder


@pytest.mark.usefixtures("cheap")
def test_rows_hold_every_scene_at_every_point(pack: Path, tmp_path: Path):
    out = tmp_path / "run"
    more = ["--num-proposals", "15", "30", "--set", "idm.headway_time=1,2", "--chunk", "3"]
    assert run(pack, out, *more) == 0
    table = rows(out)
    assert table.height == COUNT * 4
    about = json.loads((out / "run.json").read_text())
    assert about["num_scenarios"] == COUNT and about["precision"] == "f32"
    assert about["suite"].endswith("(built-in scenes)") and about["seed"] == 0
    points = {p["point"]: p for p in about["points"]}
    speeds = {e.token: read_scenario(e.path)[0].ego for e in take_inventory_of(pack)}
    for row in table.iter_rows(named=True):
        point = points[row["point"]]
        assert row["num_proposals"] == point["num_proposals"] == row["num_valid"]
        assert row["idm.headway_time"] == point["idm.headway_time"]
        speed = speeds[row["token"]].vx[22]
        assert row["total"] == pytest.approx(0.01 * speed + point["idm.headway_time"], rel=1e-5)
        assert (row["status"], row["reason"]) == ("ok", "")
    scenario = read_scenario(pack / "scene-00.npz")[1]
    assert set(table["collision_agent"]) == {scenario.track_ids[0]}
    assert table["ttc_agent"].null_count() == table.height
    assert not list(out.glob("trajectories"))
    assert len(list((out / "rows").iterdir())) == 3


def take_inventory_of(folder: Path):
    return take_inventory(sorted(folder.glob("*.npz"))).entries


@pytest.mark.usefixtures("cheap")
def test_a_grid_of_values_is_one_program(pack: Path, tmp_path: Path):
    one, many = tmp_path / "one", tmp_path / "many"
    assert run(pack, one, "--chunk", "7") == 0
    values = ["--set", "idm.headway_time=1,1.3,1.7", "scoring.ttc_weight=3,4"]
    lists = ["--horizon", "6", "7", "--speeds", "0.1,0.2,0.3,0.4,0.5", "0.2,0.4,0.6,0.8,1"]
    assert run(pack, many, "--chunk", "7", *values, *lists) == 0
    about = [json.loads((out / "progress-all.json").read_text()) for out in (one, many)]
    assert rows(many).height == 24 * COUNT
    # A program of these shapes may be there from another test; a second one would show.
    assert [a["sessions"][0]["programs"] <= 1 for a in about] == [True, True]


@pytest.mark.usefixtures("cheap")
def test_double_precision_says_the_same(pack: Path, tmp_path: Path):
    single, double = tmp_path / "single", tmp_path / "double"
    assert run(pack, single) == run(pack, double, "--precision", "f64") == 0
    assert_frame_equal(rows(double), rows(single), rel_tol=1e-6)
    assert json.loads((double / "run.json").read_text())["precision"] == "f64"


@pytest.mark.usefixtures("cheap")
def test_folder_of_another_verb_is_left_alone(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "run.json").write_text('{"command": "plan"}')
    assert run(pack, tmp_path) == 2
    assert "another --out" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.usefixtures("cheap")
def test_trajectories_are_in_map_coordinates(pack: Path, tmp_path: Path):
    out = tmp_path / "run"
    assert run(pack, out, "--trajectories", "--chunk", "4", "--num-proposals", "15", "20") == 0
    origins = {e.token: read_scenario(e.path)[0].origin for e in take_inventory_of(pack)}
    seen = set()
    for path in sorted((out / "trajectories").glob("part-*.npz")):
        part = np.load(path)
        assert (out / "rows" / f"{path.stem}.parquet").exists()
        assert part["reference"].dtype == np.float64
        assert part["reference"].shape[1:] == part["tracked"].shape[1:] == (41, 3)
        for i, token in enumerate(part["token"].tolist()):
            seen.add((token, int(part["point"][i])))
            local = part["reference"][i, :, :2] - origins[token]
            twice = part["tracked"][i, :, :2] - origins[token]
            np.testing.assert_allclose(twice, 2 * local, atol=1e-6)
            np.testing.assert_allclose(part["reference"][i, :, 2], local[:, 0], atol=1e-6)
    assert seen == {(token, point) for token in TOKENS for point in (0, 1)}


@pytest.mark.usefixtures("cheap")
def test_finished_run_says_so_and_computes_nothing(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    out = tmp_path / "run"
    assert run(pack, out) == 0
    before = {path: path.stat().st_mtime_ns for path in (out / "rows").iterdir()}
    monkeypatch.setattr(SweepEngine, "process", lambda *_: pytest.fail("computed again"))
    assert run(pack, out, "--chunk", "2") == 0
    assert f"all {COUNT} scenarios were done already, 0 failed" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in (out / "rows").iterdir()}


FIRST = ["--num-proposals", "15", "--set", "idm.headway_time=1"]


@pytest.mark.usefixtures("cheap")
@pytest.mark.parametrize(
    "given, text",
    [
        (
            ["--num-proposals", "15", "--set", "idm.headway_time=2"],
            "points[0].idm.headway_time = 1.0, this command says 2.0",
        ),
        (
            ["--num-proposals", "15", "20", "--set", "idm.headway_time=1"],
            "number of points = 1, this command says 2",
        ),
        (["--num-proposals", "15"], "points[0].idm.headway_time = 1.0, this command says None"),
        (
            ["--speeds", "1", "--num-proposals", "15", "--set", "idm.headway_time=1"],
            "points[0].speed_fractions = [0.2, 0.4, 0.6, 0.8, 1.0], this command says [1.0]",
        ),
        (
            [*FIRST, "--tracker", "corrected"],
            "tracker = 'reference', this command says 'corrected'",
        ),
        ([*FIRST, "--precision", "f64"], "precision = 'f32', this command says 'f64'"),
        ([*FIRST, "--limit", "2"], f"num_scenarios = {COUNT}, this command says 2"),
        ([*FIRST, "--seed", "1"], "seed = 0, this command says 1"),
        ([*FIRST, "--trajectories"], "config.trajectories = False, this command says True"),
    ],
)
def test_another_run_in_the_same_folder_is_refused(
    given: list[str],
    text: str,
    pack: Path,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path_factory.getbasetemp() / "refusing"
    assert run(pack, out, *FIRST) == 0
    capsys.readouterr()
    assert run(pack, out, *given) == 2
    printed = capsys.readouterr().err
    assert text in printed and str(out / "run.json") in printed and "another --out" in printed


@pytest.mark.usefixtures("cheap")
def test_changed_files_are_refused_and_a_moved_folder_is_not(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, copy = tmp_path / "run", tmp_path / "copy"
    assert run(pack, out, "--limit", "3") == 0
    shutil.copytree(pack, copy)
    assert run(copy, out, "--limit", "3") == 0
    packs.write_pack(copy, 1, slow=1)
    assert run(copy, out, "--limit", "3") == 2
    assert "input_hash" in capsys.readouterr().err


@pytest.mark.usefixtures("cheap")
def test_other_versions_are_refused_and_another_commit_is_mentioned(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    assert run(pack, out) == 0
    about = json.loads((out / "run.json").read_text())
    about["commit"] = "0123456789ab"
    (out / "run.json").write_text(json.dumps(about))
    assert run(pack, out) == 0
    assert "note: commit was 0123456789ab" in capsys.readouterr().err
    about["versions"]["jax"] = "0.0.1"
    (out / "run.json").write_text(json.dumps(about))
    assert run(pack, out) == 2
    assert "versions.jax = '0.0.1'" in capsys.readouterr().err
    (out / "run.json").write_text("{")
    assert run(pack, out) == 2
    assert "run.json: not readable" in capsys.readouterr().err
    (out / "run.json").unlink()
    assert run(pack, out) == 2
    assert "has rows but no run.json" in capsys.readouterr().err


@pytest.mark.usefixtures("cheap")
def test_damaged_part_is_done_again(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "run"
    assert run(pack, out, "--chunk", "3") == 0
    before = rows(out)
    first, second, *_ = sorted((out / "rows").iterdir())
    first.write_bytes(first.read_bytes()[:100])
    short = polars.read_parquet(second)
    short.with_columns(point=polars.lit(7, polars.Int32)).write_parquet(second)
    (out / "rows" / ".part-all-g0-0.parquet.1.tmp").write_bytes(b"half")
    assert run(pack, out, "--chunk", "2") == 0
    errors = capsys.readouterr().err
    assert f"{first}: not readable" in errors
    assert_frame_equal(rows(out), before)
    assert len(list((out / "rows").glob("*.damaged"))) == 2
    assert not list((out / "rows").glob(".*"))


@pytest.mark.usefixtures("cheap")
def test_scenario_in_two_parts_is_an_error(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    assert run(pack, out) == 0
    (part,) = (out / "rows").iterdir()
    shutil.copy(part, part.with_name("part-copy.parquet"))
    assert run(pack, out) == 2
    assert "both hold scenario 'scene-00'" in capsys.readouterr().err


def test_two_processes_cannot_share_scenarios(tmp_path: Path):
    whole, first, second = (Shard.parse(text) for text in ("1/1", "1/2", "2/2"))
    with run_folder.alone(tmp_path, first), run_folder.alone(tmp_path, second):
        for other in (whole, first):
            with pytest.raises(ValueError, match="at work on these"):
                with run_folder.alone(tmp_path, other):
                    pass
    with run_folder.alone(tmp_path, whole):
        pass


# --- failures


@pytest.mark.usefixtures("cheap")
def test_failures_are_rows_with_reasons(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    copy, out = tmp_path / "copy", tmp_path / "run"
    shutil.copytree(pack, copy)
    packs.write_pack(copy, 1, slow=1)  # the cheap function lets it overflow
    (copy / "scene-01.npz").write_bytes(b"PK no archive")
    call = SweepEngine._call

    def not_finite(self: Any, *given: Any) -> Any:
        reading, run_ms = call(self, *given)
        finite = reading.finite.copy()
        finite[2, 0] = False
        return reading.replace(finite=finite), run_ms

    load_chunk = work.load_chunk

    def loading(*given: Any) -> Any:
        (copy / "scene-05.npz").write_bytes(b"gone meanwhile")
        return load_chunk(*given)

    monkeypatch.setattr(SweepEngine, "_call", not_finite)
    monkeypatch.setattr("spdm_experiments.grid_run.load_chunk", loading)
    assert run(copy, out, "--num-proposals", "20", "30") == 1
    table = rows(out)
    assert table.height == 2 * COUNT
    status = {token: part["status"].to_list() for (token,), part in table.group_by("token")}
    assert status == {
        "scene-00": ["overflow", "overflow"],
        "scene-01": ["failed", "failed"],
        "scene-02": ["ok", "ok"],
        "scene-03": ["failed", "ok"],
        "scene-04": ["ok", "ok"],
        "scene-05": ["failed", "failed"],
        "scene-06": ["ok", "ok"],
    }
    bad = table.filter(polars.col("status") != "ok")
    assert bad["total"].null_count() == bad["best"].null_count() == bad.height
    assert (bad["reason"].str.len_chars() > 20).all()
    assert bad.filter(token="scene-01")["log_name"].null_count() == 2
    assert bad.filter(token="scene-05")["log_name"].null_count() == 0
    printed = capsys.readouterr().out
    assert f"{COUNT} of {COUNT} scenarios done, 4 failed" in printed
    assert "  scene-01: " in printed and "damaged scenario file" in printed


@pytest.mark.usefixtures("cheap")
def test_folder_of_useless_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "scene.npz").write_bytes(b"nothing")
    assert run(tmp_path, tmp_path / "run") == 2
    assert "no usable scenario" in capsys.readouterr().err


# --- shards


@pytest.mark.usefixtures("cheap")
def test_shards_together_are_the_whole(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    more = ["--num-proposals", "15", "20", "--chunk", "2"]
    whole, shared = tmp_path / "whole", tmp_path / "shared"
    assert run(pack, whole, *more) == 0
    alone = []
    for i in (1, 2, 3):
        alone.append(tmp_path / f"shard-{i}")
        for out in (alone[-1], shared):
            assert run(pack, out, *more, "--shard", f"{i}/3") == 0
    assert "of shard 3/3 done" in capsys.readouterr().out
    assert all(rows(out).height < rows(whole).height for out in alone)
    assert_frame_equal(rows(*alone), rows(whole))
    assert_frame_equal(rows(shared), rows(whole))
    assert len(list(shared.glob("progress-*.json"))) == 3
    assert run(pack, shared, *more) == 0
    assert f"all {COUNT} scenarios were done already" in capsys.readouterr().out


def test_progress_line_has_rate_compilation_and_time_left():
    line = RateLine(1118, 12)
    assert line.text(412, 3.1, 2, 10.47) == (
        "412/1118 scenes  38.2 scenes/s  compile 3.1 s (2 programs)  eta 0:18"
    )
    assert line.text(12, 0.0, 1, 5.0) == "12/1118 scenes  compile 0.0 s (1 program)"


@pytest.mark.slow
def test_stage_times(pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sweep_stages, "SCENES", 2)
    out = tmp_path / "run"
    more = ["--planner", "pdm-closed", "--num-proposals", "3", "--stage-times"]
    assert run(pack, out, *more) == 0
    table = polars.read_parquet(out / "stages.parquet")
    assert table["stage"].to_list() == ["proposals", "tracking", "scoring", "total"] * 2
    assert table["token"].n_unique() == 2 and set(table["num_proposals"]) == {3}
    assert (table["min_ms"] > 0).all() and (table["min_ms"] <= table["median_ms"]).all()
    total = table.filter(stage="total")["min_ms"].to_numpy()
    assert (table.filter(stage="tracking")["min_ms"].to_numpy() < total).all()
    monkeypatch.setattr(sweep_stages, "stages", lambda *_: pytest.fail("timed again"))
    assert run(pack, out, *more) == 0
