"""Folders that are filled part by part: a table per part, and data beside it.

Every file appears whole, by rename, and a part's table is the last of it: what is in a table is
done, whatever stopped the process before.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import polars

from spdm_experiments.inventory import Shard

Outcome = TypeVar("Outcome")


def part_name(prefix: str, kind: str, tokens: Sequence[str]) -> str:
    """Returns the name of a part; the same scenarios always give the same one."""
    digest = hashlib.sha256("\n".join(tokens).encode()).hexdigest()[:16]
    return f"part-{prefix}-{kind}-{digest}"


def clean_parts(tables: Path, data: Path, shard: Shard) -> None:
    """Removes what a killed process of this shard left half done.

    Args:
      tables: folder of the tables.
      data: folder of what lies beside them; files there without a table go.
      shard: whose parts.
    """
    mine = "part-*" if shard.count == 1 else f"part-{shard.name}-*"
    for folder in (tables, data):
        for path in folder.glob(f".{mine}.tmp"):
            path.unlink(missing_ok=True)
    for path in data.glob(mine):
        if not (tables / f"{path.stem}.parquet").exists():
            path.unlink(missing_ok=True)


def read_parts(
    tables: Path, read: Callable[[Path], Iterable[tuple[str, Outcome]]], trouble: str
) -> tuple[dict[str, Outcome], list[str]]:
    """Reads which scenarios are done.

    A part that cannot be used is renamed, so that its scenarios are done again.

    Args:
      tables: folder of the tables.
      read: gives token and outcome of the scenarios of a part; may raise ValueError or OSError.
      trouble: what a part that cannot be used is called.

    Returns:
      Token -> outcome, and what the user should know.

    Raises:
      ValueError: two parts hold the same scenario.
    """
    done: dict[str, Outcome] = {}
    origin: dict[str, str] = {}
    notes: list[str] = []
    for path in sorted(tables.glob("part-*.parquet")):
        try:
            scenarios = list(read(path))
        except (polars.exceptions.PolarsError, OSError, ValueError) as error:
            reason = " ".join(str(error).split())
            notes.append(f"{path}: {trouble} ({reason}); its scenarios are done again")
            with suppress(FileNotFoundError):  # another shard was first
                path.rename(path.with_suffix(".damaged"))
            continue
        for token, outcome in scenarios:
            if token in origin:
                raise ValueError(
                    f"{tables}: {origin[token]} and {path.name} both hold scenario {token!r}; "
                    "delete one of them"
                )
            origin[token] = path.name
            done[token] = outcome
    return done, notes
