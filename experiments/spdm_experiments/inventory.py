"""Looks through scenario files without reading them: tokens, sizes, groups of one shape.

A scenario file takes some 25 ms to read and check; its table of contents, the headers of one array
per axis and the route take a tenth of that. What is read here is checked later, when the scenario
is loaded.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spdm_jax import Failure
from spdm_jax.io.archive import (
    DAMAGE,
    METADATA,
    array_header,
    members_of,
    stored_array,
    unpack,
)
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import AXES, PATH_ROOM, PaddingConfig
from spdm_jax.schema import LEAVES

_COUNT = "map.lanes.centerline.count"
_ITERATIONS = "num_iterations"
_SEQUENCES = ("route.centerline_lanes", "route.goal_lanes", "route.branch_lanes")
_LEAF_OF = {axis: next(p for p, leaf in LEAVES.items() if axis in leaf.axes) for axis in AXES}
"""A leaf that has the axis."""
_HEADER = 256
"""Bytes that hold the header of any array of a scenario file."""
UNREADABLE = (*DAMAGE, ValueError, LookupError, TypeError)
"""What files raise that are damaged or no scenario files."""


@dataclass(frozen=True)
class Entry:
    """One scenario file.

    Attributes:
      path: the file.
      token, log_name, map_name, scenario_type, source: as in `ScenarioInfo`.
      sizes: length of every free axis.
      route_points: points of the longest lane sequence that a plan may follow.
      lane_points: points of the longest lane.
      num_iterations: length of the scenario's own window.
    """

    path: Path
    token: str
    log_name: str
    map_name: str
    scenario_type: str
    source: str
    sizes: Mapping[str, int]
    route_points: int
    lane_points: int
    num_iterations: int


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
            for axis in AXES:
                leaf = _LEAF_OF[axis]
                shape = array_header(unpack(file, members[f"{leaf}.npy"], _HEADER))[0]
                sizes |= {a: n for a, n in zip(LEAVES[leaf].axes, shape, strict=True) if a in AXES}
            count, iterations, *sequences = (
                stored_array(file, members[f"{name}.npy"])
                for name in (_COUNT, _ITERATIONS, *_SEQUENCES)
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
            lane_points=int(count.max()),
            num_iterations=int(iterations),
        )
    except UNREADABLE as error:
        raise ScenarioError(
            f"{path}: damaged scenario file ({error}); pack this scenario again"
        ) from error
    # Names, sizes and check sums of the members stand for their contents.
    contents = [(m.filename, m.file_size, m.CRC) for m in members.values()]
    return entry, hashlib.sha256(repr(contents).encode()).digest()


def _check_sizes(entry: Entry, allowed: PaddingConfig) -> None:
    for axis in AXES:
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
