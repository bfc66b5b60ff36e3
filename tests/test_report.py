"""Reports: numbers behind the page, the verb, and figures for papers, from made-up run folders."""

import io
import json
import shutil
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest

import made_up_run as made_up
from spdm_experiments import cli, figures
from spdm_experiments import report_data as numbers
from spdm_experiments import report_grid as grid
from spdm_experiments.report_data import Run, load_run
from spdm_experiments.report_page import page_data, stage_table
from spdm_experiments.report_scenes import make_players, planner_of, shown_points
from spdm_experiments.report_terms import TERMS, terms_of
from spdm_jax import pdm_closed, plan, spdm

GRID = made_up.GRID
SWEEP = terms_of({"command": "sweep"})
TOKENS = [f"{kind}-{i}" for i in range(15) for kind in ("curve", "jaywalker")]


def run_of(folder: Path, rows: list[dict[str, Any]], **about: Any) -> Run:
    return load_run(made_up.write_run(folder, rows, **about))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """30 scenarios at seven grid points; two more failed, one of them at two points only."""
    rows = made_up.scored_rows(GRID, TOKENS)
    rows += made_up.failed_rows(GRID, "broken-0", "broken-0.npz: damaged scenario file")
    rows += made_up.scored_rows(GRID[2:], ["straight-0"], seed=1)
    for row in rows:
        if row["token"] == "straight-0":
            row["point"] += 2
    rows += made_up.failed_rows(GRID[:2], "straight-0", "too many path points", "overflow")
    return run_of(tmp_path_factory.mktemp("runs") / "first", rows)


# ---- intervals ----


