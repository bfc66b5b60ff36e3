"""The README's Python example runs as printed."""

import re
from pathlib import Path

import numpy as np

README = Path(__file__).resolve().parents[1] / "README.md"


def test_python_example_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    names: dict = {}
    exec(blocks[0], names)
    assert names["scores"].total.shape == (2, 7)
    assert np.all(names["plans"].num_proposals > 15)
    assert "scene parked_car-0" in capsys.readouterr().out
