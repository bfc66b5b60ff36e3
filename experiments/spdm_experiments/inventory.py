"""Looks through scenario files without reading them: tokens, sizes, groups of one shape.

A scenario file takes some 25 ms to read and check; its table of contents, the headers of one array
per axis and the route take a tenth of that. What is read here is checked later, when the scenario
is loaded.
"""

import dataclasses
import functools
import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from spdm_jax import Failure
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PATH_ROOM, PaddingConfig
from spdm_jax.schema import LEAVES

METADATA = "metadata.json"
"""Member that says in words what the file holds."""
_COUNT = "map.lanes.centerline.count"
_SEQUENCES = ("route.centerline_lanes", "route.goal_lanes", "route.branch_lanes")
_AXES = tuple(field.name for field in dataclasses.fields(PaddingConfig))
_LEAF_OF = {axis: next(p for p, leaf in LEAVES.items() if axis in leaf.axes) for axis in _AXES}
"""A leaf that has the axis."""
_HEADER = 256
"""Bytes that hold the header of any array of a scenario file."""
_LOCAL_HEADER = struct.Struct("<26xHH")
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, ValueError, KeyError, TypeError, EOFError)
"""What damaged files raise."""


@dataclass(frozen=True)
class Entry:
    """One scenario file.

    Attributes:
      path: the file.
      token, log_name, map_name, scenario_type, source: as in `ScenarioInfo`.
      sizes: length of every free axis.
      route_points: points of the longest lane sequence that a plan may follow.
    """

    path: Path
    token: str
    log_name: str
    map_name: str
    scenario_type: str
    source: str
    sizes: Mapping[str, int]
    route_points: int


@dataclass(frozen=True)
class Inventory:
    """All scenario files of a run.

    Attributes:
      entries: files that can be used, in the order of their names.
      failures: files that cannot, and why.
      digest: of names and contents of all of them.
    """

    entries: list[Entry]
    failures: list[Failure]
    digest: str

    def __len__(self) -> int:
        return len(self.entries) + len(self.failures)


def take_inventory(files: Sequence[Path], allowed: PaddingConfig | None = None) -> Inventory:
    """Looks through scenario files.

    Args:
      files: scenario files.
      allowed: bucket sizes; the defaults if None.

    Raises:
      ScenarioError: two files hold the same scenario.
    """
    entries: dict[str, Entry] = {}
    failures: dict[str, Failure] = {}
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + b"\0")
        try:
            entry, content = _look(path)
            _check_sizes(entry, allowed or PaddingConfig())
        except (ScenarioError, OSError) as error:
            failures[path.stem] = Failure(path.stem, str(error))
            content = _raw_digest(path)
        else:
            if entry.token in entries:
                other = entries[entry.token].path
                raise ScenarioError(f"{path}: holds scenario {entry.token!r}, and so does {other}")
            entries[entry.token] = entry
        digest.update(content)
    for token in failures.keys() & entries.keys():
        raise ScenarioError(f"{entries[token].path}: holds scenario {token!r}, the name of a file")
    return Inventory(list(entries.values()), list(failures.values()), digest.hexdigest())


def _look(path: Path) -> tuple[Entry, bytes]:
    """Returns what is known of a file and a digest of its contents."""
    try:
        with open(path, "rb") as file:
            members = members_of(file)
            info = json.loads(unpack(file, members[METADATA]))["info"]
            sizes: dict[str, int] = {}
            for axis in _AXES:
                leaf = _LEAF_OF[axis]
                shape = array_header(unpack(file, members[f"{leaf}.npy"], _HEADER))[0]
                sizes |= {a: n for a, n in zip(LEAVES[leaf].axes, shape, strict=True) if a in _AXES}
            count, *sequences = (
                np.load(io.BytesIO(unpack(file, members[f"{name}.npy"])), allow_pickle=False)
                for name in (_COUNT, *_SEQUENCES)
            )
        count = np.append(count, 0)  # the appended entry serves -1
        points = max((int(count[s].sum(axis=1).max()) for s in sequences if len(s)), default=0)
        entry = Entry(
            path=path,
            token=str(info["token"]),
            log_name=str(info["log_name"]),
            map_name=str(info["map_name"]),
            scenario_type=str(info["scenario_type"]),
            source=str(info["source"]),
            sizes=sizes,
            route_points=points,
        )
    except (*DAMAGE, IndexError) as error:
        raise ScenarioError(
            f"{path}: damaged scenario file ({error}); pack this scenario again"
        ) from error
    # Names, sizes and check sums of the members stand for their contents.
    contents = [(m.filename, m.file_size, m.CRC) for m in members.values()]
    return entry, hashlib.sha256(repr(contents).encode()).digest()


