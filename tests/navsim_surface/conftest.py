"""Frames that the tests of the surface share."""

from pathlib import Path

import pytest

import spdm_jax
from navsim_stand_in import metric_cache, replay, road_scene
from spdm_jax.navsim.navsim_export import export, write

SPEEDS = (8.0, 6.0)


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two exported frames, "fast" and "slow", of one road."""
    folder = tmp_path_factory.mktemp("exported")
    for token, speed in zip(("fast", "slow"), SPEEDS, strict=True):
        arrays = export(metric_cache(replay(road_scene(speed), 41)), token)
        write(folder / f"{token}.npz", arrays)
    return folder


@pytest.fixture(scope="session")
def frames(exported: Path) -> spdm_jax.NavsimSet:
    return spdm_jax.load_navsim(exported)
