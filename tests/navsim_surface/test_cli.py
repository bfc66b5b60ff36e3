"""`spdm score` and `spdm label` with NAVSIM's profiles."""

import json
from pathlib import Path

import numpy as np
import polars
import pytest

import spdm_jax
from navsim_stand_in import straight
from spdm_experiments.cli import main
from spdm_jax import NavsimSet, open_labels
from spdm_jax.io.scenario_file import read_scenario, write_scenario
from spdm_jax.navsim import navsim_export
from spdm_jax.navsim.results import component

DRIVES = np.concatenate([straight(8.0, 16.0, 0.5), straight(8.0, left=-0.6)])


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with trajectories of each kind."""
    np.save(tmp_path / "drives.npy", DRIVES)
    rows = np.stack([DRIVES[::-1], DRIVES])
    np.savez(tmp_path / "rows.npz", trajectories=rows, tokens=np.array(["slow", "fast"]))
    np.savez(tmp_path / "previous.npz", trajectories=DRIVES[:1], tokens=np.array(["fast"]))
    return tmp_path


def run(*words: object) -> int:
    return main([*map(str, words), "--device", "cpu"])


def test_score_is_that_of_the_api(exported: Path, frames: NavsimSet, files: Path, capsys):
    out = files / "out"
    given = ("score", exported, files / "drives.npy", "--profile", "navsim2", "--out", out)
    assert run(*given) == 0
    text = capsys.readouterr().out
    assert "2 of 2 scenarios done, 0 failed; mean score" in text and "TLC traffic lights" in text
    table = polars.read_parquet(out / "rows.parquet")
    wanted = spdm_jax.score(frames, DRIVES, profile="navsim2").to_table()
    assert table.select(wanted.columns).equals(wanted)
    about = json.loads((out / "run.json").read_text())
    assert about["profile"] == "navsim2" and about["dt"] == 0.5 and about["finished"]
    # One frame per chunk, sets by token, with the plans of the frame before.
    rest = ("--chunk", 1, "--previous", files / "previous.npz")
    assert run(*given[:2], files / "rows.npz", *given[3:], *rest) == 0
    table = polars.read_parquet(out / "rows.parquet")
    mine = table.filter(token="slow")["total"].to_numpy()
    np.testing.assert_allclose(mine[::-1], wanted.filter(token="slow")["total"], atol=1e-6)
    assert table.filter(token="fast", proposal=0)["extended_comfort"].item() == 1


def test_labels_are_those_of_score(exported: Path, frames: NavsimSet, files: Path, capsys):
    out = files / "labels"
    given = ("label", exported, files / "drives.npy", "--profile", "navsim2", "--out", out)
    assert run(*given, "--dtype", "f32", "--chunk", 1) == 0
    assert "4 trajectories x 10 components of navsim2" in capsys.readouterr().out
    labels = open_labels(out)
    assert labels.tokens == ["fast", "slow"] and labels.vocabulary().shape == (4, 8, 3)
    assert labels.components[:2] == ("total", "no_at_fault_collision")
    assert "extended_comfort" not in labels.components
    wanted = spdm_jax.score(frames, DRIVES, profile="navsim2")
    for row, token in enumerate(labels.tokens):
        for column, name in enumerate(labels.components):
            expected = component(wanted.scores, name)[row]
            np.testing.assert_array_equal(labels[token][:, column], expected, err_msg=name)
    assert labels.about["config"] == {"profile": "navsim2"}
    assert run(*given, "--dtype", "f32", "--chunk", 1) == 0
    assert "all 2 scenarios were done already" in capsys.readouterr().out
    other = ("--profile", "navsim2_unfiltered", "--dtype", "f32")
    assert run(*given[:3], *other, "--out", out) == 2
    assert "config" in capsys.readouterr().err


def test_broken_frame_is_a_failure(exported: Path, files: Path, capsys):
    folder = files / "frames"
    folder.mkdir()
    for path in exported.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "torn.npz").write_bytes((exported / "fast.npz").read_bytes()[:1000])
    given = (folder, files / "drives.npy", "--profile", "navsim2")
    assert run("score", *given, "--out", files / "out") == 1
    assert "torn.npz: damaged" in capsys.readouterr().out
    rows = polars.read_parquet(files / "out" / "rows.parquet")
    assert rows.filter(token="torn")["status"].item() == "failed"
    assert run("label", *given, "--out", files / "labels") == 1
    assert "damaged" in open_labels(files / "labels").failures["torn"]


def test_every_frame_that_cannot_be_built_has_its_own_reason(exported: Path, files: Path, capsys):
    folder = files / "frames"
    folder.mkdir()
    with np.load(exported / "fast.npz") as stored:
        arrays = dict(stored)
    for token, name in (("a", "reference"), ("b", "ego_state")):
        broken = {name: arrays[name] * np.nan, "token": np.array(token)}
        navsim_export.write(folder / f"{token}.npz", {**arrays, **broken})
    given = (folder, files / "drives.npy", "--profile", "navsim2")
    assert run("score", *given, "--out", files / "out") == 1
    text = capsys.readouterr().out
    assert "a.npz: reference[0, 0] is nan" in text and "b.npz: ego_state[0] is nan" in text
    assert run("label", *given, "--out", files / "labels") == 1
    failures = open_labels(files / "labels").failures
    assert "ego_state" in failures["b"] and "reference" in failures["a"]


@pytest.mark.slow
def test_scenario_files(files: Path, capsys):
    packed = files / "packed"
    assert main(["pack", "red_light,parked_car", str(packed)]) == 0
    np.save(files / "fast.npy", straight(22.0, 0.0))
    given = (packed, files / "fast.npy", "--profile", "navsim2")
    assert run("score", *given, "--out", files / "out", "--chunk", 1) == 0
    rows = polars.read_parquet(files / "out" / "rows.parquet")
    assert rows.filter(token="red_light-0")["traffic_light"].to_list() == [0, 1]
    assert run("label", *given, "--out", files / "labels", "--dtype", "f32") == 0
    labels = open_labels(files / "labels")
    for token in labels.tokens:
        wanted = rows.filter(token=token)["total"].to_numpy()
        np.testing.assert_allclose(labels[token][:, 0], wanted, rtol=0, atol=1e-5)
    # One scenario whose record is too short is a failure; the other is scored.
    path = packed / "parked_car-0.npz"
    scene, info = read_scenario(path)
    short = np.arange(len(scene.ego_valid)) < int(scene.num_history) + 30
    write_scenario(path, scene.replace(ego_valid=scene.ego_valid & short), info)
    assert run("score", *given, "--out", files / "out") == 1
    assert "parked_car-0: records 2.5 s after iteration 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, text",
    [
        (("--profile", "navsim2", "--tracker", "none"), "--tracker does not apply to NAVSIM's"),
        (("--profile", "navsim1"), "exported with NAVSIM v2"),
        (("--profile", "navsim2", "--dt", "0.1"), "8 steps at 0.1 s"),
        (("--dt", "0.5"), "holds frames exported from NAVSIM"),
    ],
)
def test_options_that_do_not_apply(
    exported: Path, files: Path, words: tuple[str, ...], text: str, capsys
):
    for verb in ("score", "label"):
        given = (verb, exported, files / "drives.npy", *words, "--out", files / "out")
        code = run(*given)
        told = capsys.readouterr()
        assert code == 2, told
        assert text in " ".join(told.err.split())


def test_files_of_previous_plans_are_checked(exported: Path, files: Path, capsys):
    given = ("score", exported, files / "drives.npy", "--out", files / "out", "--previous")
    assert run(*given, files / "previous.npz") == 2
    assert "--previous is for --profile navsim2" in capsys.readouterr().err
    assert run(*given, files / "drives.npy", "--profile", "navsim2") == 2
    assert 'no .npz file of "tokens" and "trajectories"' in capsys.readouterr().err
    np.savez(files / "other.npz", trajectories=DRIVES[:1], tokens=np.array(["x"]))
    assert run(*given, files / "other.npz", "--profile", "navsim2") == 2
    assert "holds a plan for none of the 2 frames" in capsys.readouterr().err


def test_unknown_component(exported: Path, files: Path, capsys):
    given = ("label", exported, files / "drives.npy", "--out", files / "out")
    assert run(*given, "--profile", "navsim2", "--components", "total,speed") == 2
    assert "no component 'speed' in navsim2; there are all, total" in capsys.readouterr().err


def test_script_for_the_devkit_is_written(tmp_path: Path, capsys):
    path = tmp_path / "navsim_export.py"
    assert main(["navsim-script", str(path)]) == 0
    assert path.read_text() == Path(navsim_export.__file__).read_text()
    assert f"python {path} METRIC_CACHE OUT" in capsys.readouterr().out
