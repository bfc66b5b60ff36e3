"""A simulation killed at any moment goes on where it stopped: nothing lost, nothing twice."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars
import pytest
from polars.testing import assert_frame_equal

import small_road as roads
import sweep_child as child
from spdm_experiments import cli
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario

SPEEDS = (4.0, 6.0, 8.0, 10.0, 12.0)
MOMENTS = (("half a part", 1), ("compute", 1), ("part without progress", 1), ("half a part", 1))
"""What every process is killed at, and at which of its chunks."""
FINISHED = (0, 0, 1, 1)
"""Chunks on disk after each kill."""


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    for number, speed in enumerate(SPEEDS):
        raw = roads.road(token=f"road-{number}", speed=speed)
        write_scenario(folder / f"road-{number}.npz", *build_scenario(raw))
    return folder


def arguments(pack: Path, out: Path) -> list[str]:
    drivers = ["--planner", "constant-velocity", "log-replay", "--traffic", "replay"]
    given = ["simulate", str(pack), "--out", str(out), "--chunk", "2", "--record", "history"]
    return [*given, *drivers]


def read_rows(out: Path) -> polars.DataFrame:
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    return table.drop("run_ms").sort("token", "point")


def read_histories(out: Path) -> dict[tuple[str, int], np.ndarray]:
    found: dict[tuple[str, int], np.ndarray] = {}
    for path in sorted(out.rglob("part-*.npz")):
        with np.load(path) as part:
            for i, token in enumerate(part["token"].tolist()):
                key = (token, int(part["point"][i]))
                assert key not in found
                found[key] = part["ego"][i]
    return found


@pytest.mark.slow
def test_killed_again_and_again_it_still_ends_equal(pack: Path, tmp_path: Path):
    whole, out = tmp_path / "whole", tmp_path / "run"
    assert cli.main(arguments(pack, whole)) == 0
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    for (moment, count), finished in zip(MOMENTS, FINISHED, strict=True):
        command = [sys.executable, str(child.__file__), moment, str(count), *arguments(pack, out)]
        with subprocess.Popen(command, text=True, env=dict(os.environ), **pipes) as process:
            assert process.stdout and process.stderr
            assert process.stdout.readline() == "stopped\n", process.stderr.read()
            process.send_signal(signal.SIGKILL)
        assert process.returncode == -signal.SIGKILL
        assert len(list((out / "rows").glob("part-*.parquet"))) == finished
    assert cli.main(arguments(pack, out)) == 0
    assert not [path for path in out.rglob("*.tmp")]
    assert_frame_equal(read_rows(out), read_rows(whole))
    mine, theirs = read_histories(out), read_histories(whole)
    assert mine.keys() == theirs.keys() and len(mine) == 2 * len(SPEEDS)
    for key, poses in theirs.items():
        np.testing.assert_array_equal(mine[key], poses)
    about = json.loads((out / "progress-all.json").read_text())
    assert about["finished"] and about["done"] == len(SPEEDS)
