"""Weights of the named models: saved, read back, converted by the command line."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from spdm_experiments import cli
from spdm_models import dipp, dtpp, gameformer
from spdm_models.checkpoint import read_checkpoint
from spdm_models.dipp import DIPPConfig
from spdm_models.dtpp import DTPPConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.state_dict import flatten
from spdm_models.weights import ModelName, load_weights, save_weights

KEY = jax.random.key(0)
ENCODER = EncoderConfig(width=16, layers=1)
MODELS: dict[ModelName, tuple[Any, Any]] = {
    "gameformer": (gameformer, GameFormerConfig(ENCODER, levels=2, modes=3, neighbors=4, steps=8)),
    "dtpp": (dtpp, DTPPConfig(ENCODER, seconds=3)),
    "dipp": (dipp, DIPPConfig(width=16, modes=2, horizon=7)),
}


def same(a, b) -> bool:
    mine, theirs = flatten(a), flatten(b)
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[k], theirs[k]) for k in mine)


@pytest.mark.parametrize("name", MODELS)
def test_weights_come_back(name: ModelName, tmp_path: Path):
    module, config = MODELS[name]
    params, path = module.init(config, KEY), tmp_path / "w.safetensors"
    save_weights(path, name, config, params)
    found, read = load_weights(path, name)
    assert found == config and same(read, params)
    # Without what the file says of itself, the sizes come from the arrays.
    np.savez(tmp_path / "w.npz", allow_pickle=False, **read_checkpoint(path))
    found, read = load_weights(tmp_path / "w.npz", name)
    assert found == config and same(read, params)
    more = {f"model.{name}": value for name, value in read_checkpoint(path).items()}
    np.savez(tmp_path / "more.npz", allow_pickle=False, **more)
    arguments = [str(tmp_path / "more.npz"), str(tmp_path / "new.safetensors"), "--model", name]
    assert cli.main(["convert", *arguments, "--prefix", "model"]) == 0
    found, read = load_weights(tmp_path / "new.safetensors", name)
    assert found == config and same(read, params)
    other: ModelName = "dtpp" if name == "dipp" else "dipp"
    with pytest.raises(ValueError, match=rf"w\.safetensors holds weights of {name}, not of"):
        load_weights(path, other)
    with pytest.raises(ValueError, match=r"w\.npz: .*no state dict of"):
        load_weights(tmp_path / "w.npz", other)


def test_settings_that_arrays_do_not_tell(tmp_path: Path):
    module, config = MODELS["dtpp"]
    variable = dataclasses.replace(config, variable_cost=True)
    path = tmp_path / "w.safetensors"
    save_weights(path, "dtpp", variable, module.init(variable, KEY))
    assert load_weights(path, "dtpp")[0] == variable
    assert load_weights(path, "dtpp", variable_cost=False)[0] == config
    with pytest.raises(ValueError, match=r"settings of DTPPConfig .*'colour'"):
        load_weights(path, "dtpp", colour=3)


def test_convert_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    module, config = MODELS["dipp"]
    path = tmp_path / "w.safetensors"
    save_weights(path, "dipp", config, module.init(config, KEY))
    state = read_checkpoint(path)
    state["plan.control.1.bias"][2] = np.nan
    np.savez(tmp_path / "bad.npz", allow_pickle=False, **state)
    target = tmp_path / "new.safetensors"
    for source, extra, message in (
        (tmp_path / "bad.npz", [], "plan.control.1.bias holds 1 values that are not finite"),
        (path, ["--prefix", "model"], "nothing below 'model'"),
        (path, ["--variable-cost"], "--variable-cost is a setting of dtpp, not of dipp"),
        (tmp_path / "none.pth", [], "none.pth: no such file"),
    ):
        command = ["convert", str(source), str(target), "--model", "dipp", *extra]
        assert cli.main(command) == 2
        assert message in capsys.readouterr().err
        assert not target.exists()
    assert cli.main(["convert", str(path), str(tmp_path / "w.npz"), "--model", "dipp"]) == 2
    assert "give the file that ending" in capsys.readouterr().err
