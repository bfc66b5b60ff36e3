"""`spdm train`: its folder, a training that goes on, what it says of bad input.

What is trained here is a small map beside a network that stays nearly as it was: the loop does not
care, and it compiles in no time. tests/models/test_train_tasks.py trains the real losses.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import polars
import pytest

from spdm_experiments import cli, train
from spdm_jax.io.pack import pack
from spdm_models import gameformer, train_tasks
from spdm_models.checkpoint import read_checkpoint, read_metadata
from spdm_models.weights import load_weights
from training_roads import GAMEFORMER, raw_roads, small_task

NUM_ROADS, STEPS = 9, 20


class Roads:
    """A reader of the roads."""

    def __init__(self, number: int = NUM_ROADS, known: int | None = None):
        self._roads = {raw.token: raw for raw in raw_roads(number)}
        for raw in self._roads.values():
            if known is not None:
                raw.ego_valid[known:] = False

    def tokens(self):
        return tuple(self._roads)

    def read(self, token):
        return self._roads[token]


def _poses(params, batch):
    """The ego's poses if it kept the velocity that a linear map of its state gives."""
    velocity = batch.features.ego_past[:, -1, :4] @ params["map"]["weight"]
    return velocity[:, None] * 0.1 * jnp.arange(1, 81, dtype=velocity.dtype)[:, None]


def _loss(params, batch, key, planner):
    noise = 0 if key is None else 0.1 * jax.random.normal(key, batch.ego.shape)
    total = jnp.mean(jnp.square(_poses(params, batch) + noise - batch.ego))
    return total, {"same": total}


def _metrics(params, batch):
    missed = jnp.linalg.norm((_poses(params, batch) - batch.ego)[..., :2], axis=-1)
    return {"planADE": jnp.mean(missed, axis=-1), "planFDE": missed[:, -1]}


