"""`spdm simulate`: points, rows, the run folder, suites and reports, on drives of 2 s."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars
import pytest
from polars.testing import assert_frame_equal

import small_road as roads
from browser import Page, run_scripts
from small_road import Thing
from spdm_experiments import cli, simulate_rows
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import load_run, summarise
from spdm_experiments.report_page import page_data
from spdm_experiments.simulate_points import make_points
from spdm_experiments.simulate_scene import Result
from spdm_experiments.simulate_scenes import find_scenes
from spdm_experiments.simulate_work import SimulateEngine
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.metrics import OPEN_LOOP_SCORED, SCORED
from spdm_jax.types import ObjectType

SAMPLES = roads.NUM_ITERATIONS - 1
FRONT = roads.EGO_X + roads.FRONT
WORLDS: dict[str, dict[str, Any]] = {
    "clear": {},
    "crash": {"things": [Thing(FRONT + 2.3 + 8.0, -3.5, id="parked")]},
    "fast": {"speed": 17.0},
    "lead": {"things": [Thing(FRONT + 20.0, -3.5, speed=10.0, id="lead")]},
    "slow": {"speed": 5.0},
}
"""Straight roads; in "crash" a parked car stands 8 m ahead of an ego at 10 m/s."""
DRIVERS = ["--planner", "constant-velocity", "log-replay", "--traffic", "replay"]


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    for token, world in WORLDS.items():
        raw = dataclasses.replace(
            roads.road(token=token, **world), scenario_type=token[0] + "-type"
        )
        write_scenario(folder / f"{token}.npz", *build_scenario(raw))
    return folder


@pytest.fixture(scope="module")
def whole(pack: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted, recorded."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run(pack, out, *DRIVERS, "--record", "plans") == 0
    return out


def run(pack: Path, out: Path, *more: str) -> int:
    return cli.main(["simulate", str(pack), "--out", str(out), *more])


def rows(*outs: Path) -> polars.DataFrame:
    parts = [polars.read_parquet(out / "rows" / "part-*.parquet") for out in outs]
    return polars.concat(parts).drop("run_ms").sort("token", "point")


# --- points


def points(**options: Any) -> list[dict[str, Any]]:
    made = make_points(Simulate(scenes=Path("packed"), **options))
    return [point.entry(number) for number, point in enumerate(made)]


def test_points_are_a_product():
    found = points(
        planner=("pdm-closed", "spdm", "idm"),
        num_proposals=(15, 30),
        traffic=("reactive", "replay"),
        forecast=("none",),
    )
    names = [(p["planner"], p["num_proposals"], p["traffic"]) for p in found]
    assert names == [
        (planner, count, traffic)
        for traffic in ("reactive", "replay")
        for planner, counts in (("PDM-Closed", (15, 30)), ("SPDM", (15, 30)), ("IDM", (None,)))
        for count in counts
    ]
    assert {p["forecast"] for p in found} == {"none", None}
    assert {p["mode"] for p in found} == {"closed"}


def test_open_loop_has_one_kind_of_traffic():
    found = points(mode=("closed", "open"), traffic=("reactive", "replay"))
    names = [(p["mode"], p["traffic"]) for p in found]
    assert names == [("closed", "reactive"), ("closed", "replay"), ("open", "replay")]
    assert [p["traffic"] for p in points(mode=("open",))] == ["replay"]
    with pytest.raises(ValueError, match="--mode open repeats the recorded drive"):
        points(mode=("open",), traffic=("reactive",))
    with pytest.raises(ValueError, match="17"):
        points(num_proposals=(17,))


def test_unknown_planner_is_refused_with_a_list(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        cli.main(["simulate", "common-14", "--planner", "pdm-open"])
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert "constant-velocity" in printed.out + printed.err


# --- rows


def test_rows_say_how_the_drive_went(whole: Path):
    table = rows(whole)
    assert table.height == 2 * len(WORLDS)
    assert set(table["status"]) == {"ok"} and set(table["samples"]) == {SAMPLES}
    assert set(table["planner"]) == {"Constant velocity", "Log replay"}
    assert table["num_proposals"].null_count() == table.height
    assert (table["mode"] == "closed").all() and (table["traffic"] == "replay").all()
    for name in OPEN_LOOP_SCORED:
        assert table[name].null_count() == table.height
    by = {(r["token"], r["point"]): r for r in table.iter_rows(named=True)}
    clear = by["clear", 0]
    # A drive ends a step before the record does, and its first step counts for nothing.
    ratio = (SAMPLES - 1) / SAMPLES
    assert clear["ego_progress_along_expert_route"] == pytest.approx(ratio, abs=1e-3)
    assert clear["score"] == pytest.approx((5 * ratio + 11) / 16, abs=1e-3)
    assert [point["metric"] for point in clear["lost"]] == ["ego_progress_along_expert_route"]
    assert clear["mean_speed"] == pytest.approx(10.0, abs=0.01)
    assert clear["progress_m"] == pytest.approx(ratio * clear["expert_progress_m"], rel=1e-3)
    assert clear["collisions"] == 0 and clear["collision_time"] is None
    crash = by["crash", 0]
    assert crash["no_ego_at_fault_collisions"] == crash["score"] == 0
    assert crash["collisions"] == 1
    assert crash["collision_time"] == pytest.approx(0.8, abs=0.11)
    assert crash["collision_object"] == "parked" and crash["collision_object_type"] == "vehicle"
    lost = crash["lost"][0]
    assert lost["metric"] == "no_ego_at_fault_collisions" and lost["object"] == "parked"
    assert lost["time"] == pytest.approx(crash["collision_time"])
    assert by["fast", 0]["speed_limit_violations"] == 1
    assert by["fast", 0]["speed_limit_compliance"] < 1
    for (token, point), row in by.items():
        gates = np.prod([row[name] for name in SCORED[:4]])
        terms = sum(w * row[n] for w, n in zip((5, 5, 4, 2), SCORED[4:], strict=True)) / 16
        assert row["score"] == pytest.approx(gates * terms, abs=1e-5), (token, point)


@pytest.mark.slow
def test_scenes_do_not_depend_on_their_neighbours(pack: Path, whole: Path, tmp_path: Path):
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(pack / "crash.npz", alone)
    assert run(alone, tmp_path / "run", *DRIVERS, "--chunk", "1") == 0
    found, expected = rows(tmp_path / "run"), rows(whole).filter(token="crash")
    assert_frame_equal(found, expected)


def test_the_run_is_recorded(whole: Path, pack: Path):
    parts = [np.load(path) for path in sorted((whole / "histories").glob("part-*.npz"))]
    assert sum(len(part["token"]) for part in parts) == 2 * len(WORLDS)
    for part in parts:
        ego, plans, time = part["ego"], part["plans"], part["time"]
        assert ego.shape[1:] == (SAMPLES, 11) and plans.shape[1:] == (SAMPLES, 17, 3)
        assert ego.dtype == plans.dtype == np.float32 and part["origin"].dtype == np.float64
        np.testing.assert_allclose(plans[:, :, 0], ego[:, :, :3], atol=1e-3)
        np.testing.assert_allclose(time, 0.1 * np.arange(SAMPLES)[None].repeat(len(ego), 0))
        for i, token in enumerate(part["token"].tolist()):
            speed = WORLDS[token].get("speed", 10.0)
            np.testing.assert_allclose(ego[i, :, 3], speed, atol=0.05)
            there = part["object_valid"][i].any(axis=0)
            assert there.sum() == len(WORLDS[token].get("things", ()))
            assert set(part["object_id"][i][there]) <= {"parked", "lead"}
            assert (part["object_type"][i][there] == ObjectType.VEHICLE).all()
    plain = whole.parent / "plain"
    assert run(pack, plain, *DRIVERS, "--limit", "1") == 0
    assert not (plain / "histories").exists()


def test_open_loop_compares_plans(pack: Path, tmp_path: Path):
    more = ["--planner", "constant-velocity", "--mode", "open"]
    assert run(pack, tmp_path / "run", *more, "--limit", "2") == 0
    table = rows(tmp_path / "run")
    # The recorded ego keeps its speed, so that the plan is right.
    np.testing.assert_allclose(table["score"], 1.0, atol=1e-3)
    np.testing.assert_allclose(table["ade"], 0.0, atol=1e-2)
    for name in OPEN_LOOP_SCORED:
        np.testing.assert_allclose(table[name], 1.0, atol=1e-3)
    assert table["no_ego_at_fault_collisions"].null_count() == 2
    assert table["lost"].null_count() == 2


class Metrics(SimpleNamespace):
    pass


def one(**changes: Any) -> Result:
    metrics = Metrics(scores=np.ones(8), final=np.array(1.0))
    fields = {"metrics": metrics, "time": None, "samples": np.array(7), "kept": None}
    flags = {name: np.array(False) for name in ("failed", "overflow", "short")}
    return cast(Result, SimpleNamespace(**{**fields, **flags, **changes}))


@pytest.mark.parametrize(
    "changes, status, reason",
    [
        ({}, "ok", ""),
        ({"overflow": np.array(True)}, "overflow", "there is room for"),
        ({"failed": np.array(True)}, "failed", "not finite after 0.7 s"),
        ({"short": np.array(True)}, "failed", "the record ends before"),
        (
            {"metrics": Metrics(scores=np.array([1.0] * 7 + [np.nan]))},
            "failed",
            "ego_is_comfortable could not be computed: the run has 7 samples",
        ),
    ],
)
def test_drives_that_cannot_be_scored_have_a_reason(changes, status, reason):
    found = simulate_rows._status(one(**changes), "closed")
    assert found[0] == status and reason in found[1]


def test_failures_are_rows_with_reasons(
    pack: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    copy, out = tmp_path / "copy", tmp_path / "run"
    shutil.copytree(pack, copy)
    (copy / "slow.npz").write_bytes(b"PK no archive")
    still = dataclasses.replace(roads.road(token="still"), num_iterations=1)
    write_scenario(copy / "still.npz", *build_scenario(still))
    assert run(copy, out, *DRIVERS) == 1
    table = rows(out)
    bad = table.filter(polars.col("status") != "ok")
    assert bad["token"].to_list() == ["slow", "slow", "still", "still"]
    assert "damaged scenario file" in bad["reason"][0] and "1 iteration" in bad["reason"][2]
    assert bad["score"].null_count() == 4
    good = rows(whole).filter(polars.col("token") != "slow")
    assert_frame_equal(table.filter(status="ok"), good)
    assert "6 of 6 scenarios done, 2 failed" in capsys.readouterr().out


# --- the run folder


def test_a_stopped_run_goes_on(
    pack: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    out, process, done = tmp_path / "run", SimulateEngine.process, []

    def stopping(self: Any, loaded: Any) -> Any:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(loaded.chunk.name)
        return process(self, loaded)

    given = [*DRIVERS, "--chunk", "1", "--record", "plans"]
    with monkeypatch.context() as patch:
        patch.setattr(SimulateEngine, "process", stopping)
        assert run(pack, out, *given) == 130
    assert "go on with: spdm simulate" in capsys.readouterr().err
    before = {path: path.stat().st_mtime_ns for path in (out / "rows").iterdir()}
    assert len(before) == 2
    # What a kill between the two files of a part leaves.
    (out / "histories" / "part-all-g0-0000.npz").write_bytes(b"half")
    assert run(pack, out, *given) == 0
    assert before.items() <= {p: p.stat().st_mtime_ns for p in (out / "rows").iterdir()}.items()
    assert_frame_equal(rows(out), rows(whole))
    assert len(list((out / "histories").iterdir())) == len(WORLDS)
    monkeypatch.setattr(SimulateEngine, "process", lambda *_: pytest.fail("computed again"))
    capsys.readouterr()
    assert run(pack, out, *given, "--by-type") == 0
    printed = capsys.readouterr().out
    assert f"all {len(WORLDS)} scenarios were done already" in printed and "c-type" in printed


@pytest.mark.parametrize(
    "given, text",
    [
        (DRIVERS[:2] + DRIVERS[3:], "number of points = 2, this command says 1"),
        ([*DRIVERS[:3], "--traffic", "reactive"], "points[0].traffic = 'replay'"),
        ([*DRIVERS, "--replan-every", "2"], "config.replan_every = 1, this command says 2"),
        ([*DRIVERS, "--record", "history"], "config.record = 'plans'"),
        ([*DRIVERS, "--types", "c-type"], "types"),
        ([*DRIVERS, "--precision", "f64"], "precision = 'f32'"),
    ],
)
def test_another_run_in_the_same_folder_is_refused(
    given: list[str], text: str, pack: Path, whole: Path, capsys: pytest.CaptureFixture[str]
):
    record = [] if "--record" in given else ["--record", "plans"]
    assert run(pack, whole, *given, *record) == 2
    assert text in capsys.readouterr().err


def test_shards_together_are_the_whole(pack: Path, whole: Path, tmp_path: Path):
    shared = tmp_path / "shared"
    for i in (1, 2):
        assert run(pack, shared, *DRIVERS, "--record", "plans", "--shard", f"{i}/2") == 0
    assert_frame_equal(rows(shared), rows(whole))
    assert len(list(shared.glob("progress-*.json"))) == 2


# --- scenarios


def test_types_and_limit_select_scenarios(pack: Path):
    found = find_scenes(Simulate(scenes=pack, types=("c-type", "f-type"), limit=2))
    assert [entry.token for entry in found.inventory.entries] == ["clear", "crash"]
    with pytest.raises(ValueError, match="--types x: no scenario of it; there are c-type, f-type"):
        find_scenes(Simulate(scenes=pack, types=("x",)))
    with pytest.raises(ValueError, match="built-in suites are common-14, interactive-8"):
        find_scenes(Simulate(scenes=Path("common-15")))


def test_a_suite_is_packed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    options = Simulate(scenes=Path("common-14"), types=("high_magnitude_speed",), limit=2)
    found = find_scenes(options)
    tokens = [entry.token for entry in found.inventory.entries]
    assert found.suite == "common-14"
    assert tokens == ["high_magnitude_speed-00", "high_magnitude_speed-01"]
    assert {entry.num_iterations for entry in found.inventory.entries} == {151}
    before = {path: path.stat().st_mtime_ns for path in found.folder.glob("*.npz")}
    assert len(before) == 2 and found.folder.is_relative_to(tmp_path)
    again = find_scenes(options)
    assert again.inventory.digest == found.inventory.digest
    assert before == {path: path.stat().st_mtime_ns for path in found.folder.glob("*.npz")}
    with pytest.raises(ValueError, match="--types x: no scenario of it"):
        find_scenes(Simulate(scenes=Path("common-14"), types=("x",)))


def test_a_suite_is_packed_like_any_source(tmp_path: Path):
    assert cli.main(["pack", "interactive-8", str(tmp_path / "first"), "--limit", "2"]) == 0
    further = ["--seeds", "12", "--limit", "1"]
    assert cli.main(["pack", "interactive-8", str(tmp_path / "more"), *further]) == 0
    names = lambda name: sorted(path.stem[-3:] for path in (tmp_path / name).glob("*.npz"))
    assert names("first") == ["-00", "-01"] and names("more") == ["-12"]


# --- the report


def by_score(token: str, table: polars.DataFrame) -> float:
    return table.filter(token=token, point=0)["score"].item()


def test_report_of_a_simulation(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    page = tmp_path / "page.html"
    assert cli.main(["report", str(whole), "--out", str(page), "--players", "3"]) == 0
    assert "2 grid points, 5 scenarios, 0 failed" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    parsed = Page(text)
    assert parsed.open == [] and "{{" not in text
    data = json.loads(parsed.scripts[0])
    assert data["title"].startswith("Simulation report")
    assert [term["key"] for term in data["terms"]] == ["total", *SCORED]
    table = rows(whole)
    for number, point in enumerate(data["points"]):
        mine = table.filter(point=number)
        assert point["means"]["total"] == pytest.approx(mine["score"].mean(), abs=1e-4)
        assert point["parameters"]["num_proposals"] == "–"
    assert {line["name"] for line in data["axes"][0]["lines"]} == {
        "Constant velocity",
        "Log replay",
    }
    (types,) = data["types"]
    assert [(t["type"], t["scenarios"]) for t in types] == [
        ("c-type", 2),
        ("f-type", 1),
        ("l-type", 1),
        ("s-type", 1),
    ]
    assert types[0]["means"] == pytest.approx([0.5 * by_score("clear", table)] * 2, abs=1e-4)
    worst = data["lists"][0]["rows"][0]
    assert worst["token"] == "crash" and worst["term"] == "No at-fault collision"
    assert "with vehicle parked at 0." in worst["reason"]
    player = json.loads(Page(json.loads(parsed.scripts[1])).scripts[0])
    assert [scene["token"] for scene in player["scenes"]] == data["player"]["tokens"]
    crash = next(scene for scene in player["scenes"] if scene["token"] == "crash")
    drive = crash["drives"][0]
    assert drive["name"] == "Constant velocity" and len(drive["speed"]) == SAMPLES
    assert len(drive["ego"]) == 3 * SAMPLES and len(drive["plans"]) == SAMPLES
    assert [o["id"] for o in drive["objects"]] == ["parked"] == [drive["lost"][0]["object"]]
    assert crash["map"]["road"] and crash["map"]["lane_edges"]
    # The way of the ego lies on the road of the map.
    road = np.array(crash["map"]["road"][0]).reshape(-1, 2)
    ego = np.array(drive["ego"]).reshape(-1, 3)[:, :2]
    assert (ego > road.min(axis=0)).all() and (ego < road.max(axis=0)).all()


def test_the_player_shows_drives_and_lost_points(whole: Path, tmp_path: Path):
    page, player = tmp_path / "page.html", tmp_path / "player.html"
    assert cli.main(["report", str(whole), "--out", str(page)]) == 0
    scripts = Page(page.read_text(encoding="utf-8")).scripts
    player.write_text(json.loads(scripts[1]), encoding="utf-8")
    told = run_scripts(
        player,
        """
        const found = { scenes: data.scenes.map((s) => s.token) };
        showScene(found.scenes.indexOf("crash"));
        found.scores = nodes.scores.text();
        found.lost = nodes.lost.text();
        nodes.marks.children[0].fire("click");
        found.clock = nodes.clock.textContent;
        for (let i = 0; i < 40; i += 1) setStep(i);
        found.last = state.step;
        nodes.fit.fire("click");
        nodes.canvas.fire("pointerdown", { clientX: 1, clientY: 1 });
        nodes.canvas.fire("pointermove", { clientX: 9, clientY: 1 });
        nodes.canvas.fire("wheel", { deltaMode: 0, deltaY: 50 });
        found.follows = state.follow;
        nodes.after.fire("click");
        found.other = sceneNow().token;
        showDrive(1);
        found.drive = nodes.scores.text();
        return { ...found, drawn: drawn.fill > 100 && drawn.stroke > 100 };
        """,
    )
    assert told["scenes"][0] == "crash" and len(told["scenes"]) == len(WORLDS)
    assert told["scores"].startswith("Constant velocity: 0.000")
    assert "No at-fault collision: collision at fault" in told["lost"]
    assert told["clock"].startswith("0.") and "10.0 m/s" in told["clock"]
    assert told["last"] == SAMPLES - 1 and not told["follows"] and told["drawn"]
    assert told["other"] != "crash" and told["drive"].startswith("Log replay")


@pytest.mark.slow
def test_two_simulations_are_compared(pack: Path, whole: Path, tmp_path: Path):
    other = tmp_path / "other"
    assert run(pack, other, *DRIVERS, "--limit", "3") == 0
    data = page_data([load_run(whole), load_run(other)])
    assert [pair["scenarios"] for pair in data["paired"]] == [3, 3]
    assert [pair["ties"] for pair in data["paired"]] == [3, 3]
    assert summarise(load_run(other))[0].scenarios == 3


def test_programs_are_shared_by_all_scenes(whole: Path):
    about = json.loads((whole / "progress-all.json").read_text())
    assert about["finished"] and about["done"] == len(WORLDS)
    assert about["sessions"][0]["programs"] <= 2


@pytest.mark.slow
def test_padding_changes_nothing(pack: Path, whole: Path, tmp_path: Path, monkeypatch):
    from spdm_experiments import grid_run

    group = grid_run.group_of

    def larger(options: Any, padding: Any, *given: Any, **more: Any) -> Any:
        sizes = {name: (2 * getattr(padding, name)[0],) for name in ("lanes", "tracks")}
        return group(options, dataclasses.replace(padding, **sizes), *given, **more)

    monkeypatch.setattr("spdm_experiments.simulate.group_of", larger)
    assert run(pack, tmp_path / "run", *DRIVERS) == 0
    assert_frame_equal(rows(tmp_path / "run"), rows(whole), abs_tol=1e-5)


@pytest.mark.slow
def test_scenarios_that_lack_room_are_driven_again(tmp_path: Path, monkeypatch):
    ahead = [Thing(FRONT + way, -3.5, speed=10.0, id=f"lead-{way}") for way in (20.0, 40.0)]
    (tmp_path / "pack").mkdir()
    for token, things in (("one", ahead[:1]), ("two", ahead)):
        raw = roads.road(token=token, things=things)
        write_scenario(tmp_path / "pack" / f"{token}.npz", *build_scenario(raw))
    drivers = ["--planner", "constant-velocity", "--traffic", "reactive"]
    assert run(tmp_path / "pack", tmp_path / "usual", *drivers) == 0
    monkeypatch.setattr("spdm_experiments.simulate_work.MAX_AGENTS", 1)
    assert run(tmp_path / "pack", tmp_path / "again", *drivers) == 0
    assert_frame_equal(rows(tmp_path / "again"), rows(tmp_path / "usual"), abs_tol=1e-5)
    told = json.loads((tmp_path / "again" / "progress-all.json").read_text())
    assert told["sessions"][0]["programs"] == 2


@pytest.mark.slow
def test_a_planner_drives_a_suite(tmp_path: Path):
    more = ["--planner", "pdm-closed", "--num-proposals", "3", "--limit", "1"]
    out = tmp_path / "run"
    assert run(Path("common-14"), out, *more, "--types", "high_magnitude_speed") == 0
    (row,) = rows(out).iter_rows(named=True)
    assert row["samples"] == 150 and row["traffic"] == "reactive"
    assert row["score"] > 0.5 and row["num_proposals"] == 3


@pytest.mark.slow
def test_a_cluster_computes_the_same(pack: Path, whole: Path, tmp_path: Path):
    pytest.importorskip("ray")
    out = tmp_path / "run"
    more = ["--record", "plans", "--cluster", "local:1", "--chunk", "2"]
    # In a process of its own, which takes the cluster down with it.
    start = [sys.executable, "-m", "spdm_experiments.cli", "simulate", str(pack)]
    subprocess.run([*start, "--out", str(out), *DRIVERS, *more], check=True, capture_output=True)
    assert_frame_equal(rows(out), rows(whole), abs_tol=1e-5)
    assert len(list((out / "histories").iterdir())) == 3
