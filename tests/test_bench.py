"""The benchmark runs and names what it measured (toy size, nothing is timed)."""

import json

import pytest

from spdm_experiments import bench


def test_fan_starts_at_the_ego_and_repeats():
    first = bench.fan(64)
    assert first.shape == (64, 41, 3) and (first[:, 0] == 0).all()
    assert (first == bench.fan(64)).all()


@pytest.mark.slow
def test_quick_run_writes_rows(tmp_path, capsys):
    assert bench.main(["--quick", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    workloads = [row["workload"] for row in content["rows"]]
    assert workloads[0] == "PDM-Closed 15" and workloads[1].startswith("PDM-Closed 15: ")
    assert workloads[-2:] == ["track + score 64", "2 scenes x 15"]
    assert all(row["median_ms"] > 0 and row["yardstick_ms"] > 0 for row in content["rows"])
    assert {"jax", "commit", "date", "scene"} <= content["about"].keys()
    assert "quoted" in capsys.readouterr().out