TASK = dataclasses.replace(
    small_task("gameformer"),
    init=lambda key: {
        "network": gameformer.init(GAMEFORMER, key),
        "map": {"weight": jnp.zeros((4, 3), jnp.float32)},
    },
    loss=_loss,
    metrics=_metrics,
    network=lambda params: params["network"],
    learnt=lambda params: {"forward": float(params["map"]["weight"][3, 0])},
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("roads")
    assert not pack(Roads(), folder).failed
    return folder


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(train_tasks, "make_task", lambda *given: TASK)


def command(scenes: Path, out: Path, *more: str) -> list[str]:
    fixed = f"--out {out} --steps {STEPS} --batch 4 --rate 0.1 --every 5 --stride 2".split()
    return ["train", "gameformer", str(scenes), *fixed, *more]


@pytest.fixture(scope="module")
def whole(scenes, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_tasks, "make_task", lambda *given: TASK)
        assert cli.main(command(scenes, out)) == 0
    return out


def assert_same_weights(one: Path, other: Path) -> None:
    """The headers name the commit, which may have changed meanwhile."""
    ours, theirs = (read_checkpoint(folder / "weights.safetensors") for folder in (one, other))
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        assert ours[name].tobytes() == value.tobytes(), name


def test_the_folder_holds_weights_losses_and_facts(whole):
    config, _ = load_weights(whole / "weights.safetensors", "gameformer")
    assert config == GAMEFORMER
    training = read_metadata(whole / "weights.safetensors")["training"]
    assert training["steps"] == STEPS and training["samples"] == {"train": 8, "held_out": 1}
    assert training["forward"] > 0 and training["validation"]["planADE"] > 0
    about = json.loads((whole / "run.json").read_text())
    assert about["model"] == "gameformer" and about["num_scenarios"] == NUM_ROADS
    assert {"versions", "commit", "device", "fit", "input_hash"} <= about.keys()
    losses = polars.read_parquet(whole / "losses.parquet")
    assert losses.columns == ["step", "loss", "gradient", "same"]
    assert losses["step"].to_list() == list(range(1, STEPS + 1))
    assert losses["loss"][-1] < 0.5 * losses["loss"][0]
    tested = polars.read_parquet(whole / "validation.parquet")
    assert tested["step"].to_list() == list(range(2, STEPS + 1, 2))
    assert (whole / "losses.png").read_bytes().startswith(b"\x89PNG")


def test_a_finished_training_is_not_done_again(whole, scenes, capsys):
    before = (whole / "weights.safetensors").read_bytes()
    assert cli.main(command(scenes, whole)) == 0
    assert (whole / "weights.safetensors").read_bytes() == before
    # The steps between checkpoints may change; what changes the weights may not.
    assert cli.main(command(scenes, whole, "--every", "7")) == 0
    assert cli.main(command(scenes, whole, "--seed", "1")) == 2
    assert "fit.seed = 0, this command says 1" in capsys.readouterr().err


def test_a_signal_stops_and_the_command_goes_on(whole, scenes, tmp_path, monkeypatch, capsys):
    sent = []

    def show(self, done, log):
        if done >= 6 and not sent:
            sent.append(done)
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(train._StepLine, "show", show)
    assert cli.main(command(scenes, tmp_path)) == 130
    said = capsys.readouterr().err
    assert "stopping after this step" in said and "go on with: spdm train gameformer" in said
    assert not (tmp_path / "weights.safetensors").exists()
    assert len(polars.read_parquet(tmp_path / "losses.parquet")) < STEPS
    assert cli.main(command(scenes, tmp_path)) == 0
    assert_same_weights(tmp_path, whole)
    for name in ("losses.parquet", "validation.parquet"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes(), name


def test_samples_are_kept_in_a_file(whole, scenes, tmp_path, monkeypatch, capsys):
    path = tmp_path / "samples.npz"
    assert cli.main(command(scenes, tmp_path / "a", "--samples", str(path))) == 0
    assert path.exists()
    monkeypatch.setattr("spdm_experiments.train_scenes._compute", None)
    assert cli.main(command(scenes, tmp_path / "b", "--samples", str(path))) == 0
    assert_same_weights(tmp_path / "b", whole)
    other = command(scenes, tmp_path / "c", "--samples", str(path), "--stride", "1")
    assert cli.main(other) == 2
    assert "was made with other stride" in capsys.readouterr().err
    path.write_bytes(b"no archive")
    assert cli.main(command(scenes, tmp_path / "d", "--samples", str(path))) == 2
    assert f"{path}: holds no samples of gameformer" in capsys.readouterr().err


def test_without_polars_the_losses_are_text(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "polars", None)
    path = train._write_table(tmp_path / "losses", ("step", "loss"), np.array([[1, 0.5]]))
    assert path.read_text().split() == ["step,loss", "1.0,0.5"]


@pytest.mark.parametrize(
    "more, expected",
    [
        (["--held-out", "1"], "--held-out is 1.0"),
        (["--limit", "0"], "--limit is 0"),
        (["--per-type", "0"], "--per-type is 0"),
        (["--stride", "0"], "the stride is 0 steps"),
        (["--precision", "bf16", "--size", "small"], "--precision bf16 needs --size full"),
        (["--steps", "0"], "--steps is 0"),
    ],
)
def test_bad_options_are_named(scenes, tmp_path, more, expected, capsys):
    assert cli.main(command(scenes, tmp_path, *more)) == 2
    assert expected in capsys.readouterr().err


def test_bad_scenes_are_named(scenes, tmp_path, capsys):
    assert cli.main(command(tmp_path / "none", tmp_path)) == 2
    said = capsys.readouterr().err
    assert "none: no such file or folder. The built-in suites are common-14" in said
    short = tmp_path / "short"
    assert not pack(Roads(2, known=60), short).failed
    assert cli.main(command(short, tmp_path / "out")) == 2
    said = capsys.readouterr().err
    assert "no scenario can be learnt from: road-0: no start time with 8 s" in said
    with pytest.raises(SystemExit):
        cli.main(["train", "transformer", str(scenes)])


def test_scenarios_without_a_future_are_told(scenes, tmp_path, capsys):
    short = tmp_path / "short"
    assert not pack(Roads(1, known=60), short).failed
    files = [str(path) for path in sorted(scenes.glob("road-[1-8].npz"))]
    arguments = command(short, tmp_path / "out")
    assert cli.main([*arguments[:3], *files, *arguments[3:]]) == 0
    assert "1 scenario without samples:\n  road-0: no start time" in capsys.readouterr().out
    (short / "road-9.npz").write_bytes(b"damaged")
    broken = command(short, tmp_path / "broken")
    assert cli.main([*broken[:3], *files, *broken[3:]]) == 1
    assert "1 scenario failed:\n  road-9: " in capsys.readouterr().out


def test_a_suite_stands_for_scenes_that_are_not_tested_on(monkeypatch, tmp_path):
    from spdm_experiments import train_scenes
    from spdm_experiments.train_options import Train

    monkeypatch.setattr(train_scenes, "packed_suite", lambda reader, name, tokens: tmp_path)
    options = Train(model="gameformer", scenes=("common-14",), per_type=2)
    names = [path.stem for path in train_scenes._files("common-14", options)]
    assert len(names) == 28
    assert {name.rpartition("-")[2] for name in names} == {"10", "11"}


@pytest.mark.slow
def test_a_killed_command_goes_on_to_the_same_weights(scenes, tmp_path):
    run = [sys.executable, "-P", "-m", "spdm_experiments.cli"]
    fixed = f"{scenes} --size small --steps 6 --batch 4 --every 2 --stride 2".split()
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    arguments = [*run, "train", "gameformer", *fixed, "--out"]
    subprocess.run([*arguments, str(whole)], check=True)
    process = subprocess.Popen([*arguments, str(killed)])
    while not (killed / "state.safetensors").exists():
        assert process.poll() is None
    process.kill()
    process.wait()
    subprocess.run([*arguments, str(killed)], check=True)
    assert_same_weights(killed, whole)
