"""Grids of `spdm sweep`: from flags and files to points, and from points to runs."""

import re
from pathlib import Path

import numpy as np
import pytest
import tyro

from spdm_experiments.options import Sweep
from spdm_experiments.sweep_grid import make_points, runs_of
from spdm_experiments.sweep_rows import layout_of


def grid(*arguments: str, file: str | None = None, tmp_path: Path | None = None) -> list[dict]:
    if file is not None:
        assert tmp_path is not None
        (tmp_path / "grid.toml").write_text(file)
        arguments = ("--grid", str(tmp_path / "grid.toml"), *arguments)
    options = tyro.cli(Sweep, args=["packed", *arguments])
    return [point.entry(i) for i, point in enumerate(make_points(options))]


def test_one_point_without_a_grid():
    (point,) = grid()
    assert point["planner"] == "SPDM" and point["num_proposals"] == 60
    assert point["speed_fractions"] == [0.2, 0.4, 0.6, 0.8, 1.0]
    assert (point["merge_times"], point["horizon"]) == ([4, 2, 6], 8)


def test_flags_make_the_product():
    points = grid(
        *("--num-proposals", "15", "30", "--offsets", "0,-1,1", "--horizon", "6", "8"),
        *("--merge-times", "4,2,6", "3,1", "--set", "idm.headway_time=1,1.5"),
        *("--set", "scoring.ttc_weight=7", "--forecast", "none"),
    )
    assert [p["point"] for p in points] == list(range(16))
    assert {(p["num_proposals"], p["horizon"]) for p in points} == {
        (15, 6.0),
        (15, 8.0),
        (30, 6.0),
        (30, 8.0),
    }
    assert {p["idm.headway_time"] for p in points} == {1.0, 1.5}
    assert {p["scoring.ttc_weight"] for p in points} == {7.0}
    assert {p["forecast"] for p in points} == {"none"}
    assert layout_of(points).names == ["merge_times", "horizon", "idm.headway_time"]
    assert layout_of(points).point(0)["merge_times"] == "4,2,6"


def test_values_reach_the_planner(tmp_path: Path):
    arguments = ["packed", "--set", "idm.headway_time=2.5", "spline.merge_min_speed=4"]
    more = ["--horizon", "6", "--speeds", "0.5,1", "--offsets", "0,2", "--num-proposals", "8"]
    (point,) = make_points(tyro.cli(Sweep, args=[*arguments, *more]))
    params = point.spec.params
    assert params.idm.headway_time == 2.5 and params.spline.merge_min_speed == 4
    assert params.spline.horizon == 6
    np.testing.assert_array_equal(params.lateral_offsets, [0, 2])
    assert point.spec.config.num_route_paths == 2


def test_file_makes_the_same_points_as_flags(tmp_path: Path):
    text = """
    [grid]
    planner = ["spdm"]
    num_proposals = [15, 20]
    speeds = [0.2, 0.4, 0.6, 0.8, 1.0]
    merge_times = [[4, 2, 6], [3, 1, 5]]
    horizon = 6
    [grid.set]
    "idm.headway_time" = [1, 1.5]
    scoring.ttc_weight = 4
    """
    flags = [
        *("--planner", "spdm", "--num-proposals", "15", "20", "--speeds", "0.2,0.4,0.6,0.8,1"),
        *("--merge-times", "4,2,6", "3,1,5", "--horizon", "6"),
        *("--set", "idm.headway_time=1,1.5", "scoring.ttc_weight=4"),
    ]
    assert grid(file=text, tmp_path=tmp_path) == grid(*flags)


def test_several_grids_and_a_flag_for_all(tmp_path: Path):
    text = """
    [[grid]]
    planner = "pdm-closed"
    num_proposals = [3, 15]
    [[grid]]
    num_proposals = [15, 60]
    set = { "idm.headway_time" = 2 }
    """
    points = grid("--forecast", "perfect", file=text, tmp_path=tmp_path)
    assert [(p["planner"], p["num_proposals"]) for p in points] == [
        ("PDM-Closed", 3),
        ("PDM-Closed", 15),
        ("SPDM", 15),
        ("SPDM", 60),
    ]
    assert [p["idm.headway_time"] for p in points] == [1.5, 1.5, 2, 2]  # the default is named too
    assert {p["forecast"] for p in points} == {"perfect"}


