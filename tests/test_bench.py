"""The benchmark's scenes, its page and its bookkeeping (made-up figures, nothing is timed)."""

import json
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import jax
import numpy as np
import pytest

from navsim_stand_in import metric_cache, replay, road_scene
from spdm_experiments import (
    bench,
    bench_drives,
    bench_learned,
    bench_navsim,
    bench_page,
    bench_process,
    bench_rows,
    bench_scenes,
    bench_watch,
)
from spdm_jax import from_raw
from spdm_jax.io.raw import ScenarioError
from spdm_jax.navsim.navsim_export import export, write
from spdm_jax.synthetic.suites import SUITES
from spdm_jax.types import SubScores

ABOUT = {
    "command": "python -m spdm_experiments.bench --page x.md",
    "commit": "abc123",
    "date": "2026-01-02T03:04:05+00:00",
    "machine": "Some Processor",
    "cores": 2,
    "device": "cpu",
    "suite": "crowded_crossing (generated), seeds from 0",
    "seed": 0,
    "python": "3.11.1",
    "versions": {"jax": "0.10.2", "numpy": "2.3.0"},
}
APART = {
    "first call, SPDM 60": {"cold_s": 5.0, "warm_s": 0.6, "import_s": 1.0, "repetitions": 3},
    "first drive, reactive": {"cold_s": 31.0, "warm_s": 1.5, "import_s": 1.0, "repetitions": 3},
    "memory, 4096 trajectories": {"before_mb": 200.0, "peak_mb": 400.0},
    "memory, 16 scenes": {"before_mb": 200.0, "peak_mb": 500.0},
    "memory, 256 scenes": {"before_mb": 200.0, "peak_mb": 1200.0},
    "sweep": {
        "scenes": 64,
        "ratio": 1.2,
        "end_to_end_ms": 12.0,
        "kernel_ms": 10.0,
        "yardstick_ms": 20.0,
    },
}


DRIVES = {
    "traffic": "reactive",
    "seconds": 15.0,
    "suite": "common-14",
    "kinds": 8,
    "num_proposals": 60,
}


def row(workload: str, median: float, **more) -> dict:
    return {
        "workload": workload,
        "precision": "f32",
        "cores": 2,
        "device": "cpu",
        "platform": "cpu",
        "objects": 64,
        "polygons": 90,
        "edges": 15000,
        "first_call_s": 1.5,
        "median_ms": median,
        "min_ms": median / 2,
        "cpu_ms": 2 * median,
        "yardstick_ms": 20.0,
        "repetitions": 15,
        **more,
    }


def made_up_rows() -> list[dict]:
    failing = {name: 0.25 for name in bench_rows.METRICS}
    stage = row("SPDM 60: track", 0.125)
    del stage["first_call_s"]
    return [
        *(
            row(f"{n} drive(s), reactive", 500.0 + 750.0 * n, **DRIVES, drives=n)
            for n in (1, 8, 32)
        ),
        row("PDM-Closed 15", 3.0, failing=failing),
        row("SPDM 60", 9.0, failing=failing),
        stage,
        *(row(f"track + score {n}", n / 40, curve="trajectories", x=n) for n in (64, 1024, 4096)),
        *(
            row(f"{n} scenes x 60", 3.0 * n, curve="scenes", x=n, num_proposals=60)
            for n in (1, 16, 64)
        ),
        row("SPDM 60", 17.25, precision="f64"),
        row("SPDM 60", 13.75, cores=1),
    ]


def line_with(text: str, words: str) -> str:
    lines = [line for line in text.splitlines() if words in line]
    assert lines, words
    return lines[0]


