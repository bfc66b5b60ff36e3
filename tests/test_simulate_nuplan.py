"""From nuPlan's files to scores: filters and modifications as people have them, pack, simulate."""

from pathlib import Path

import polars
import pytest

from spdm_experiments import cli

RECORDED = "7e3e3769e416290e"
VAL14 = f"""
_target_: nuplan.planning.scenario_builder.scenario_filter.ScenarioFilter
_convert_: 'all'
scenario_types: # List of scenario types to include
  - starting_left_turn
  - following_lane_with_lead
scenario_tokens:
  - '{RECORDED}'
  - '27b62ec6fac3c3bb'
log_names: ${{splitter.log_splits.val}}
map_names: null
num_scenarios_per_type: 100
limit_total_scenarios: null
timestamp_threshold_s: 15
ego_displacement_minimum_m: null
speed_noise_tolerance: null
expand_scenarios: false
remove_invalid_goals: true
shuffle: false
"""
INTERPLAN = f"""
_target_: interplan.planning.scenario_builder.benchmark_scenario_filter.BenchmarkScenarioFilter
defaults:
  - modifications: interPlan_modifications
scenario_types: null
scenario_tokens:
  - {RECORDED}-s4
log_names: null
num_scenarios_per_type: 10
expand_scenarios: false
"""
MODIFICATIONS = f"""
accel_max: ${{oc.select:observation.accel_max, 1}}
decel_max: ${{oc.select:observation.decel_max, 2}}
scenario_specifics: null
modification_details_dictionary: # Not to be modified by the user
  {RECORDED}:
    extra_agents_spawn_locations: []
    goal:
      left: 588820.0, 4479720.0
      right: null
    special_scenario:
      '4':
        type: nudge_around_parked_vehicle
        stopped_vehicle:
        - - 588775.0
          - 4479741.0
          - -0.5
"""


@pytest.mark.slow
def test_filters_and_modifications_become_scores(shared: Path, tmp_path: Path, capsys):
    data = shared / "data" / "nuplan_format" / "pit_3bffdcff"
    if not data.is_dir():
        pytest.skip("reference data not at hand")
    pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
    files = {"val14": VAL14, "interplan": INTERPLAN, "modifications": MODIFICATIONS}
    paths = {name: tmp_path / f"{name}.yaml" for name in files}
    for name, text in files.items():
        paths[name].write_text(text)
    packed, out = tmp_path / "packed", tmp_path / "run"
    pack = ["pack", str(data), str(packed), "--filter"]
    assert cli.main([*pack, str(paths["val14"])]) == 0
    assert "log_names refers to ${splitter.log_splits.val}" in capsys.readouterr().err
    changes = ["--interplan", str(paths["modifications"])]
    assert cli.main([*pack, str(paths["interplan"]), *changes]) == 0
    assert sorted(path.stem for path in packed.glob("*.npz")) == [RECORDED, f"{RECORDED}-s4"]

    drive = ["simulate", str(packed), "--out", str(out), "--planner", "pdm-closed"]
    assert cli.main([*drive, "--num-proposals", "1", "--by-type"]) == 0
    told = " ".join(capsys.readouterr().out.split())  # narrow terminals wrap titles
    assert "scored by interPlan" in told and "Mean interplan_score by scenario type" in told
    rows = polars.read_parquet(out / "rows" / "part-*.parquet").sort("token")
    plain, changed = rows.iter_rows(named=True)
    assert plain["status"] == changed["status"] == "ok"
    assert plain["scenario_type"] == "following_lane_with_lead" and plain["samples"] == 145
    assert plain["interplan_score"] is None and plain["score"] > 0.5
    # PDM-Closed leaves its lane for nobody: it stands behind the parked car.
    assert changed["scenario_type"] == "nudge_around_parked_vehicle"
    assert changed["ego_sorts_stopped_vehicle"] == changed["interplan_score"] == 0
    assert changed["lane_changes_to_goal"] == 1 and changed["score"] > 0.5
