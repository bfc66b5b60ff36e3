"""Parity with stored reference runs: a handful of files here, all of them in the slow test."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT.parent / "shared" / "golden"
FEW = ("unit_comfort", "unit_path", "unit_lqr", "unit_driving_direction")
FEW_SIMULATED = ("single_steps", "curve_tail", "yellow_then_red", "random_4")
FEW_RUNS = ("random_5", "offroad_0p2", "sn_none_speed_limit")
FEW_FRAMES = ("scene_cut_in", "scene_red_light", "unit_comfort", "unit_two_stage_weights")
FEW_PLANNERS = (
    "dipp/planner_f64_seed1",
    "gameformer/planner_seed0",
    "gameformer/ar_tokens_seed0",
)


def compare(folder: Path, precision: str) -> str:
    """Runs the comparison as a user would; returns what it printed."""
    command = [sys.executable, "-m", "tests.parity", "--golden", str(folder)]
    run = subprocess.run(
        [*command, "--precision", precision, "--brief"], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode in (0, 1), run.stderr[-2000:]
    assert run.returncode == 0, run.stdout[-3000:]
    return run.stdout


@pytest.fixture
def golden() -> Path:
    if not GOLDEN.is_dir():
        pytest.skip("reference data not at hand")
    return GOLDEN / "pdm"


@pytest.mark.parametrize("precision", [pytest.param("f64", marks=pytest.mark.slow), "f32"])
def test_units(golden: Path, tmp_path: Path, precision: str):
    for name in FEW:
        (tmp_path / f"{name}.npz").symlink_to(golden / f"{name}.npz")
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_a_scene(golden: Path, tmp_path: Path, precision: str):
    scene = sorted(path.name for path in golden.glob("scorer_*.npz"))[0].removeprefix("scorer_")
    for kind in ("scene", "scorer"):
        (tmp_path / f"{kind}_{scene}").symlink_to(golden / f"{kind}_{scene}")
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.parametrize("precision", ["f64", pytest.param("f32", marks=pytest.mark.slow)])
def test_closed_loop_metrics(golden: Path, tmp_path: Path, precision: str):
    runs = golden.with_name("nuplan_metrics") / "closed_loop"
    for name in ("maps", *(f"{run}.{ending}" for run in FEW_RUNS for ending in ("json", "npz"))):
        (tmp_path / name).symlink_to(runs / name)
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_simulation(golden: Path, tmp_path: Path, precision: str):
    cases = golden.with_name("nuplan_sim")
    for name in FEW_SIMULATED:
        for path in cases.glob(f"*/{name}.*"):
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "maps").symlink_to(cases / "idm" / "maps")
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_navsim(golden: Path, tmp_path: Path, precision: str):
    for name in FEW_FRAMES:
        path = golden.with_name("navsim") / f"{name}.npz"
        (tmp_path / path.name).symlink_to(path)
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_planners_of_models(golden: Path, tmp_path: Path, precision: str):
    for name in FEW_PLANNERS:
        path = golden.with_name("models") / f"{name}.npz"
        (tmp_path / path.name).symlink_to(path)
    assert ", 0 failed" in compare(tmp_path, precision)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_everything(golden: Path, precision: str):
    assert ", 0 failed" in compare(golden.parent, precision)