def test_stage_2_settings_do_not_repeat_pdm_closed():
    more = ["--horizon", "6", "8", "--set", "spline.merge_min_speed=4,5", "--planner"]
    points = grid("--num-proposals", "15", *more, "spdm", "pdm-closed")
    assert [p["planner"] for p in points] == ["SPDM"] * 4 + ["PDM-Closed"]


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["--num-proposals", "17"], "num_proposals is 17"),
        (["--planner", "pdm-closed", "--num-proposals", "20"], "PDM-Closed has grids for"),
        (["--planner", "pdm-closed", "--num-proposals", "15", "--speeds", "1"], "makes 3"),
        (["--offsets", "1,0"], "the first must be 0"),
        (["--speeds", "0.2,a"], "--speeds 0.2,a: needs numbers"),
        (["--set", "idm.headway=1"], "there are idm.min_gap, idm.headway_time"),
        (["--set", "spline.horizon=1"], "an option of its own, --horizon"),
        (["--set", "idm.headway_time"], "write NAME=VALUE"),
        (["--set", "idm.min_gap=1", "idm.min_gap=2"], "given twice"),
        (["--horizon", "0"], "must be positive"),
        (["--horizon", "nan"], "must be a number"),
    ],
)
def test_wrong_flags_are_named(arguments: list[str], text: str):
    with pytest.raises(ValueError, match=re.escape(text)):
        grid(*arguments)


@pytest.mark.parametrize(
    "content, text",
    [
        ("grid = 3", "no [grid]"),
        ("[grid]\nhorizons = [6]", "unknown axis 'horizons'"),
        ("[grid]\nhorizon = ['a']", "horizon is 'a'; it must be a number"),
        ("[grid]\nhorizon = []", "horizon is empty"),
        ("[grid]\nplanner = ['dtpp']", "must be one of spdm, pdm-closed"),
        ("[grid]\nnum_proposals = [true]", "must be of type int"),
        ("[grid]\nset = 3", "write [grid.set]"),
        ("[grid]\nset = {idm.headway = 3}", "there are idm.min_gap"),
        ("limit = 3\n[grid]", "unknown entry 'limit'"),
        ("[grid", "not a TOML file"),
    ],
)
def test_wrong_files_are_named(content: str, text: str, tmp_path: Path):
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        grid(file=content, tmp_path=tmp_path)
    assert "grid.toml" in str(error.value) or "--set" in str(error.value)


@pytest.mark.parametrize(
    "flags", [["--horizon", "8"], ["--set", "idm.min_gap=1"], ["--num-proposals", "15"]]
)
def test_an_axis_given_twice_is_refused(flags: list[str], tmp_path: Path):
    text = "[grid]\nhorizon = 6\nnum_proposals = 15\nset = {idm.min_gap = 2}"
    with pytest.raises(ValueError, match=f"is given by {flags[0]} .*and in .*drop one"):
        grid(*flags, file=text, tmp_path=tmp_path)


def test_nested_sets_are_one_run_and_pdm_closed_is_not():
    arguments = ["packed", "--num-proposals", "15", "60", "30", "--planner", "spdm", "pdm-closed"]
    points = make_points(tyro.cli(Sweep, args=[*arguments, "--set", "idm.min_gap=1,2"]))
    runs = runs_of(points)
    nested = [run for run in runs if run.config.num_route_paths]
    assert [run.num_proposals for run in nested] == [(15, 60, 30)] * 2
    assert {run.by_goal for run in nested} == {(False, True, True)}
    assert {run.config.num_route_paths for run in nested} == {9}
    assert len(runs) == 2 + 2 * 3
    assert sorted(i for run in runs for i in run.points) == list(range(12))
