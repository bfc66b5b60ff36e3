"""Scenario files of the built-in suites, made once and kept in the user's cache folder."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from spdm_experiments.sources import Selection
from spdm_experiments.terminal import progress_line
from spdm_jax.compile_cache import default_folder
from spdm_jax.io import raw
from spdm_jax.io.pack import pack
from spdm_jax.synthetic import suites
from spdm_jax.types import SCHEMA_VERSION


def packed_suite(reader: suites.SuiteReader, name: str, tokens: Sequence[str]) -> Path:
    """Returns the folder that holds some scenes of a suite; makes those that are missing.

    Args:
      reader: offers them.
      name: of the suite.
      tokens: wanted scenes.

    Raises:
      ValueError: a scene cannot be made.
    """
    folder = default_folder() / "suites" / f"{name}-{_source_digest()}"
    if missing := [token for token in tokens if not (folder / f"{token}.npz").exists()]:
        with progress_line(f"packing {name}", len(missing)) as advance:
            report = pack(
                Selection(reader, missing, None),
                folder,
                progress=lambda done, total, token, outcome: advance(done),
            )
        if report.failed:
            token, reason = next(iter(report.failed.items()))
            raise ValueError(f"suite {name}: {token}: {reason}")
    return folder


def _source_digest() -> str:
    """Digest of the code that makes the files of a suite: other code makes others."""
    digest = hashlib.sha256(str(SCHEMA_VERSION).encode())
    for module in (suites, raw):
        for path in sorted(Path(module.__file__ or "").parent.glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