def test_page_says_what_was_reached_and_where(tmp_path: Path):
    page = tmp_path / "new" / "performance.md"
    written = bench_page.write_page(page, ABOUT, made_up_rows(), APART)
    assert written == [page, page.with_name("performance_curves.svg")]
    text = page.read_text(encoding="utf-8")
    for fact in (ABOUT["command"], "abc123", ABOUT["date"], "Some Processor", "jax 0.10.2"):
        assert fact in text
    reached = {
        "one PDM-Closed step": "yes",
        "one SPDM step": "no",
        "track + score 4,096": "no",
        "64 scenarios x N_p = 60": "yes",
        "end to end over kernels": "yes",
        "first call, SPDM 60, cold cache": "yes",
        "first call, SPDM 60, warm cache": "no",
        "peak memory, 4096 trajectories": "yes",
        "peak memory, 256 scenes": "no",
        "most scenes over that of the fewest": "no",
    }
    for words, answer in reached.items():
        assert line_with(text, words).endswith(f"| {answer} |"), words
    assert "3.0 / 1.5 ms | 20.0 ms | 0.15 |" in line_with(text, "one PDM-Closed step")
    drives = text[text.index("## Closed loop") : text.index("## Other precision")]
    assert "SPDM 60 through 15 s" in drives
    expected = ["1 | 1 s | 1.25 / 0.62 s | 62 | no", "8 | 1 s | 0.81 / 0.41 s | 41 | yes"]
    expected += ["first drive, cold cache | 30 s | 31.00 s |  | no"]
    expected += ["first drive, warm cache | 2 s | 1.50 s |  | yes"]
    for words in expected:
        assert f"| reactive | {words} |" in drives
    columns = text[text.index("## Other precision") :]
    assert "17.2 / 8.6 | 13.8 / 6.9" in line_with(columns, "one SPDM step")
    assert line_with(text, "| track |") == "| track | 0.12 |"
    assert "0.250" in line_with(text[text.index("## All rows") :], "| PDM-Closed 15 |")
    assert text.rstrip().endswith(bench_page.KEPT)


def test_page_without_drives_has_no_section_of_them(tmp_path: Path):
    rows = [row for row in made_up_rows() if "drives" not in row]
    bench_page.write_page(tmp_path / "page.md", ABOUT, rows, {})
    assert "## Closed loop" not in (tmp_path / "page.md").read_text(encoding="utf-8")


def test_page_shows_learned_planners_beside_torch(tmp_path: Path):
    rows = made_up_rows()
    bench_page.write_page(tmp_path / "page.md", ABOUT, rows, {})
    assert "## Learned" not in (tmp_path / "page.md").read_text(encoding="utf-8")
    rows += [
        row("GameFormer forward, batch 32", 2000.0, network="GameFormer", batch=32),
        row("DTPP, one drive", 9000.0, planner="DTPP", seconds=14.9, suite="common-14"),
    ]
    bench_page.write_page(tmp_path / "page.md", ABOUT, rows, {})
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "| GameFormer | 32 | 2000.0 / 1000.0 | 100.0 | 174 |" in text
    assert "| DTPP | 9.0 | 2 |" in text


def test_page_shows_frames_of_navsim(tmp_path: Path):
    counts = {"objects": 84, "polygons": 381, "num_proposals": 4096}
    rows = [
        *made_up_rows(),
        row("navsim1 4096, x", 200.0, **counts, frames=1, recorded=True),
        row("navsim2 4096, x", 320.0, **counts, frames=1, recorded=True),
        row("navsim2 64 x 64", 800.0, frames=64, num_proposals=64),
    ]
    bench_page.write_page(tmp_path / "page.md", ABOUT, rows, {})
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "recorded | 84 / 381 | 1 x 4,096 | 250 ms | 200.0 / 100.0 ms" in text
    assert line_with(text, "| 300 ms |").endswith("| 16.00 | 12,800 | no |")
    assert line_with(text, "| 64 x 64 |").endswith("| 40.00 | 5,120 |  |")


