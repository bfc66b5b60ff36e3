"""Modification files and scenario codes."""

from pathlib import Path

import pytest

from spdm_jax.interplan.config import Code, Density, Goal, Policy, parse_code
from spdm_jax.interplan.modification_file import modifications_from, read_modifications
from spdm_jax.io.nuplan_filter import ScenarioFilter
from spdm_jax.io.raw import ScenarioError

pytest.importorskip("yaml", reason="modification files need PyYAML")
TOKEN = "0123456789abcdef"
OTHER = "1111111111111111"

FILE = """
accel_max: ${oc.select:observation.accel_max, 1}
decel_max: 3
scenario_specifics: null
modification_details_dictionary:
  0123456789abcdef:
    goal: {left: "1.5, -2", right: null}
    extra_agents_spawn_locations: [[1, 2, 0], [3, 4, 5, {behavior: default, snap: true}]]
    roadblock_locations_to_spawn_agents: [[7, 8]]
    spawn_in_intersection: true
    special_scenario:
      '0': {type: overtake_parked_vehicle, config: dh, stopped_vehicle: [[1, 2, 0.5]],
            roadblock_locations_to_spawn_agents: []}
      '12': {type: jaywalking_pedestrian, pedestrian: [[1, 2, 3, 4, null], [1, 2, 3, 4, 30]],
             stopped_bus: [[5, 6, 1]]}
  1111111111111111: {}
"""


def config_of(**fields):
    return modifications_from({"modification_details_dictionary": {TOKEN: fields}}, "file")


@pytest.mark.parametrize(
    "code, expected",
    [
        ("dhgloa", Code(Density.HIGH, Goal.LEFT)),
        ("gsom", Code(goal=Goal.STRAIGHT, policy=Policy.MIXED)),
        ("a1", Code(keep_vehicles=True)),
        ("a0s12", Code(keep_vehicles=False, special=12)),
        ("s3dl", Code(Density.LOW, special=3)),
    ],
)
def test_codes(code: str, expected: Code):
    assert parse_code(code, "here") == expected


@pytest.mark.parametrize(
    "code, words",
    [
        ("", "empty"),
        ("dx", "'dx' is none of"),
        ("gldh-", "'-' is none of"),
        ("a2", "'a2' is none of"),
        ("dldh", "repeats a letter"),
        ("a0dl", "drop one"),
    ],
)
def test_bad_codes(code: str, words: str):
    with pytest.raises(ScenarioError, match=rf"here: .*{words}"):
        parse_code(code, "here")


def test_file(tmp_path: Path):
    path = tmp_path / "changes.yaml"
    path.write_text(FILE)
    config = read_modifications(path)
    assert (config.accel_max, config.decel_max) == (1.0, 3.0)
    token = config.tokens[TOKEN]
    assert token.goals == {Goal.LEFT: (1.5, -2.0)}
    first, second = token.extra_agents
    assert (first.x, first.y, first.speed, first.cautious, first.snap) == (1, 2, 0, True, False)
    assert (second.speed, second.cautious, second.snap) == (5, False, True)
    walks = token.special[12].pedestrians
    assert [walk.begins_at for walk in walks] == [None, 30]
    assert (walks[0].start, walks[0].end) == ((1, 2), (3, 4))
    assert token.special[12].stopped_buses == ((5, 6, 1),)


def test_special_scenarios_own_code_replaces_the_rest(tmp_path: Path):
    path = tmp_path / "changes.yaml"
    path.write_text(FILE)
    config = read_modifications(path)
    changes = config.changes(f"{TOKEN}-dlgrocs0")
    assert changes.code == Code(Density.HIGH, special=0)
    assert changes.scenario_type == "overtake_parked_vehicle"
    assert changes.spawn_roadblocks == ()
    assert config.changes(f"{TOKEN}-dlocs12").code.policy is Policy.CAUTIOUS
    assert config.changes(f"{TOKEN}-dmgr").spawn_roadblocks == ((7, 8),)
    assert config.changes(f"{TOKEN}-dmgr").scenario_type == "medium_traffic_density"
    assert config.changes(f"{OTHER}-gs").scenario_type == "standard_modified_nuplan_scenario"