def test_bootstrap_is_repeatable_and_right():
    coin = np.repeat([0.0, 1.0], 200)
    values = np.stack([coin, 3 + 2 * coin], axis=1)
    first, again, other = (numbers.bootstrap(values, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # The mean of n coins is normal with a standard error of 0.5 / sqrt(n).
    half = 1.96 * 0.5 / np.sqrt(len(coin))
    np.testing.assert_allclose(first[:, 0], [0.5 - half, 0.5 + half], atol=0.006)
    np.testing.assert_allclose(first[:, 1], 3 + 2 * first[:, 0])


def test_bootstrap_does_not_depend_on_the_block_size(monkeypatch: pytest.MonkeyPatch):
    values = np.random.default_rng(0).normal(size=(40, 3))
    whole = numbers.bootstrap(values, 5)
    monkeypatch.setattr(numbers, "_BLOCK", 40 * 7)
    np.testing.assert_allclose(numbers.bootstrap(values, 5), whole)


def test_bootstrap_shrinks_with_the_number_of_scenarios():
    values = np.random.default_rng(0).uniform(size=(1600, 1))
    few, many = (np.ptp(numbers.bootstrap(values[:n], 0)) for n in (100, 1600))
    assert few / many == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("count", [0, 1])
def test_one_scenario_has_no_interval(count: int):
    assert np.isnan(numbers.bootstrap(np.ones((count, 2)), 0)).all()


# ---- means ----


def test_failed_scenarios_are_counted_and_not_averaged_in(run: Run):
    found = numbers.summarise(run)
    assert [(s.scenarios, s.failed) for s in found] == [(30, 2)] * 2 + [(31, 1)] * 5
    for summary in found:
        rows = polars.read_parquet(sorted((run.folder / "rows").glob("*.parquet")))
        rows = rows.filter((polars.col("point") == summary.point) & (polars.col("status") == "ok"))
        for name in ("total", "comfort", "progress_raw"):
            assert summary.means[name] == pytest.approx(rows[name].mean())
            low, high = summary.intervals[name]
            assert low <= summary.means[name] <= high
        assert summary.braking == pytest.approx(rows["emergency_brake"].sum() / len(rows))
        assert summary.ms == pytest.approx(4 + 0.2 * GRID[summary.point]["num_proposals"])
    assert {row["token"]: (row["status"], row["points"]) for row in numbers.failures(run)} == {
        "broken-0": ("failed", 7),
        "straight-0": ("overflow", 2),
    }


def test_point_without_scores_has_no_mean(tmp_path: Path):
    rows = made_up.failed_rows(GRID, "a", "damaged") + made_up.failed_rows(GRID, "b", "damaged")
    run = run_of(tmp_path / "run", rows)
    (summary, *_) = numbers.summarise(run)
    assert (summary.scenarios, summary.failed) == (0, 2)
    assert np.isnan([summary.means["total"], summary.braking, summary.ms]).all()
    data = page_data([run])
    assert data["points"][0]["means"]["total"] is None and data["lists"][0]["rows"] == []
    json.dumps(data, allow_nan=False)


def test_missing_scenarios_are_those_without_all_rows(tmp_path: Path):
    rows = made_up.scored_rows(GRID, ["a", "b", "c"])
    rows = [row for row in rows if not (row["token"] == "c" and row["point"] == 6)]
    run = run_of(tmp_path / "run", rows, num_scenarios=10)
    assert run.missing == 8
    (entry,) = page_data([run])["runs"]
    assert "8 of 10 scenarios are missing" in entry["notes"][0]


# ---- two runs ----


def test_paired_difference_uses_common_scenarios_only(tmp_path: Path):
    point = GRID[:1]
    rows = made_up.scored_rows(point, ["a", "b", "c", "d", "e"])
    others = [dict(row) for row in rows]
    totals = zip((1, 0.5, 0.8, 0, 1), (0.5, 0.5, 1, 1, 0), strict=True)
    for row, twin, (total, other) in zip(rows, others, totals, strict=True):
        row["total"], twin["total"] = total, other
    rows[3] = made_up.failed_rows(point, "d", "damaged")[0]
    others[4]["token"] = "f"
    first = run_of(tmp_path / "a", rows, points=point)
    second = run_of(tmp_path / "b", others, points=point)
    found = numbers.paired_difference(first, second, (0, 0))
    assert found.scenarios == 3  # a, b, c: d failed in one run, e and f are in one each
    assert found.mean == pytest.approx((0.5 + 0 - 0.2) / 3)
    assert (found.wins, found.ties, found.losses) == (1, 1, 1)
    assert found.interval[0] <= found.mean <= found.interval[1]
    lost = numbers.largest_losses(first, second, (0, 0), 10)
    assert lost["token"].to_list() == ["c"]
    assert lost["difference"].to_list() == pytest.approx([-0.2])


def test_common_points_may_differ_in_what_each_run_holds_fixed(tmp_path: Path):
    corrected = [{**point, "tracker": "corrected"} for point in [GRID[6], GRID[1]]]
    rows = made_up.scored_rows(GRID, ["a", "b"])
    first = run_of(tmp_path / "a", rows)
    second = run_of(
        tmp_path / "b", made_up.scored_rows(corrected, ["a", "b"]), points=corrected, commit="new"
    )
    assert numbers.common_points(first, second) == [(1, 1), (6, 0)]
    assert shown_points([first, second]) == [(0, 6), (1, 0)]
    (note,) = page_data([first, second])["notes"]
    assert "commit 0123456789ab (A), new (B)" in note
    assert "tracker reference (A), corrected (B)" in note
    swept = [{**GRID[6], "idm.headway_time": t} for t in (1.0, 2.0)]
    third = run_of(tmp_path / "c", made_up.scored_rows(swept, ["a"]), points=swept)
    assert numbers.common_points(first, third) == []


# ---- the grid ----


def test_lines_run_along_what_varies():
    (pdm, spdm_line) = grid.lines(GRID, "num_proposals")
    assert (pdm.name, pdm.values, pdm.points) == ("PDM-Closed", [3, 15], [0, 1])
    assert (spdm_line.name, spdm_line.values) == ("SPDM", [15, 20, 30, 45, 60])
    points = [
        {"planner": "SPDM", "num_proposals": n, "idm.headway_time": t, "speed_fractions": [n, 1]}
        for t in (2.0, 1.0)
        for n in (30, 15)
    ]
    assert grid.axes(points) == ["num_proposals", "idm.headway_time"]
    # The speeds follow from N_p, so they name no line.
    assert [line.name for line in grid.lines(points, "num_proposals")] == [
        "SPDM, idm.headway_time 2",
        "SPDM, idm.headway_time 1",
    ]
    assert grid.lines(points, "idm.headway_time")[0] == grid.Line("SPDM 30", [2, 0], [1, 2])
    offsets = [{**GRID[0], "lateral_offsets": o} for o in ([0.0, 1.0], [0.0, 0.5])]
    assert grid.axes(offsets) == ["num_proposals"]
    names = [line.name for line in grid.lines(offsets, "num_proposals")]
    assert names == ["PDM-Closed, lateral_offsets 0 1", "PDM-Closed, lateral_offsets 0 0.5"]


def test_reason_names_the_first_rule_that_is_broken():
    good = {name: 1.0 for name in TERMS}
    row = {**good, "progress_raw": 12.0, "collision_agent": "car-7", "collision_time": 2.3}
    row |= {"ttc_agent": None, "ttc_time": np.inf}
    assert SWEEP.first_lost(row) == ("", "")
    row |= {"progress": 0.4}
    assert SWEEP.first_lost(row) == ("progress", "12.0 m, 40 % of the best admissible proposal")
    row |= {"time_to_collision": 0.0}
    assert SWEEP.first_lost(row) == ("time_to_collision", "less than 1 s to a collision")
    row |= {"no_at_fault_collision": 0.0, "drivable_area": 0.0}
    told = ("no_at_fault_collision", "at-fault collision with car-7 at 2.3 s")
    assert SWEEP.first_lost(row) == told


def test_worst_scenes_come_first(run: Run):
    rows = numbers.worst(run, 0, 5)
    totals = run.usable(0)["total"].sort()
    assert rows["total"].to_list() == totals[:5].to_list()
    (last, *_) = page_data([run], worst=5)["lists"]
    assert last["name"] == "Worst of SPDM 60" and len(last["rows"]) == 5
    assert all(row["reason"] for row in last["rows"])


def test_times_of_stages_are_averaged_over_scenes(tmp_path: Path):
    rows, stages = made_up.scored_rows(GRID, ["a"]), made_up.stage_rows(GRID, ["a", "b", "c"])
    run = run_of(tmp_path / "run", rows, stages=stages)
    table = stage_table(run)
    assert table["planner"].to_list() == ["PDM-Closed"] * 2 + ["SPDM"] * 5
    last = table.row(-1, named=True)
    assert last["num_proposals"] == 60 and last["scenes"] == 3
    assert last["scoring"] == pytest.approx(7 * 1.1) and last["tracking"] == pytest.approx(
        2.4 * 1.1
    )
    assert stage_table(run_of(tmp_path / "other", rows)).is_empty()


# ---- the verb ----


def report(*arguments: object) -> int:
    return cli.main(["report", *map(str, arguments)])


@pytest.fixture(scope="module")
def reported(run: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Page, folder of figures, and what the verb printed."""
    folder, printed = tmp_path_factory.mktemp("report"), io.StringIO()
    out, pictures = folder / "new" / "page.html", folder / "figures"
    with redirect_stdout(printed):
        assert report(run.folder, "--out", out, "--players", 0, "--figures", pictures) == 0
    return out, pictures, printed.getvalue()


def test_verb_writes_page_and_figures(reported: tuple[Path, Path, str]):
    out, pictures, printed = reported
    assert "7 grid points, 32 scenarios, 2 failed" in printed and "missing" not in printed
    names = ("score_over_np", "runtime_over_np", "subscores")
    files = {pictures / f"{name}.{form}" for name in names for form in ("svg", "pdf", "png")}
    assert set(pictures.iterdir()) == files
    assert {Path(line.strip()) for line in printed.split("written:")[1].split()} == {out, *files}
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize("where", ["gone", "changed"])
def test_missing_pack_gives_a_note(
    where: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pack = tmp_path / "pack"
    if where == "changed":
        pack.mkdir()
        (pack / "curve-0.npz").write_bytes(b"another file")
    out = tmp_path / "page.html"
    assert report(run.folder, "--out", out, "--scenes", pack) == 0
    printed = capsys.readouterr().err
    expected = {
        "gone": f"note: No player: {pack}: no such file or folder. If the scenario files have",
        "changed": f"note: No player: the scenario files in {pack} are not those of the run",
    }
    assert expected[where] in printed and "--scenes" in printed
    assert expected[where].removeprefix("note: ") in out.read_text(encoding="utf-8")


def test_unfinished_run_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = made_up.write_run(tmp_path / "run", made_up.scored_rows(GRID, ["a"]), num_scenarios=4)
    assert report(folder, "--out", tmp_path / "page.html", "--players", 0) == 0
    assert "3 missing (the run is not finished)" in capsys.readouterr().out


def damage(folder: Path, how: str) -> None:
    about = folder / "run.json"
    entries = json.loads(about.read_text())
    part = next((folder / "rows").iterdir())
    if how == "no folder":
        shutil.rmtree(folder)
    elif how == "no run.json":
        about.unlink()
    elif how == "not JSON":
        about.write_text("{")
    elif how == "another verb":
        about.write_text(json.dumps({**entries, "command": "plan"}))
    elif how == "no verb":
        about.write_text("[]")
    elif how == "newer":
        about.write_text(json.dumps({**entries, "format": 2}))
    elif how == "no rows":
        shutil.rmtree(folder / "rows")
    elif how == "damaged rows":
        part.write_bytes(b"PAR1")
    elif how == "other columns":
        polars.read_parquet(part).drop("comfort").write_parquet(part)
    elif how == "twice":
        shutil.copy(part, part.with_name("part-copy.parquet"))


@pytest.mark.parametrize(
    "how, text",
    [
        ("no folder", "run: no such folder; name one that spdm sweep or spdm simulate has written"),
        ("no run.json", "run: no run.json, so no run folder"),
        ("not JSON", "run.json: not valid JSON"),
        ("another verb", "run.json: written by spdm plan; spdm report reads what spdm sweep or"),
        ("no verb", "run.json: does not say that spdm sweep or spdm simulate wrote it"),
        ("newer", "run.json: format is 2, this version reads 1"),
        ("no rows", "run: no rows/part-*.parquet yet"),
        ("damaged rows", "parquet: damaged ("),
        ("other columns", "parquet: no column 'comfort'"),
        ("twice", "run: scenario 'a' occurs twice at grid point 0"),
    ],
)
def test_folder_that_is_no_run_is_named(
    how: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = made_up.write_run(tmp_path / "run", made_up.scored_rows(GRID, ["a"]), parts=1)
    damage(folder, how)
    assert report(folder, "--out", tmp_path / "page.html") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("spdm: ") and text in printed and printed.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize("option, value", [("worst", 0), ("players", -1)])
def test_useless_counts_are_named(
    option: str, value: int, run: Run, capsys: pytest.CaptureFixture[str]
):
    assert report(run.folder, f"--{option}", value) == 2
    assert f"--{option} is {value}; it must be at least" in capsys.readouterr().err


# ---- figures ----


def test_figures_draw_the_summaries(run: Run):
    found = figures.curves([run, run], "num_proposals")
    assert [curve.name for curve in found] == [
        f"{planner}, first ({c})" for c in "AB" for planner in ("PDM-Closed", "SPDM")
    ]
    axes = figures.plot_score(found[:2]).axes[0]
    summaries = numbers.summarise(run)
    for line, points in zip(axes.get_lines(), ([0, 1], [2, 3, 4, 5, 6]), strict=True):
        x, y = np.asarray(line.get_data())
        assert x.tolist() == [GRID[i]["num_proposals"] for i in points]
        assert y.tolist() == pytest.approx([summaries[i].means["total"] for i in points])
    panels = figures.plot_subscores(found[:2]).axes
    assert [panel.get_title() for panel in panels] == list(TERMS.values())[1:]
    per_scenario = figures.plot_runtime([run], found[:2]).axes[0]
    assert per_scenario.get_lines()[0].get_ydata() == pytest.approx([4.6, 7.0])


def test_runtime_figure_stacks_the_stages(tmp_path: Path):
    rows, stages = made_up.scored_rows(GRID, ["a"]), made_up.stage_rows(GRID, ["a"])
    run = run_of(tmp_path / "run", rows, stages=stages)
    first, second = figures.plot_runtime([run], []).axes
    assert (first.get_title(), second.get_title()) == ("PDM-Closed", "SPDM")
    tops = [bar.get_window_extent().y1 for bar in second.patches[-5:]]
    tops = second.transData.inverted().transform([(0, y) for y in tops])[:, 1]
    expected = stage_table(run).tail(5).select("proposals", "tracking", "scoring")
    assert tops.tolist() == pytest.approx(expected.sum_horizontal().to_list())


def test_figures_say_where_they_come_from(reported: tuple[Path, Path, str]):
    _, pictures, _ = reported
    pdf = (pictures / "score_over_np.pdf").read_bytes()
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf  # real fonts, inside
    svg = (pictures / "score_over_np.svg").read_text(encoding="utf-8")
    assert "<text" not in svg  # outlines, which need no font
    # matplotlib keeps the words of an outline as a comment beside it.
    assert "pack (built-in scenes), 31 scenarios, seed 0, commit 0123456789ab, cpu (cpu)" in svg


def test_figures_follow_the_swept_parameter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    points = [{**GRID[0], "idm.headway_time": t} for t in (1.0, 1.5, 2.0)]
    run = run_of(tmp_path / "run", made_up.scored_rows(points, ["a", "b"]), points=points)
    monkeypatch.setattr(figures, "FORMATS", ("svg",))
    names = [path.name for path in figures.write_figures([run], tmp_path)]
    short = "over_idm_headway_time.svg"
    assert names == [f"score_{short}", f"runtime_{short}", "subscores.svg"]


def test_long_names_of_lines_fit_the_figure(tmp_path: Path):
    points = [{**p, "idm.headway_time": t} for t in (1.0, 1.5, 2.0) for p in GRID[1:4]]
    run = run_of(tmp_path / "run", made_up.scored_rows(points, ["a", "b"]), points=points)
    found = figures.curves([run], "num_proposals")
    assert len(found) == 6 and max(len(curve.name) for curve in found) > 25
    for figure in (figures.plot_score(found), figures.plot_subscores(found)):
        figure.draw_without_rendering()
        (legend,) = figure.legends
        box = legend.get_window_extent()
        assert 0 <= box.x0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        assert min(axes.bbox.height for axes in figure.axes) > 0.25 * 100  # not squeezed away


def test_figures_are_repeatable(
    run: Run, reported: tuple[Path, Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(figures, "FORMATS", ("svg",))
    for path in figures.write_figures([run], tmp_path):
        assert path.read_bytes() == (reported[1] / path.name).read_bytes()


# ---- planning anew ----


def test_planner_of_a_grid_point():
    point = {**GRID[6], "speed_fractions": [0.2, 0.4, 0.6, 0.8, 1.0], "lateral_offsets": [0.0, 1.0]}
    point |= {"num_proposals": 30, "merge_times": [3.0], "horizon": 6.0, "idm.headway_time": 2.0}
    spec = planner_of({**point, "tracker": "corrected", "map_radius": 60.0})
    assert spec.config == spdm(30, lateral_offsets=(0.0, 1.0), config=spec.config).config
    assert spec.config.tracker == "corrected" and spec.params.map_radius == 60
    assert spec.params.idm.headway_time == 2 and spec.params.spline.horizon == 6
    assert np.asarray(spec.params.spline.merge_times).tolist() == [3.0]
    assert planner_of(GRID[0]).config == pdm_closed(3).config
    with pytest.raises(ValueError, match=r"a setting 'idm\.patience' of another version"):
        planner_of({**point, "idm.patience": 1.0})


@pytest.mark.slow
def test_player_shows_the_scenes_of_the_run(tmp_path: Path):
    from spdm_experiments.chunks import scenario_files
    from spdm_experiments.inventory import take_inventory
    from spdm_jax import load

    pack, points = tmp_path / "pack", GRID[:1]
    assert cli.main(["pack", "straight,jaywalker,parked_car", str(pack)]) == 0
    scenes = load(pack)
    result = plan(scenes, planner_of(points[0]))
    rows = made_up.scored_rows(points, [info.token for info in scenes.infos])
    for i, row in enumerate(rows):
        row["total"] = float(result.scores.total[i, result.best[i]])
    rows[0]["total"] += 0.25
    digest = take_inventory(scenario_files(pack)).digest
    run = run_of(tmp_path / "run", rows, points=points, scenes=str(pack), input_hash=digest)
    players = make_players([run], 3)
    assert players.tokens == numbers.worst(run, 0, 3)["token"].to_list()
    assert players.page and all(token in players.page for token in players.tokens)
    (told, *off) = players.notes
    assert told.startswith("3 scenes, planned anew by PDM-Closed 3.")
    assert len(off) == 1 and "1 of these scenes score other than in the run" in off[0]
    assert scenes.infos[0].token in off[0]