@pytest.mark.slow
def test_recorded_frames_are_scored_by_what_they_serve(tmp_path: Path):
    scene = road_scene()
    for devkit, samples in (("v1", 51), ("v2", 41)):
        cache = metric_cache(replay(scene, samples), devkit)
        write(tmp_path / f"{devkit}.npz", export(cache, devkit))
    child = bench_rows.Child(bench_rows.SIZES["quick"], "f32", tmp_path)
    bench_navsim.recorded_frames(child, bench_rows.fan(4))
    first, second = child.rows
    assert (first["workload"], second["workload"]) == ("navsim1 4, v1", "navsim2 4, v2")
    assert first["polygons"] == len(scene["map_kind"]) and first["recorded"]
    assert 0 < first["mean_score"] <= 1
    (tmp_path / "v1.npz").write_bytes(b"no frame")
    with pytest.raises(ScenarioError, match=r"v1\.npz"):
        bench_navsim.recorded_frames(child, bench_rows.fan(4))


def test_frames_that_are_not_there_are_refused(tmp_path: Path, capsys):
    with pytest.raises(SystemExit):
        bench.main(["--frames", str(tmp_path), "--out", str(tmp_path / "out")])
    assert "holds no .npz file" in capsys.readouterr().err


@pytest.mark.slow
def test_networks_of_the_benchmark_run():
    for network in bench_learned.networks(16).values():
        params = network.init(jax.random.key(0))
        output = network.compiled()(params, network.inputs(2))
        for leaf in jax.tree.leaves(output):
            assert np.isfinite(leaf).all()


def test_page_keeps_what_people_wrote(tmp_path: Path):
    page = tmp_path / "performance.md"
    page.write_text(f"# Old\n\n{bench_page.KEPT}\n\nThe grid look-up.\n\n## More\n\nx\n", "utf-8")
    for _ in range(2):
        bench_page.write_page(page, ABOUT, made_up_rows(), {})
    text = page.read_text(encoding="utf-8")
    assert "# Old" not in text and text.count(bench_page.KEPT) == 1
    assert text.endswith(f"{bench_page.KEPT}\n\nThe grid look-up.\n\n## More\n\nx\n")


def test_curves_are_svg_with_a_mark_per_point(tmp_path: Path):
    rows = made_up_rows()
    files = [tmp_path / name for name in ("a.svg", "b.svg", "c.svg")]
    for file, shown in zip(files, (rows, rows, rows[:-3]), strict=True):
        bench_page.draw_curves(file, shown, ABOUT)
    marks = []
    for file in files:
        root = ElementTree.parse(file).getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        groups = root.iter("{http://www.w3.org/2000/svg}g")
        lines = [g for g in groups if g.get("id", "").startswith("line2d_")]
        marks.append(sum(len(list(g.iter("{http://www.w3.org/2000/svg}use"))) for g in lines))
    assert files[0].read_bytes() == files[1].read_bytes()
    assert marks[0] > marks[2]


def test_plain_table_has_every_row():
    lines = bench_page.table(made_up_rows()).splitlines()
    assert len(lines) == 1 + len(made_up_rows())
    assert "24 s" in line_with("\n".join(lines), "track + score 4096")


@pytest.mark.parametrize("count", [15, 64, 1000])
def test_fan_starts_at_the_ego_and_spreads(count: int):
    first = bench_rows.fan(count)
    assert first.shape == (count, 41, 3) and np.isfinite(first).all()
    assert (first[:, 0] == 0).all() and (first == bench_rows.fan(count)).all()
    assert len(np.unique(first[:, -1], axis=0)) == count
    step = np.linalg.norm(np.diff(first[..., :2], axis=1), axis=-1)
    np.testing.assert_allclose(step, step[:, :1].repeat(40, 1), atol=1e-9)


