from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.io.nuplan_filter import (
    OTHER_WINDOW,
    TAGGED_TYPES,
    TAGGED_WINDOW,
    ScenarioFilter,
    Window,
    apply_filter,
    base_token,
    window_of,
)
from spdm_jax.io.nuplan_log import UNTAGGED, Candidate
from spdm_jax.io.raw import ScenarioError

pytest.importorskip("yaml", reason="filter files need PyYAML")


def write(folder: Path, text: str) -> Path:
    path = folder / "filter.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def sweep(number: int, seconds: float, kind: str) -> Candidate:
    return Candidate(f"{number:016x}", round(seconds * 1e6), kind, Path("a.db"), "somewhere")


candidates = st.lists(
    st.tuples(st.floats(0, 500), st.sampled_from(["turn", "stop", UNTAGGED])), max_size=40
).map(lambda rows: [sweep(i, t, kind) for i, (t, kind) in enumerate(sorted(rows))])


def test_yaml_as_nuplan_writes_it(tmp_path: Path):
    path = write(
        tmp_path,
        """
_target_: nuplan.planning.scenario_builder.scenario_filter.ScenarioFilter
_convert_: 'all'
scenario_types: [changing_lane, stopping_with_lead]
scenario_tokens:
  - 'fa20c34947a8558d'
  - 5343185712582101
  - 1234567812345e78
log_names: ${splitter.log_splits.val}
map_names: null
num_scenarios_per_type: 25
limit_total_scenarios: 0.5
timestamp_threshold_s: 15
ego_displacement_minimum_m: null  # off
expand_scenarios: false
remove_invalid_goals: true
shuffle: False
""",
    )
    read = ScenarioFilter.from_yaml(path)
    assert read.scenario_types == ("changing_lane", "stopping_with_lead")
    assert read.scenario_tokens == ("fa20c34947a8558d", "5343185712582101", "1234567812345e78")
    assert read.log_names is None
    assert read.map_names is None
    assert (read.num_scenarios_per_type, read.limit_total_scenarios) == (25, 0.5)
    assert read.timestamp_threshold_s == 15
    assert read.remove_invalid_goals
    assert len(read.notes) == 1
    assert "log_names" in read.notes[0]


def test_suffixed_tokens_select_the_recorded_scenario(tmp_path: Path):
    path = write(
        tmp_path,
        "scenario_tokens:\n- 168c4e592f1b5984-s2\n- 168c4e592f1b5984-s1\nlog_names:\n"
        "num_scenarios_per_type: 1\n",
    )
    read = ScenarioFilter.from_yaml(path)
    assert read.scenario_tokens == ("168c4e592f1b5984-s2", "168c4e592f1b5984-s1")
    assert read.base_tokens == ("168c4e592f1b5984",)
    assert "suffix" in read.notes[0]
    sweeps = [sweep(i, i, "turn") for i in range(5)]
    assert apply_filter(sweeps, read) == sweeps


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scenario_tokenz: []", ["scenario_tokenz", "unknown"]),
        ("shuffle: true", ["shuffle", "off"]),
        ("ego_displacement_minimum_m: 5", ["ego_displacement_minimum_m", "5"]),
        ("expand_scenarios: true", ["expand_scenarios"]),
        ("scenario_types: changing_lane", ["scenario_types", "list"]),
        ("scenario_tokens: [abc]", ["'abc'", "16 lower-case hex"]),
        ("num_scenarios_per_type: many", ["num_scenarios_per_type", "many"]),
        ("num_scenarios_per_type: 2.5", ["num_scenarios_per_type", "2.5"]),
        ("num_scenarios_per_type: 0", ["num_scenarios_per_type", "0"]),
        ("limit_total_scenarios: 1.5", ["limit_total_scenarios", "1.5"]),
        ("remove_invalid_goals: maybe", ["remove_invalid_goals", "maybe"]),
        ("- a\n- b", ["no fields"]),
        ("a: [", ["YAML"]),
    ],
)
def test_bad_filters_are_named(tmp_path: Path, text: str, words: list[str]):
    with pytest.raises(ScenarioError) as raised:
        ScenarioFilter.from_yaml(write(tmp_path, text))
    assert all(word in str(raised.value) for word in words), raised.value


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ScenarioError, match=r"nowhere\.yaml"):
        ScenarioFilter.from_yaml(tmp_path / "nowhere.yaml")


