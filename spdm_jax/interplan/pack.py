"""Packs changed scenarios: scenario files, and beside each what its simulation needs besides."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from spdm_jax.interplan.extras import InterplanExtras, extras_path, write_extras
from spdm_jax.io.pack import PackReport, Progress, pack
from spdm_jax.io.raw import RawScenario


class ChangedReader(Protocol):
    """A source of changed scenarios, such as `InterplanReader`."""

    def tokens(self) -> Sequence[str]:
        """Returns their names."""
        ...

    def read_with_extras(self, token: str) -> tuple[RawScenario, InterplanExtras]:
        """Reads one scenario, changed, and what its simulation needs besides."""
        ...


def pack_interplan(
    reader: ChangedReader,
    destination: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> PackReport:
    """Writes `NAME.npz` and `NAME.interplan.json` for every scenario; see `pack`.

    A scenario file without extras is no complete one and is written anew.

    Args:
      reader: changed scenarios.
      destination: folder, made if absent.
      overwrite: write all files anew.
      progress: see `Progress`.

    Raises:
      ValueError: the reader names a scenario twice.
      OSError: the folder cannot be written.
    """
    folder = Path(destination)
    for token in reader.tokens():
        path = folder / f"{token}.npz"
        if not extras_path(path).exists():
            path.unlink(missing_ok=True)
    return pack(_Writing(reader, folder), folder, overwrite=overwrite, progress=progress)


class _Writing:
    """Leaves the extras of what it reads in a folder, before the scenario file is written."""

    def __init__(self, reader: ChangedReader, folder: Path) -> None:
        self._reader, self._folder = reader, folder

    def tokens(self) -> Sequence[str]:
        return self._reader.tokens()

    def read(self, token: str) -> RawScenario:
        raw, extras = self._reader.read_with_extras(token)
        write_extras(extras_path(self._folder / f"{token}.npz"), extras)
        return raw