def test_crossings_hold_what_they_should():
    raws = [bench_scenes.crowded_crossing(seed) for seed in (0, 1, 63)]
    batch = from_raw(raws).batch
    counts = bench_scenes.check_counts(batch)
    assert counts["objects"] == 64 and counts["polygons"] == 90 and counts["edges"] > 5000
    again = bench_scenes.crowded_crossing(1).tracks.pose
    assert np.array_equal(again, raws[1].tracks.pose)
    assert again.shape != raws[0].tracks.pose.shape or not np.array_equal(
        again, raws[0].tracks.pose
    )
    kinds = np.bincount(raws[0].tracks.type)
    # Within what a planner keeps of each kind: vehicles, pedestrians, bicycles.
    assert kinds[0] <= 50 and kinds[1] == 14 and kinds[2] == 2
    speed = np.linalg.norm(raws[0].tracks.velocity[:, raws[0].num_history], axis=-1)
    assert 30 < (speed > 0.5).sum() < 60
    tracks = batch.tracks
    fewer = batch.replace(tracks=tracks.replace(valid=tracks.valid & (tracks.type < 3)[..., None]))
    with pytest.raises(RuntimeError, match="objects of the crossings"):
        bench_scenes.check_counts(fewer)


def test_drives_of_a_batch_are_those_of_scenarios_alone():
    alone = {"token": "a", "status": "ok", "reason": "", "score": 0.5, "run_ms": 1.0}
    other = {**alone, "token": "b", "score": 1.0}
    assert bench_drives.check([alone, other], {**alone, "run_ms": 2.0}) == {"mean_score": 0.75}
    with pytest.raises(RuntimeError, match="depends on the 2 scenarios"):
        bench_drives.check([alone, other], {**alone, "score": 0.25})
    with pytest.raises(RuntimeError, match="b: no room"):
        bench_drives.check([alone, {**other, "status": "overflow", "reason": "no room"}], None)


def test_drives_are_packed_by_number(tmp_path: Path):
    count = len(bench_drives.TYPES)
    tokens = bench_drives.drive_tokens(count + 1)
    assert tokens == [*(f"{kind}-00" for kind in bench_drives.TYPES), f"{tokens[0][:-3]}-01"]
    assert set(bench_drives.TYPES) <= SUITES[bench_drives.SUITE].keys()
    for token in reversed(tokens):
        (tmp_path / "drives").mkdir(exist_ok=True)
        (tmp_path / "drives" / f"{token}.npz").touch()
    files = bench_scenes.scene_files(tmp_path, "drives")
    assert [path.stem for path in files] == tokens


def test_packed_scenes_come_by_seed(tmp_path: Path):
    bench_scenes.pack_scenes(tmp_path, 2, 2, 2)
    names = [path.stem for path in bench_scenes.scene_files(tmp_path, "crossings")]
    assert names == ["crowded_crossing-0", "crowded_crossing-1"]
    many = {path.stem for path in bench_scenes.scene_files(tmp_path, "many")}
    assert many == {f"{name}-{copy}" for name in names for copy in (0, 1)}
    assert len(bench_scenes.scene_files(tmp_path, "mixed")) == 2


def scores(**changes) -> SubScores:
    count = 4
    fields = {name: np.ones(count, np.float32) for name in SubScores.__dataclass_fields__}
    return SubScores(**{**fields, "valid": np.array([True, True, True, False]), **changes})


def test_shares_leave_out_padding():
    found = bench_rows.shares(scores(comfort=np.array([1.0, 0.0, 1.0, 0.0])))
    assert found["failing"]["comfort"] == pytest.approx(1 / 3)
    assert found["failing"]["drivable_area"] == 0.0


def test_programs_that_disagree_are_refused():
    assert bench_rows.agree("two", scores(), scores(total=np.full(4, 1.0005)))["differing"] == 0
    with pytest.raises(RuntimeError, match="two differ"):
        bench_rows.agree("two", scores(), scores(total=np.array([1.0, 1.0, 0.5, 1.0])))


