"""Reads a chunk of scenario files for a program that needs only part of them.

Loading is what bounds a fast program: a scenario that is planned in 10 ms takes longer to unpack,
check and pad. Layers that the program does not read are neither unpacked nor padded; the others
are checked (type, shape, check sum) as `read_scenario` does.
"""

import io
import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spdm_experiments.inventory import UNREADABLE, Entry
from spdm_jax import Failure
from spdm_jax.io.archive import METADATA, members_of, stored_array, unpack
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PaddedStack, PaddingConfig
from spdm_jax.schema import KINDS, LEAVES, from_leaves
from spdm_jax.types import ScenarioBatch


@dataclass
class LoadedScenes:
    """Scenarios in memory.

    Attributes:
      batch: padded, NumPy leaves `[B, ...]`, or None where no file could be read.
      entries: `[B]` files.
      track_ids: `[B]` source ids of their tracks.
      origins: `[B, 2]` of their local frames.
      failures: the other files, and why.
      release: gives the memory of `batch` back to the loader, once nobody reads it any more.
    """

    batch: ScenarioBatch | None
    entries: list[Entry]
    track_ids: list[tuple[str, ...]]
    origins: np.ndarray
    failures: list[tuple[Failure, Entry]]
    release: Callable[[], None] = lambda: None


class Loader:
    """Reads and pads scenario files into memory that is used again; several threads may load.

    Fresh memory is expensive: a chunk would take as long to get it from the system as to fill it.

    Args:
      unread: prefixes of field paths that nobody will read; they become zeros.
      dtype: of floating leaves.
    """

    def __init__(self, *, unread: Sequence[str] = (), dtype: type[np.floating] = np.float64):
        self._needed = [path for path in LEAVES if not path.startswith(tuple(unread))]
        self._dtype = dtype
        self._lock = threading.Lock()
        self._spare: dict[PaddingConfig, list[tuple[int, PaddedStack]]] = {}

    def load(self, entries: Sequence[Entry], padding: PaddingConfig) -> LoadedScenes:
        """Reads files; one that cannot be used is a failure, not an error.

        Args:
          entries: files, which must be as they were at the inventory.
          padding: one size per axis.
        """
        sizes = {axis: rooms[0] for axis, rooms in vars(padding).items()}
        room, stack = self._stack(len(entries), padding, sizes)
        loaded = LoadedScenes(None, [], [], np.zeros((0, 2)), [])
        origins: list[np.ndarray] = []
        for entry in entries:
            try:
                leaves, track_ids = _read(entry, self._needed)
                stack.add(leaves, entry.sizes)
            except (ValueError, OSError) as error:
                loaded.failures.append((Failure(entry.token, str(error)), entry))
                continue
            origins.append(leaves["origin"])
            loaded.entries.append(entry)
            loaded.track_ids.append(track_ids)
        loaded.release = lambda: self._spare.get(padding, []).append((room, stack))
        if origins:
            stacked = stack.leaves()
            for path in LEAVES.keys() - stacked.keys():
                shape = (n if isinstance(n, int) else sizes[n] for n in LEAVES[path].axes)
                stacked[path] = np.broadcast_to(np.zeros((), KINDS[path]), (len(origins), *shape))
            loaded.batch = from_leaves(stacked)
            loaded.origins = np.stack(origins)
        return loaded

    def _stack(
        self, count: int, padding: PaddingConfig, sizes: dict[str, int]
    ) -> tuple[int, PaddedStack]:
        with self._lock:
            if padding not in self._spare:
                self._spare = {padding: []}  # one shape after the other
            spare = self._spare[padding]
            room, stack = spare.pop() if spare else (0, None)
        if stack is not None and room >= count:
            stack.clear()
            return room, stack
        return count, PaddedStack(count, sizes, paths=self._needed, dtype=self._dtype)


def _read(entry: Entry, needed: Sequence[str]) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Returns the needed leaves and the source ids of the tracks.

    Raises:
      ScenarioError: the file is damaged, or not what it was.
    """
    path = entry.path
    try:
        file = io.BytesIO(path.read_bytes())
        members = members_of(file)
        info = json.loads(unpack(file, members[METADATA]))["info"]
        leaves: dict[str, np.ndarray] = {}
        for name in needed:
            leaf = leaves[name] = stored_array(file, members[f"{name}.npy"])
            if leaf.dtype != KINDS[name] or not _fits(leaf.shape, name, entry):
                raise ScenarioError(f"{path}: field {name}: changed while it was in use")
    except UNREADABLE as error:
        if isinstance(error, ScenarioError):
            raise
        raise ScenarioError(
            f"{path}: damaged scenario file ({error}); pack this scenario again"
        ) from error
    if info["token"] != entry.token or len(info["track_ids"]) != entry.sizes["tracks"]:
        raise ScenarioError(f"{path}: changed while it was in use")
    return leaves, tuple(info["track_ids"])


def _fits(shape: tuple[int, ...], name: str, entry: Entry) -> bool:
    axes = LEAVES[name].axes
    expected = (n if isinstance(n, int) else entry.sizes.get(n) for n in axes)
    return len(shape) == len(axes) and all(
        want is None or want == size for want, size in zip(expected, shape, strict=True)
    )
