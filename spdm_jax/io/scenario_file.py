"""Scenario files: one `.npz` per scenario, checked field by field when read.

A file is a zip archive of `.npy` members named by field path (`map.lanes.centerline.points.npy`)
and one JSON member, `metadata.json`, with schema version, library version and `ScenarioInfo`.
Nothing is pickled. The same scenario gives the same bytes.
"""

import dataclasses
import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from spdm_jax import __version__
from spdm_jax.io.archive import DAMAGE, METADATA, stored_array
from spdm_jax.io.raw import ScenarioError
from spdm_jax.schema import LEAVES, check_leaves, from_leaves, leaves_of
from spdm_jax.types import SCHEMA_VERSION, Scenario, ScenarioInfo

_ARRAY = ".npy"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # zip's earliest time stamp
_COMPRESSION_LEVEL = 1  # the grid shrinks to a twentieth, higher levels gain little and are slow
_ROW_IDS = {
    "lane_ids": "lanes",
    "roadblock_ids": "roadblocks",
    "intersection_ids": "intersections",
    "track_ids": "tracks",
}
"""Fields of `ScenarioInfo` with one entry per row of an axis."""


def write_scenario(path: str | os.PathLike[str], scenario: Scenario, info: ScenarioInfo) -> None:
    """Writes a scenario file; a reader sees the old file or the whole new one.

    Args:
      path: destination, in an existing folder.
      scenario: one scenario on the host, not padded.
      info: its description.

    Raises:
      ScenarioError: a leaf has a type or shape that the file layout does not know.
      OSError: the file cannot be written.
    """
    path = Path(path)
    leaves = {name: np.asarray(leaf) for name, leaf in leaves_of(scenario).items()}
    _check(path, leaves, info)
    write_atomically(path, _encode(leaves, info))


def read_scenario(path: str | os.PathLike[str]) -> tuple[Scenario, ScenarioInfo]:
    """Reads a scenario file.

    Returns:
      Scenario with NumPy leaves (read-only), bit for bit as written, and its description.

    Raises:
      ScenarioError: the file is damaged or of another layout; names file, field and value.
      OSError: the file cannot be opened.
    """
    path = Path(path)
    try:
        # Whole: a hundred small members are read faster from memory.
        file = io.BytesIO(path.read_bytes())
        with zipfile.ZipFile(file) as archive:
            info = _read_info(path, archive)
            members = {name: archive.getinfo(name + _ARRAY) for name in LEAVES}
        leaves = {name: _read_array(path, file, name, m) for name, m in members.items()}
    except DAMAGE as error:
        raise ScenarioError(
            f"{path}: damaged scenario file ({error}); pack this scenario again"
        ) from error
    _check(path, leaves, info)
    return from_leaves(leaves), info


def is_complete(path: str | os.PathLike[str], token: str) -> bool:
    """Says whether a file holds this scenario, whole and in today's layout; reads no arrays."""
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read_info(path, archive).token == token
    except (OSError, ScenarioError, *DAMAGE):
        return False


def write_atomically(path: Path, content: bytes) -> None:
    """Replaces a file by new content at once, also when the process or machine stops meanwhile."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _encode(leaves: Mapping[str, np.ndarray], info: ScenarioInfo) -> bytes:
    metadata = {
        "schema_version": SCHEMA_VERSION,
        "library_version": __version__,
        "info": dataclasses.asdict(info),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        _add(archive, METADATA, json.dumps(metadata, sort_keys=True, indent=1).encode())
        for name, leaf in leaves.items():
            array = io.BytesIO()
            np.lib.format.write_array(array, np.require(leaf, requirements="C"), allow_pickle=False)
            _add(archive, name + _ARRAY, array.getvalue())
    return buffer.getvalue()


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    # An entry made by hand carries no clock time and no rights of the writing process.
    entry = zipfile.ZipInfo(name, _EPOCH)
    entry.create_system = 3
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, content, zipfile.ZIP_DEFLATED, _COMPRESSION_LEVEL)


def _read_info(path: Path, archive: zipfile.ZipFile) -> ScenarioInfo:
    """Reads the metadata after a check of the version and of the list of members."""
    members = archive.namelist()
    if METADATA not in members:
        raise ScenarioError(f"{path}: no {METADATA}; this is not a scenario file")
    try:
        metadata = json.loads(archive.read(METADATA))
        version = metadata["schema_version"]
        entries = metadata["info"]
    except (ValueError, KeyError, TypeError) as error:
        raise ScenarioError(f"{path}: {METADATA} is not readable ({error!r})") from error
    if version != SCHEMA_VERSION:
        raise ScenarioError(
            f"{path}: schema_version is {version!r}, this library reads {SCHEMA_VERSION}; pack the "
            "scenarios again"
        )
    expected = {METADATA, *(name + _ARRAY for name in LEAVES)}
    if set(members) != expected or len(members) != len(expected):
        missing = sorted(expected - set(members))
        extra = sorted(set(members) - expected)
        raise ScenarioError(f"{path}: missing fields {missing}, unexpected fields {extra}")
    return _parse_info(path, entries)


def _parse_info(path: Path, entries: Any) -> ScenarioInfo:
    fields = dataclasses.fields(ScenarioInfo)
    if not isinstance(entries, dict) or set(entries) != {field.name for field in fields}:
        names = sorted(entries) if isinstance(entries, dict) else entries
        raise ScenarioError(f"{path}: info has fields {names}, not those of ScenarioInfo")
    values: dict[str, Any] = {}
    for field in fields:
        value = entries[field.name]
        if field.type in (str, int):
            good = type(value) is field.type
        else:
            good = isinstance(value, list) and all(isinstance(item, str) for item in value)
            value = tuple(value) if good else value
        if not good:
            raise ScenarioError(f"{path}: info.{field.name} is {value!r}, not {field.type}")
        values[field.name] = value
    return ScenarioInfo(**values)


def _read_array(path: Path, file: BinaryIO, name: str, member: zipfile.ZipInfo) -> np.ndarray:
    try:
        return stored_array(file, member)
    except ValueError as error:
        raise ScenarioError(f"{path}: field {name} is not a plain array ({error})") from error


def _check(path: Path, leaves: Mapping[str, np.ndarray], info: ScenarioInfo) -> None:
    try:
        sizes = check_leaves(leaves)
    except ValueError as error:
        raise ScenarioError(f"{path}: field {error}") from error
    for field, axis in _ROW_IDS.items():
        number = len(getattr(info, field))
        if number != sizes[axis]:
            raise ScenarioError(
                f"{path}: info.{field} has {number} entries for {sizes[axis]} {axis}"
            )
