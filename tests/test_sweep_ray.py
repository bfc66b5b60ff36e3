"""A sweep on a local Ray cluster whose worker is killed: nothing lost, nothing twice."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import polars
import pytest
from polars.testing import assert_frame_equal

import sweep_pack
from spdm_experiments import cli

TABLE = Path("/proc")
COUNT = 12


def test_sweep_without_ray_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["pack", "straight", str(tmp_path / "pack")]) == 0
    command = ["sweep", str(tmp_path / "pack"), "--out", str(tmp_path / "run")]
    assert cli.main([*command, "--cluster", "local"]) == 2
    assert 'pip install "spdm-jax[cluster]"' in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def busy_workers(driver: int) -> list[int]:
    """Processes below `driver` that compute a chunk right now; Ray names them after the task."""
    parent, title = {}, {}
    for folder in TABLE.iterdir():
        if folder.name.isdecimal():
            try:
                stat = (folder / "stat").read_text()
                command = (folder / "cmdline").read_bytes()
            except OSError:  # it ended meanwhile
                continue
            parent[int(folder.name)] = int(stat.rpartition(")")[2].split()[1])
            title[int(folder.name)] = command.split(b"\0")[0].decode(errors="replace").strip()

    def below(process: int) -> bool:
        while process in parent:
            if process == driver:
                return True
            process = parent[process]
        return False

    return [p for p, name in title.items() if name == "ray::run_chunk" and below(p)]


def read_rows(out: Path) -> polars.DataFrame:
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    return table.drop("run_ms").sort("token", "point")


@pytest.mark.slow
def test_lost_worker_costs_nothing(tmp_path: Path):
    pytest.importorskip("ray")
    if not TABLE.is_dir():
        pytest.skip("needs the process table in /proc")
    pack, whole, out = (tmp_path / name for name in ("pack", "whole", "run"))
    sweep_pack.write_pack(pack, COUNT)
    grid = ["--planner", "pdm-closed", "--num-proposals", "3", "--trajectories"]
    start = [sys.executable, "-m", "spdm_experiments.cli", "sweep", str(pack), *grid, "--out"]
    # In a process of its own, which leaves its program for the workers to load.
    subprocess.run([*start, str(whole)], check=True, capture_output=True)
    # Every chunk is so small that both workers are busy most of the time.
    more = ["--cluster", "local:2", "--chunk", "1"]
    driver = subprocess.Popen(
        [*start, str(out), *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    killed = []
    with driver:
        try:
            deadline = time.monotonic() + 300
            while driver.poll() is None and time.monotonic() < deadline:
                if len(list((out / "rows").glob("part-*"))) > len(killed) and len(killed) < 2:
                    for process in busy_workers(driver.pid)[:1]:
                        os.kill(process, signal.SIGKILL)
                        killed.append(process)
                time.sleep(0.02)
            printed, errors = driver.communicate(timeout=60)
        finally:
            driver.kill()
    assert driver.returncode == 0, errors
    assert killed, "no worker was busy: the test shows nothing"
    assert f"{COUNT} of {COUNT} scenarios done, 0 failed" in printed
    assert_frame_equal(read_rows(out), read_rows(whole), abs_tol=1e-5)
    assert not list(out.rglob("*.tmp"))
    about = json.loads((out / "progress-all.json").read_text())
    assert about["finished"] and about["done"] == COUNT
    assert about["sessions"][0]["scenarios"] == COUNT
