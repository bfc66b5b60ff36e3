"""The folder that `spdm label` fills; `spdm_jax.labels` says what is in it and reads it."""

import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars

from spdm_experiments.description import describe
from spdm_experiments.inventory import Shard
from spdm_experiments.parts import clean_parts, read_parts
from spdm_jax.io.scenario_file import write_atomically
from spdm_jax.labels import DESCRIPTION, INDEX, SHARDS, VOCABULARY

FORMAT = 1
COMPARED = (
    "format",
    "command",
    "vocabulary",
    "components",
    "dtype",
    "precision",
    "config",
    "num_scenarios",
    "input_hash",
    "versions",
)
"""Entries of label.json that must be the same for a run to go on."""
NOTED = ("commit", "device")
"""Entries whose change is only mentioned."""
SCHEMA = {
    "token": polars.String,
    "log_name": polars.String,
    "map_name": polars.String,
    "scenario_type": polars.String,
    "shard": polars.String,
    "row": polars.Int32,
    "status": polars.String,
    "reason": polars.String,
}
"""Columns of the index; shard and row are null where a scene has no labels."""


def digest(vocabulary: np.ndarray) -> str:
    """Returns a hash of trajectories as they are scored."""
    content = np.ascontiguousarray(vocabulary, "<f8")
    return hashlib.sha256(repr(content.shape).encode() + content.tobytes()).hexdigest()


def open_folder(folder: Path, about: Mapping[str, Any], vocabulary: np.ndarray) -> list[str]:
    """Describes a new folder, or checks that it holds labels of the same kind.

    Args:
      folder: made if absent.
      about: label.json.
      vocabulary: `[V, 41, 3]` as it is scored.

    Returns:
      What is different without consequence, in words.

    Raises:
      ValueError: the folder holds other labels; names entry and both values.
    """
    path = folder / DESCRIPTION
    if not path.exists() and any((folder / INDEX).glob("part-*.parquet")):
        raise ValueError(
            f"{folder}: has labels but no {DESCRIPTION} that says of what; use another --out"
        )
    folder.mkdir(parents=True, exist_ok=True)
    notes = describe(path, about, COMPARED, NOTED)
    for name in (SHARDS, INDEX):
        (folder / name).mkdir(exist_ok=True)
    if not (folder / VOCABULARY).exists():
        write_atomically(folder / VOCABULARY, _npy(vocabulary))
    return notes


def clean(folder: Path, shard: Shard) -> None:
    """Removes what a killed process of this shard left half done."""
    clean_parts(folder / INDEX, folder / SHARDS, shard)


def read_done(
    folder: Path, shape: tuple[int, int], dtype: np.dtype
) -> tuple[dict[str, str], list[str]]:
    """Reads which scenes are done; see `parts.read_parts`.

    Args:
      folder: of the labels.
      shape: trajectories and components of a scene.
      dtype: of the labels.

    Returns:
      Token -> reason ("" where the scene has labels), and what was found damaged, in words.
    """

    def read(path: Path) -> Iterator[tuple[str, str]]:
        part = polars.read_parquet(path).select(polars.col(list(SCHEMA)))
        rows = part.filter(polars.col("status") == "ok")["row"].to_list()
        _check_shard(folder / SHARDS / f"{path.stem}.npy", rows, shape, dtype)
        for token, status, reason in part.select("token", "status", "reason").iter_rows():
            yield token, "" if status == "ok" else reason

    return read_parts(folder / INDEX, read, "not usable")


def _check_shard(path: Path, rows: list[int], shape: tuple[int, int], dtype: np.dtype) -> None:
    if not rows:
        return
    found = np.load(path, mmap_mode="r")
    if found.shape != (len(rows), *shape) or found.dtype != dtype or rows != [*range(len(rows))]:
        raise ValueError(f"{path.name} holds {found.dtype} {found.shape} for {len(rows)} scenes")


def write_part(
    folder: Path, name: str, labels: np.ndarray, rows: Sequence[Mapping[str, Any]]
) -> None:
    """Writes finished scenes, their index last.

    Args:
      folder: of the labels.
      name: of the part, without ending.
      labels: `[n, V, C]` of the rows that are "ok", in their order.
      rows: of the index, all columns but shard and row.
    """
    shard = f"{name}.npy"
    if len(labels):
        write_atomically(folder / SHARDS / shard, _npy(labels))
    place, index = 0, []
    for row in rows:
        ok = row["status"] == "ok"
        index.append({**row, "shard": shard if ok else None, "row": place if ok else None})
        place += ok
    buffer = io.BytesIO()
    polars.DataFrame(index, SCHEMA).write_parquet(buffer)
    write_atomically(folder / INDEX / f"{name}.parquet", buffer.getvalue())


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()