def test_plain_values():
    read = ScenarioFilter.from_mapping(
        {"limit_total_scenarios": 0.5, "num_scenarios_per_type": 3, "shuffle": False}
        | {"map_names": ["here"], "remove_invalid_goals": True, "log_names": None}
    )
    assert read == ScenarioFilter(
        limit_total_scenarios=0.5,
        num_scenarios_per_type=3,
        map_names=("here",),
        remove_invalid_goals=True,
    )
    with pytest.raises(ScenarioError, match="shuffle is True"):
        ScenarioFilter.from_mapping({"shuffle": True})


def test_a_single_name_is_no_list_of_names():
    with pytest.raises(ScenarioError, match="log_names"):
        ScenarioFilter(log_names="2021")  # type: ignore[arg-type]


def test_base_token_rejects_upper_case():
    with pytest.raises(ScenarioError, match="FA20C34947A8558D"):
        base_token("FA20C34947A8558D")


def test_windows_by_type():
    assert window_of("changing_lane", None, None) == TAGGED_WINDOW == Window(15.0, -3.0)
    assert window_of(UNTAGGED, None, None) == OTHER_WINDOW == Window(20.0, 0.0)
    own = Window(8.0, 0.0)
    assert window_of("changing_lane", own, {}) == own
    assert window_of("changing_lane", own, {"changing_lane": TAGGED_WINDOW}) == TAGGED_WINDOW
    # The fourteen types of the Val14 benchmark are all in nuPlan's mapping.
    assert {"changing_lane", "high_lateral_acceleration", "waiting_for_pedestrian_to_cross",
            "starting_straight_traffic_light_intersection_traversal"} <= TAGGED_TYPES  # fmt: skip
    assert UNTAGGED not in TAGGED_TYPES


def test_equal_steps_per_type():
    sweeps = [sweep(i, i, "turn") for i in range(7)]
    kept = apply_filter(sweeps, ScenarioFilter(num_scenarios_per_type=3))
    assert [c.time_us for c in kept] == [0, 2_000_000, 4_000_000]


def test_time_apart_counts_per_type():
    sweeps = [sweep(0, 0, "turn"), sweep(1, 5, "stop"), sweep(2, 10, "turn"), sweep(3, 15, "turn")]
    kept = apply_filter(sweeps, ScenarioFilter(timestamp_threshold_s=15))
    assert [c.time_us for c in kept] == [0, 5_000_000, 15_000_000]


def test_untagged_sweeps_go_first():
    sweeps = [sweep(i, i, UNTAGGED if i % 2 else "turn") for i in range(10)]
    kept = apply_filter(sweeps, ScenarioFilter(limit_total_scenarios=6))
    assert sum(c.scenario_type == "turn" for c in kept) == 5
    assert len(kept) == 6
    kept = apply_filter(sweeps, ScenarioFilter(limit_total_scenarios=0.3))
    assert [c.scenario_type for c in kept] == ["turn"] * 3


@given(candidates, st.integers(1, 6), st.floats(0, 60), st.integers(1, 20))
def test_filters_only_remove(sweeps: list[Candidate], count: int, apart: float, limit: int):
    wanted = ScenarioFilter(
        num_scenarios_per_type=count, timestamp_threshold_s=apart, limit_total_scenarios=limit
    )
    kept = apply_filter(sweeps, wanted)
    assert set(kept) <= set(sweeps)
    assert [c.token for c in kept] == sorted(c.token for c in kept)
    assert len(kept) <= limit
    for kind in {c.scenario_type for c in sweeps}:
        times = [c.time_us for c in kept if c.scenario_type == kind]
        assert len(times) <= count
        assert all(
            b - a >= apart * 1e6 - 1 for a, b in zip(sorted(times), sorted(times)[1:], strict=False)
        )


def test_published_benchmarks_load(shared: Path):
    files = {path.name: path for path in (shared / "data" / "benchmarks").glob("*.yaml")}
    sizes = {
        "val14_split.yaml": (1118, 1118),
        "reduced_val14_split.yaml": (318, 318),
        "interplan10.yaml": (80, None),
        "benchmark_scenarios.yaml": (335, None),
    }
    assert sizes.keys() <= files.keys()
    for name, (count, recorded) in sizes.items():
        read = ScenarioFilter.from_yaml(files[name])
        assert len(set(read.scenario_tokens or ())) == count
        assert len(read.base_tokens or ()) == recorded or (
            recorded is None and len(read.base_tokens or ()) < count and read.has_variants
        )
        assert set(read.scenario_types or ()) <= TAGGED_TYPES
    with pytest.raises(ScenarioError, match="accel_max"):
        ScenarioFilter.from_yaml(files["interPlan_modifications.yaml"])
