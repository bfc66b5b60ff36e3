"""Compiled programs in the process: found again, and dropped when there is no more room."""

import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import lapack_child
from spdm_jax import programs


def scaled(factor: int, x: jax.Array) -> jax.Array:
    return factor * x


def program(factor: int) -> tuple[programs.Program, bool]:
    make = lambda: jax.jit(partial(scaled, factor))
    args = (jax.ShapeDtypeStruct((3,), np.float32),)
    return programs.program(("scaled", factor), scaled, make, args, jax.devices()[:1])


@pytest.fixture(autouse=True)
def none_yet(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(programs, "_PROGRAMS", {})


def made(factor: int) -> bool:
    found, new = program(factor)
    np.testing.assert_array_equal(found.call(np.ones(3, np.float32)), np.full(3, factor))
    return new


def test_programs_are_made_once():
    assert [made(factor) for factor in (2, 3, 2, 3)] == [True, True, False, False]


def test_the_program_used_least_recently_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    maps, allowed = tmp_path / "maps", tmp_path / "max"
    maps.write_text("map\n" * 10)
    allowed.write_text("20\n")
    monkeypatch.setattr(programs, "_MAPS", maps)
    monkeypatch.setattr(programs, "_MAX_MAPS", allowed)
    assert [made(factor) for factor in (2, 3, 2)] == [True, True, False]
    monkeypatch.setattr(programs, "_MAP_SHARE", 0.1)

    # Nothing that is dropped changes these numbers, so all go.
    assert made(4) and len(programs._PROGRAMS) == 1
    monkeypatch.setattr(programs, "_MAP_SHARE", 0.6)
    assert made(2) and made(3) and not made(2)

    dropped = []
    monkeypatch.setattr(programs, "_MAP_SHARE", 0.1)
    # As if dropping one program were enough.
    monkeypatch.setattr(programs.gc, "collect", lambda: (dropped.append(1), maps.write_text("")))
    assert made(5) and dropped == [1]
    monkeypatch.setattr(programs, "_MAP_SHARE", 0.6)
    assert not made(3) and not made(2) and made(4)


def test_systems_that_do_not_tell_keep_all(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(programs, "_MAPS", Path("/nowhere/maps"))
    monkeypatch.setattr(programs, "_MAX_MAPS", Path("/nowhere/max"))
    assert made(2) and made(3) and not made(2)


def test_stored_programs_find_lapack(tmp_path: Path):
    child = Path(lapack_child.__file__)
    told = []
    for _ in range(2):
        run = subprocess.run(
            [sys.executable, str(child), str(tmp_path)], capture_output=True, text=True
        )
        assert run.returncode == 0, run
        told.append(run.stdout.strip())
    assert told == [f"{stored} [[2.0, 0.0], [0.0, 3.0]]" for stored in (False, True)]
