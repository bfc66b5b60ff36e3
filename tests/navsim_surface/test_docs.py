"""The examples of docs/navsim.md run as printed."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from spdm_jax.navsim import navsim_export

PAGE = Path(__file__).resolve().parents[2] / "docs" / "navsim.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_python_examples_run(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    pytest.importorskip("torch", reason="PyTorch is not installed")
    shutil.copytree(exported, tmp_path / "exported")
    monkeypatch.chdir(tmp_path)
    score, comfort, reward, scenarios = BLOCKS
    names: dict = {}
    exec(score, names)
    assert names["result"].total.shape == (2, 2) and names["table"].height == 4
    assert "scene fast, proposal 1" in capsys.readouterr().out
    exec(comfort, names)
    assert names["result"].scores.has_extended_comfort.tolist() == [True, False]
    exec(reward, names)
    assert names["reward"].shape == (2, 2) and len(names["terms"]) == 2
    exec(scenarios, names)
    assert np.shape(names["result"].total) == (1, 1)
    assert "on a red connector" in capsys.readouterr().out


def test_every_array_is_on_the_page():
    page = PAGE.read_text(encoding="utf-8").split("## The files")[1]
    listed = set(re.findall(r"`([a-z_]+)`", page))
    source = Path(navsim_export.__file__).read_text(encoding="utf-8")
    written = set(re.findall(r'"([a-z_]+)": ', source)) | set(
        re.findall(r'arrays\["(\w+)"\]', source)
    )
    assert written <= listed
