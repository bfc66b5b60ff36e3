"""`spdm pack --interplan`: changed scenarios and their extras, from files as people have them."""

from pathlib import Path

import pytest

from spdm_experiments import cli
from spdm_jax.interplan.extras import extras_path, has_code, read_extras
from spdm_jax.io.scenario_file import read_scenario

TOKEN = "27b62ec6fac3c3bb"
MODIFICATIONS = """
accel_max: ${oc.select:observation.accel_max, 1}
scenario_specifics: null
modification_details_dictionary:
  27b62ec6fac3c3bb:
    extra_agents_to_spawn: [[588780.0, 4479740.0, 5, {snap: false}]]
    goal: {left: null, right: null, straight: "588815.0, 4479722.0"}
    special_scenario:
      '0': {type: jaywalking_pedestrian, config: dlgs,
            pedestrian: [[588790, 4479740, 588795, 4479730, null]]}
"""
FILTER = f"""
_target_: nuplan.planning.scenario_builder.scenario_filter.ScenarioFilter
defaults:
  - modifications: interPlan_modifications
scenario_types: null
scenario_tokens: [{TOKEN}-s0, {TOKEN}-dhgs]
num_scenarios_per_type: 1
"""


@pytest.fixture
def data(shared: Path) -> Path:
    pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
    folder = shared / "data" / "nuplan_format" / "pit_3bffdcff"
    if not folder.is_dir():
        pytest.skip("reference data not at hand")
    return folder


@pytest.fixture
def changes(tmp_path: Path) -> Path:
    path = tmp_path / "changes.yaml"
    path.write_text(MODIFICATIONS)
    return path


def pack(data: Path, out: Path, changes: Path, *more: str) -> int:
    return cli.main(["pack", str(data), str(out), "--interplan", str(changes), *more])


def test_scenarios_and_extras_lie_side_by_side(data: Path, changes: Path, tmp_path: Path, capsys):
    chosen, out = tmp_path / "filter.yaml", tmp_path / "out"
    chosen.write_text(FILTER)
    assert pack(data, out, changes, "--filter", str(chosen)) == 0
    said = capsys.readouterr().err
    assert "unmodified" not in said and "per_type" not in said
    names = [f"{TOKEN}-dhgs", f"{TOKEN}-s0"]
    assert sorted(path.stem for path in out.glob("*.npz")) == names
    for name in names:
        path = out / f"{name}.npz"
        scenario, info = read_scenario(path)
        extras = read_extras(extras_path(path))
        assert info.token == extras.name == name and has_code(name)
        assert info.scenario_type == extras.scenario_type
        assert {*extras.cautious, *(who.track for who in extras.pedestrians)} <= {*info.track_ids}
        # The log ends before the 30 s do.
        assert 150 > scenario.num_iterations > 70

    # A scenario file without extras is half of one.
    first, second = (out / f"{name}.npz" for name in names)
    extras_path(first).unlink()
    before = second.stat().st_mtime_ns
    assert pack(data, out, changes, "--filter", str(chosen)) == 0
    assert "1 written, 1 there already" in capsys.readouterr().out
    assert extras_path(first).exists() and second.stat().st_mtime_ns == before
    assert pack(data, out, changes, "--filter", str(chosen), "--overwrite") == 0
    assert "2 written" in capsys.readouterr().out


def test_types_are_those_of_the_changes(data: Path, changes: Path, tmp_path: Path, capsys):
    names = ["--token", f"{TOKEN}-s0", f"{TOKEN}-dhgs"]
    given = [*names, "--type", "jaywalking_pedestrian"]
    assert pack(data, tmp_path / "out", changes, *given) == 0
    assert [path.stem for path in (tmp_path / "out").glob("*.npz")] == [f"{TOKEN}-s0"]
    assert pack(data, tmp_path / "out", changes, *names, "--type", "x") == 2
    assert "there are high_traffic_density, jaywalking_pedestrian" in capsys.readouterr().err


def test_what_is_left_out_or_unknown_is_said(data: Path, changes: Path, tmp_path: Path, capsys):
    other = "7e3e3769e416290e"
    tokens = [f"{TOKEN}-a0", f"{other}-a1", TOKEN, "f" * 16 + "-a0"]
    chosen = tmp_path / "filter.yaml"
    chosen.write_text(FILTER)
    given = ["--filter", str(chosen), "--limit", "1", "--token", *tokens]
    assert pack(data, tmp_path / "out", changes, *given) == 0
    said = capsys.readouterr().err
    assert f"1 of 4 scenario_tokens have no code and are left out, the first is {TOKEN}" in said
    assert f"the first is {other}-a1: no goal positions" in said
    assert "1 of 3 scenario_tokens were not found" in said and "f" * 16 in said
    assert "num_scenarios_per_type is 1 and not applied: 2 scenarios are of type standard" in said


@pytest.mark.parametrize(
    "token, change, text",
    [
        (f"{TOKEN}-s7", ("", ""), "no special_scenario 7; token has [0]"),
        (f"{TOKEN}-dx", ("", ""), "code 'dx': 'dx' is none of"),
        (TOKEN, ("", ""), "give scenario_tokens as <token>-<code>"),
        (f"{TOKEN}-s0", ("snap: false", "behavior: wild"), "behavior is 'wild'"),
        (f"{TOKEN}-s0", ("snap: false", "mood: wild"), "field 'mood' is unknown"),
        (f"{TOKEN}-s0", ("588815.0, ", "east, "), f"{TOKEN}.goal.straight[0] is 'east'"),
        ("f" * 16 + "-a0", ("", ""), "selects nothing"),
    ],
)
def test_errors_name_field_and_value(
    token: str, change: tuple[str, str], text: str, data: Path, changes: Path, tmp_path, capsys
):
    changes.write_text(MODIFICATIONS.replace(*change) if change[0] else MODIFICATIONS)
    assert pack(data, tmp_path / "out", changes, "--token", token) == 2
    said = capsys.readouterr().err
    assert text in said and (str(changes) in said or "scenario_tokens" in said)
    assert not (tmp_path / "out").exists()


def test_other_sources_have_no_modifications(changes: Path, tmp_path: Path, capsys):
    assert pack(Path("all"), tmp_path / "out", changes) == 2
    assert "--interplan applies to nuplan sources" in capsys.readouterr().err
