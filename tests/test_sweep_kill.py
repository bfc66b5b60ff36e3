"""A sweep killed at any moment goes on where it stopped: nothing lost, nothing twice."""

import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars
import pytest
from polars.testing import assert_frame_equal

import sweep_child as child
import sweep_pack as packs
from spdm_experiments import cli, sweep_work

COUNT = 9


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    packs.write_pack(folder, COUNT)
    return folder


def arguments(pack: Path, out: Path) -> list[str]:
    grid = ["--num-proposals", "15", "30", "--set", "idm.headway_time=1,2"]
    return ["sweep", str(pack), "--out", str(out), "--chunk", "2", "--trajectories", *grid]


def read_rows(out: Path) -> polars.DataFrame:
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    return table.drop("run_ms").sort("token", "point")


def read_poses(out: Path) -> dict[tuple[str, int], np.ndarray]:
    poses: dict[tuple[str, int], np.ndarray] = {}
    for path in sorted((out / "trajectories").glob("part-*.npz")):
        part = np.load(path)
        for i, token in enumerate(part["token"].tolist()):
            key = (token, int(part["point"][i]))
            assert key not in poses
            poses[key] = np.stack([part["reference"][i], part["tracked"][i]])
    return poses


@pytest.fixture(scope="module")
def whole(pack: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_work, "read_scene", child.cheap_read)
        assert cli.main(arguments(pack, out)) == 0
    return out


def start(moment: str, count: int, given: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, str(child.__file__), moment, str(count), *given]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(command, text=True, env=dict(os.environ), **pipes)


MOMENTS = [
    ("load", 1),
    ("half a part", 1),
    ("compute", 2),
    ("trajectories without rows", 1),
    ("part without progress", 1),
    ("half a part", 2),
]


@pytest.mark.parametrize("moments", [MOMENTS[5:], pytest.param(MOMENTS, marks=pytest.mark.slow)])
def test_killed_again_and_again_it_still_ends_equal(
    moments: list[tuple[str, int]], pack: Path, whole: Path, tmp_path: Path
):
    out = tmp_path / "run"
    given = arguments(pack, out)
    done = 0
    for moment, count in moments:
        process = start(moment, count, given)
        assert process.stdout and process.stderr
        with process:
            line = process.stdout.readline()
            assert line == "stopped\n", process.stderr.read()
            process.send_signal(signal.SIGKILL)
        assert process.returncode == -signal.SIGKILL
        # What was there stays: of these chunks all but the one in flight are finished.
        done += count - (moment != "part without progress") if moment != "load" else 0
        assert len(list((out / "rows").glob("part-*.parquet"))) == done
    assert list((out / "rows").glob(".*.tmp"))  # the last kill left half a part
    assert 0 < done < COUNT / 2
    process = start("run", 0, given)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert f"{COUNT} of {COUNT} scenarios done, 0 failed" in printed
    assert not [path for path in out.rglob("*.tmp")]
    assert_frame_equal(read_rows(out), read_rows(whole))
    mine, theirs = read_poses(out), read_poses(whole)
    assert mine.keys() == theirs.keys() and len(mine) == 4 * COUNT
    for key, poses in theirs.items():
        np.testing.assert_array_equal(mine[key], poses)
    about = json.loads((out / "progress-all.json").read_text())
    assert about["finished"] and about["done"] == COUNT and len(about["sessions"]) >= len(moments)


def test_interrupt_ends_the_chunk_and_names_the_command(pack: Path, whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    given = arguments(pack, out)
    with start("compute", 2, given) as process:
        assert process.stdout and process.stderr
        assert process.stdout.readline() == "stopped\n"
        process.send_signal(signal.SIGINT)
        while "stopping after this chunk" not in process.stderr.readline():
            assert process.poll() is None
        printed, errors = process.communicate("\n", timeout=120)
    assert process.returncode == 130
    assert "4 of 9 scenarios done, 0 failed" in printed
    assert f"interrupted; go on with: spdm {shlex.join(given)}" in errors
    assert read_rows(out).height == 4 * 4
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_work, "read_scene", child.cheap_read)
        assert cli.main(given) == 0
    assert_frame_equal(read_rows(out), read_rows(whole))
