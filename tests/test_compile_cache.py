"""The persistent compile cache: where it lies, who may use it, when it stays off."""

import os
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from spdm_jax import compile_cache
from spdm_jax.compile_cache import (
    ENVIRONMENT_VARIABLE,
    default_folder,
    enable_compile_cache,
    machine_fingerprint,
)

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture(autouse=True)
def fresh_settings(monkeypatch: pytest.MonkeyPatch):
    """Starts each test with no cache configured and gives the run its own settings back."""
    before = {name: jax.config.values[name] for name in SETTINGS}
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    reset_cache()
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    reset_cache()
    for name, value in before.items():
        jax.config.update(name, value)


def compile_something(offset: float) -> None:
    jax.jit(lambda x: jnp.sin(x) * 3 + offset)(jnp.arange(7.0)).block_until_ready()


def test_folder_is_private_and_gets_entries(tmp_path: Path):
    folder = enable_compile_cache(tmp_path / "a" / "cache")
    assert folder is not None
    assert folder == tmp_path / "a" / "cache" / machine_fingerprint()
    for path in (folder, folder.parent):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    assert not list(folder.iterdir())
    compile_something(0.125)
    assert list(folder.glob("jit_*"))


def test_second_folder_takes_over(tmp_path: Path):
    first = enable_compile_cache(tmp_path / "first")
    compile_something(0.25)
    second = enable_compile_cache(tmp_path / "second")
    assert first is not None and second is not None
    count = len(list(first.iterdir()))
    compile_something(0.375)
    assert list(second.glob("jit_*"))
    assert len(list(first.iterdir())) == count


def test_entries_are_read_by_another_process(tmp_path: Path):
    code = (
        "import logging, jax, jax.numpy as jnp\n"
        "logging.basicConfig(level=logging.DEBUG)\n"
        "from pathlib import Path\n"
        "from spdm_jax.compile_cache import enable_compile_cache\n"
        f"enable_compile_cache(Path({str(tmp_path / 'cache')!r}))\n"
        "jax.jit(lambda x: jnp.sin(x) * 3 + 0.5)(jnp.arange(7.0))\n"
    )
    runs = [
        subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
        for _ in range(2)
    ]
    assert [run.returncode for run in runs] == [0, 0], runs[0].stderr[-500:]
    assert "Persistent compilation cache hit for 'jit__lambda" not in runs[0].stderr
    assert "Persistent compilation cache hit for 'jit__lambda" in runs[1].stderr


def test_environment_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "named"))
    assert enable_compile_cache() == tmp_path / "named" / machine_fingerprint()
    # A folder in the call wins over the one in the environment.
    assert enable_compile_cache(tmp_path / "call") == tmp_path / "call" / machine_fingerprint()


@pytest.mark.parametrize("value", ["off", "OFF", " off "])
def test_off_wins(value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, value)
    assert enable_compile_cache(tmp_path / "cache") is None
    assert not (tmp_path / "cache").exists()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_default_folder_follows_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "spdm-jax"
    assert enable_compile_cache() == tmp_path / "spdm-jax" / machine_fingerprint()
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_folder() == tmp_path / "home" / ".cache" / "spdm-jax"


def test_folder_of_jax_itself_is_respected(tmp_path: Path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    assert enable_compile_cache() == tmp_path / "own"
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path / "own")


def assert_works_without(folder: Path, reason: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert enable_compile_cache(folder) is None
    assert len(caught) == 1
    assert reason in str(caught[0].message)
    assert jax.config.values["jax_compilation_cache_dir"] is None
    compile_something(0.625)


def test_foreign_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    stranger = os.getuid() + 1
    monkeypatch.setattr(compile_cache.os, "getuid", lambda: stranger)
    assert_works_without(tmp_path / "cache", "belongs to user")


def test_folder_open_to_others_is_refused(tmp_path: Path):
    base = tmp_path / "open"
    base.mkdir()
    base.chmod(0o777)
    assert_works_without(base, "others may write to")


def test_loose_mode_of_the_own_folder_is_repaired(tmp_path: Path):
    loose = tmp_path / "cache" / machine_fingerprint()
    loose.mkdir(parents=True)
    loose.chmod(0o755)
    assert enable_compile_cache(tmp_path / "cache") == loose
    assert stat.S_IMODE(loose.stat().st_mode) == 0o700


def test_folder_that_cannot_be_created(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    assert_works_without(tmp_path / "file" / "cache", "File exists")


def test_unwritable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Root may write anywhere, so the answer of the system is replaced instead of the mode.
    monkeypatch.setattr(compile_cache.os, "access", lambda path, mode: False)
    assert_works_without(tmp_path / "cache", "is not writable")


def test_import_of_the_package_configures_nothing():
    code = (
        "import jax, spdm_jax\n"
        "from spdm_jax import compile_cache\n"
        "assert jax.config.values['jax_compilation_cache_dir'] is None"
    )
    clean = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    run = subprocess.run(
        [sys.executable, "-P", "-c", code], env=clean, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-500:]