def test_stopwatch_checks_the_first_result():
    calls = []
    found = bench_watch.Stopwatch(3)(
        lambda: calls.append(0) or len(calls), lambda n: calls.append(n)
    )
    assert calls[1] == 1 and len(calls) == 1 + 1 + 2 + 3
    bench_watch.Stopwatch(3, warmups=0)(lambda: calls.append(0))
    assert len(calls) == 7 + 1 + 3
    assert found["repetitions"] == 3 and found["min_ms"] <= found["median_ms"]
    with pytest.raises(ValueError, match="wrong"):
        bench_watch.Stopwatch(1)(lambda: None, lambda _: (_ for _ in ()).throw(ValueError("wrong")))


def test_results_go_on_only_with_the_same_facts(tmp_path: Path):
    path = tmp_path / "run" / "bench.json"
    first = bench.Results(path, {"code": "a"}, {"date": "1"})
    assert first.unit("steps", lambda: [{"workload": "w"}]) == [{"workload": "w"}]
    first.unit("sweep", lambda: {"ratio": 1.0})

    def fail():
        raise AssertionError("measured again")

    again = bench.Results(path, {"code": "a"}, {"date": "2"})
    assert again.resumed and again.about == {"date": "1"}
    assert again.unit("steps", fail) == [{"workload": "w"}]
    assert again.rows == [{"workload": "w"}] and again.apart == {"sweep": {"ratio": 1.0}}
    other = bench.Results(path, {"code": "b"}, {"date": "3"})
    assert not other.resumed and other.rows == [] and other.about == {"date": "3"}


def test_only_what_was_asked_for_is_measured(tmp_path: Path):
    results = bench.Results(tmp_path / "bench.json", {}, {}, ["drives", "first drive"])
    for name in ("steps, f32, 2 core(s)", "drives, f32, 2 core(s)", "first drive, replay"):
        results.unit(name, lambda: {"cold_s": 1.0})
    assert list(results.units) == ["drives, f32, 2 core(s)", "first drive, replay"]
    every = bench.Results(tmp_path / "bench.json", {}, {})
    every.unit("sweep", lambda: {"ratio": 1.0})
    assert len(every.units) == 3


def test_failed_child_leaves_what_was_finished(tmp_path: Path, monkeypatch, capsys):
    def broken(results, out, scale, frames):
        results.unit("steps", lambda: [row("PDM-Closed 15", 3.0)])
        raise subprocess.CalledProcessError(3, ["python", "-m", "child"])

    monkeypatch.setattr(bench, "measure_all", broken)
    assert bench.main(["--quick", "--out", str(tmp_path)]) == 1
    assert "python -m child ended with 3" in capsys.readouterr().err
    content = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    assert list(content["units"]) == ["steps"] and content["facts"]["scale"] == "quick"


def test_finished_run_writes_table_and_page(tmp_path: Path, monkeypatch, capsys):
    def finished(results, out, scale, frames):
        results.unit("steps", made_up_rows)
        for name, found in APART.items():
            results.unit(name, lambda found=found: found)

    monkeypatch.setattr(bench, "measure_all", finished)
    page = tmp_path / "page.md"
    assert bench.main(["--out", str(tmp_path / "o"), "--page", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert f"`python -m spdm_experiments.bench --out {tmp_path / 'o'} --page {page}`" in text
    assert "quoted" in text and "track + score 4096" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--page", "performance.txt"], "must end in .md"),
        (["--out", "FILE"], "is a file"),
        (["--device", "abacus"], "invalid choice"),
        (["--only", "lunch"], "invalid choice"),
        (["--only", "drives", "--page", "page.md"], "--page shows all rows"),
    ],
)
def test_useless_arguments_are_refused(arguments, words, tmp_path: Path, capsys):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(SystemExit) as stopped:
        bench.main([str(file) if text == "FILE" else text for text in arguments])
    assert stopped.value.code == 2 and words in capsys.readouterr().err


def test_peak_memory_counts_what_is_held():
    before = bench_process.peak_mb()
    held = np.ones(40_000_000)
    assert bench_process.peak_mb() >= max(before, held.nbytes / 1e6)
