"""Packs of scenarios for the tests of `spdm sweep`: small, told apart by the ego's speed."""

from pathlib import Path

import numpy as np

from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.synthetic import make_scene


def write_pack(folder: Path, count: int, *, slow: int = 0) -> list[str]:
    """Writes `count` scenarios, scene i with an ego that drives 0.25 i m/s faster; returns tokens.

    Args:
      folder: made if absent.
      count: scenarios.
      slow: of them, those that get a negative speed, from the first on.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scenario, info = build_scenario(make_scene("lane_ends"))
    tokens = []
    for i in range(count):
        token = f"scene-{i:02d}"
        speed = np.asarray(scenario.ego.vx) + 0.25 * i
        ego = scenario.ego.replace(vx=-1 - speed if i < slow else speed)
        fields = {**vars(info), "token": token}
        write_scenario(folder / f"{token}.npz", scenario.replace(ego=ego), type(info)(**fields))
        tokens.append(token)
    return tokens