def members_of(file: BinaryIO) -> dict[str, zipfile.ZipInfo]:
    """Returns the table of contents of a scenario file."""
    with zipfile.ZipFile(file) as archive:
        return {member.filename: member for member in archive.infolist()}


def unpack(file: BinaryIO, member: zipfile.ZipInfo, limit: int | None = None) -> bytes:
    """Returns a member's content, or its first bytes; `zipfile` takes longer for small ones."""
    file.seek(member.header_offset)
    name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
    file.seek(name + extra, io.SEEK_CUR)
    size = member.compress_size if limit is None else min(member.compress_size, 4 * limit)
    content = file.read(size)
    if member.compress_type == zipfile.ZIP_DEFLATED:
        content = zlib.decompressobj(-zlib.MAX_WBITS).decompress(content, limit or 0)
    return content


def array_header(content: bytes) -> tuple[tuple[int, ...], np.dtype, int]:
    """Reads the header of a stored array.

    Args:
      content: its first bytes.

    Returns:
      Shape, type, and where the values begin.

    Raises:
      ValueError: that is no array, or one in Fortran order.
    """
    # magic string, version, length of the text that follows
    size = 10 + int.from_bytes(content[8:10], "little")
    return _parse_header(content[:size])


@functools.lru_cache(maxsize=4096)
def _parse_header(header: bytes) -> tuple[tuple[int, ...], np.dtype, int]:
    file = io.BytesIO(header)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("array header of another version")
    shape, fortran, kind = np.lib.format.read_array_header_1_0(file)
    if fortran:
        raise ValueError("array in Fortran order")
    return shape, kind, file.tell()


def _check_sizes(entry: Entry, allowed: PaddingConfig) -> None:
    for axis in _AXES:
        largest = max(getattr(allowed, axis))
        if entry.sizes[axis] > largest:
            raise ScenarioError(
                f"{entry.sizes[axis]} {axis}, the library's largest bucket is {largest}. Use the "
                f"Python API with a larger PaddingConfig.{axis}; nothing was truncated."
            )
    if entry.route_points > max(PATH_ROOM):
        raise ScenarioError(
            f"{entry.route_points} points on the longest lane sequence of the route, there is room "
            f"for {max(PATH_ROOM)}. Pack with a shorter route; nothing was truncated."
        )


def _raw_digest(path: Path) -> bytes:
    try:
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError as error:
        return repr(error.errno).encode()


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count` of the scenarios, by their tokens alone.

    Attributes:
      index: 1 ... count.
      count: parts.
    """

    index: int
    count: int

    @staticmethod
    def parse(text: str) -> "Shard":
        """Reads I/N.

        Raises:
          ValueError: that is not I/N with 1 <= I <= N.
        """
        index, _, count = text.partition("/")
        if index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
            return Shard(int(index), int(count))
        raise ValueError(f"--shard is {text!r}; write I/N with I from 1 to N, such as 3/16")

    def holds(self, token: str) -> bool:
        """Says whether a scenario belongs to this part."""
        number = int.from_bytes(hashlib.sha256(token.encode()).digest()[:8], "big")
        return number % self.count == self.index - 1

    @property
    def name(self) -> str:
        """For file names."""
        return "all" if self.count == 1 else f"{self.index}of{self.count}"


def split(count: int, size: int) -> list[range]:
    """Splits `count` items into runs of `size`, the last one shorter where they do not come out."""
    return [range(i, min(i + size, count)) for i in range(0, count, size)]