def test_token_that_the_file_lacks_has_no_details():
    config = config_of()
    assert config.changes(f"{OTHER}-dhgl").token_changes.goals == {}
    with pytest.raises(ScenarioError, match="no special_scenario 1; token is not there"):
        config.changes(f"{OTHER}-s1")
    with pytest.raises(ScenarioError, match="token has \\[\\]"):
        config.changes(f"{TOKEN}-s1")


SPECIAL = {"type": "overtake_parked_vehicle", "stopped_vehicle": [[1, 2, 0.5]]}


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"gaol": {}}, "field 'gaol' is unknown"),
        ({"goal": {"up": None}}, "goal has 'up'"),
        ({"goal": {"left": "1"}}, r"goal.left is \['1'\]; expected 2 numbers"),
        ({"goal": {"left": "1, x"}}, r"goal.left\[1\] is ' x'; expected a number"),
        ({"extra_agents_to_spawn": [[1, 2]]}, r"to_spawn\[0\] is \[1, 2\]; expected 3"),
        (
            {"extra_agents_to_spawn": [[1, 2, 0, {"behavior": "mad"}]]},
            r"\[3\].behavior is 'mad'",
        ),
        ({"extra_agents_to_spawn": [[1, 2, 0, {"snap": "x"}]]}, r"snap is 'x'; expected true"),
        ({"extra_agents_to_spawn": 3}, "is 3; expected a list"),
        ({"special_scenario": {"x": SPECIAL}}, "special_scenario has 'x'"),
        ({"special_scenario": {"1": SPECIAL | {"type": "party"}}}, r"\[1\].type is 'party'"),
        ({"special_scenario": {"1": SPECIAL | {"config": "s1"}}}, r"\[1\].config is 's1'"),
        ({"special_scenario": {"1": SPECIAL | {"config": "q"}}}, r"\[1\].config: code 'q'"),
        ({"special_scenario": {"1": SPECIAL | {"cones": [[1]]}}}, r"cones\[0\] is \[1\]"),
        ({"special_scenario": {"1": SPECIAL | {"stopped_vehicle": []}}}, "has no stopped_vehicle"),
        (
            {"special_scenario": {"1": {"type": "jaywalking_pedestrian", "pedestrian": [[1]]}}},
            r"pedestrian\[0\] is \[1\]; expected \[x0",
        ),
        (
            {"special_scenario": {"1": SPECIAL | {"pedestrian": [[1, 2, 3, 4, -1]]}}},
            r"pedestrian\[0\]\[4\] is -1; expected an iteration",
        ),
    ],
)
def test_bad_fields_are_named(fields: dict, words: str):
    with pytest.raises(ScenarioError, match=rf"file: {TOKEN}.*{words}"):
        config_of(**fields)


def test_files_that_are_no_modifications(tmp_path: Path):
    with pytest.raises(ScenarioError, match="not a readable YAML"):
        read_modifications(tmp_path / "absent.yaml")
    path = tmp_path / "list.yaml"
    path.write_text("- 1")
    with pytest.raises(ScenarioError, match="holds no fields"):
        read_modifications(path)
    path.write_text("scenario_tokens: []")
    with pytest.raises(ScenarioError, match="has no modification_details_dictionary"):
        read_modifications(path)
    path.write_text("modification_details_dictionary: {0123456789abcdef-dh: {}}")
    with pytest.raises(ScenarioError, match="without code"):
        read_modifications(path)


def test_file_of_the_benchmark(shared: Path):
    folder = shared / "data" / "benchmarks"
    if not folder.is_dir():
        pytest.skip("reference data not at hand")
    config = read_modifications(folder / "interPlan_modifications.yaml")
    assert len(config.tokens) == 15
    assert sum(len(token.special) for token in config.tokens.values()) == 50
    assert config.notes == () and (config.accel_max, config.decel_max) == (1.0, 2.0)
    for name, number in (("interplan10.yaml", 80), ("benchmark_scenarios.yaml", 335)):
        tokens = ScenarioFilter.from_yaml(folder / name).scenario_tokens
        assert tokens is not None
        types = [config.changes(token).scenario_type for token in tokens]
        assert len(types) == number and len(set(types)) == 8
        if number == 80:
            assert {types.count(kind) for kind in types} == {10}
