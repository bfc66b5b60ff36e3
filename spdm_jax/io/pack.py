"""Packs a data set into a folder of scenario files; can be stopped and started again."""

import dataclasses
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from spdm_jax import __version__
from spdm_jax.io.build import build_scenario
from spdm_jax.io.crop import MapIndex
from spdm_jax.io.raw import RawMap, RawScenario, Reader, ScenarioError
from spdm_jax.io.scenario_file import is_complete, write_atomically, write_scenario
from spdm_jax.types import SCHEMA_VERSION

REPORT_NAME = "pack.json"
_FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+=@-]*")
_MAX_INDICES = 4  # nuPlan has four maps, and its scenarios come ordered by token

Progress = Callable[[int, int, str, str], None]
"""Called after each scenario with number done, number in all, token and outcome (`written`,
`skipped` or `failed`)."""


@dataclass
class PackReport:
    """What became of each scenario of a pack; stored as `pack.json`.

    Attributes:
      total: scenarios selected by the reader.
      written: tokens written by this call.
      skipped: tokens whose files were complete before.
      failed: token -> reason.
      finished: False if the call was interrupted before the last scenario.
      sources: names of the readers of the scenarios read by this call.
      schema_version: of the files.
      library_version: that wrote the report.
    """

    total: int
    written: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    finished: bool = False
    sources: list[str] = field(default_factory=list)
    schema_version: int = SCHEMA_VERSION
    library_version: str = __version__


def pack(
    reader: Reader,
    destination: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> PackReport:
    """Writes one file `TOKEN.npz` per scenario, and `pack.json`.

    Files that are complete and of today's schema are left alone, so that a stopped run goes on
    where it ended. A scenario that cannot be read or built is listed with the reason.

    Args:
      reader: data set.
      destination: folder, made if absent.
      overwrite: write all files anew.
      progress: see `Progress`.

    Returns:
      The report, as stored.

    Raises:
      ValueError: the reader names a token twice; nothing has been written then.
      OSError: the folder cannot be written, e.g. the disk is full.
    """
    tokens = list(reader.tokens())
    if repeated := [token for token, number in Counter(tokens).items() if number > 1]:
        raise ValueError(
            f"{len(repeated)} tokens occur more than once, first {repeated[0]!r}; tokens name the "
            "files, make them unique"
        )
    folder = Path(destination)
    folder.mkdir(parents=True, exist_ok=True)
    report = PackReport(total=len(tokens))
    try:
        _pack_all(reader, tokens, folder, report, overwrite, progress)
        report.finished = True
    finally:
        content = {
            "counts": {
                "total": report.total,
                "written": len(report.written),
                "skipped": len(report.skipped),
                "failed": len(report.failed),
            },
            **dataclasses.asdict(report),
        }
        write_atomically(folder / REPORT_NAME, json.dumps(content, indent=1).encode())
    return report


def _pack_all(
    reader: Reader,
    tokens: Sequence[str],
    folder: Path,
    report: PackReport,
    overwrite: bool,
    progress: Progress | None,
) -> None:
    indices: list[MapIndex] = []
    for done, token in enumerate(tokens, start=1):
        path = folder / f"{token}.npz"
        if not overwrite and _FILE_NAME.fullmatch(token) and is_complete(path, token):
            report.skipped.append(token)
            outcome = "skipped"
        else:
            try:
                raw = _read(reader, token)
                if raw.source not in report.sources:
                    report.sources.append(raw.source)
                built = build_scenario(raw, index=_index_of(raw.map, indices))
            # A reader may fail in any way; the report names it, and the other scenarios go on.
            except Exception as error:
                known = isinstance(error, ScenarioError)
                report.failed[token] = str(error) if known else f"{type(error).__name__}: {error}"
                outcome = "failed"
            else:
                write_scenario(path, *built)
                report.written.append(token)
                outcome = "written"
        if progress is not None:
            progress(done, len(tokens), token, outcome)


def _read(reader: Reader, token: str) -> RawScenario:
    if not _FILE_NAME.fullmatch(token):
        raise ScenarioError(
            f"token {token!r} cannot name a file; use letters, digits and . _ + = @ -"
        )
    raw = reader.read(token)
    if raw.token != token:
        raise ScenarioError(f"scenario {token}: the reader returned scenario {raw.token} instead")
    return raw


def _index_of(raw_map: RawMap, indices: list[MapIndex]) -> MapIndex:
    """Returns the index of a map; keeps those used last, as scenarios of a few maps may mix."""
    index = next((index for index in indices if index.map is raw_map), None)
    if index is None:
        index = MapIndex(raw_map)
    else:
        indices.remove(index)
    indices.append(index)
    del indices[:-_MAX_INDICES]
    return index
