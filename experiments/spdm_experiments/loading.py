"""Reads a chunk of scenario files for a program that needs only part of them.

Loading is what bounds a fast program: a scenario that is planned in 10 ms takes longer to unpack,
check and pad. Layers that the program does not read are neither unpacked nor padded; the others
are checked (type, shape, check sum) as `read_scenario` does.
"""

import io
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spdm_experiments.inventory import DAMAGE, METADATA, Entry, array_header, members_of, unpack
from spdm_jax import Failure
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PaddingConfig, pad_scenario
from spdm_jax.schema import LEAVES, from_leaves, leaves_of
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
    """

    batch: ScenarioBatch | None
    entries: list[Entry]
    track_ids: list[tuple[str, ...]]
    origins: np.ndarray
    failures: list[tuple[Failure, Entry]]


def load_scenes(
    entries: Sequence[Entry],
    padding: PaddingConfig,
    *,
    unread: Sequence[str] = (),
    dtype: np.dtype | type = np.float64,
) -> LoadedScenes:
    """Reads and pads scenario files; one that cannot be used is a failure, not an error.

    Args:
      entries: files, which must be as they were at the inventory.
      padding: one size per axis.
      unread: prefixes of field paths that nobody will read; they become zeros.
      dtype: of floating leaves.
    """
    skipped = [path for path in LEAVES if path.startswith(tuple(unread))] if unread else []
    needed = [path for path in LEAVES if path not in skipped]
    used_axes = {axis for path in needed for axis in LEAVES[path].axes}
    full = {axis: sizes[0] for axis, sizes in vars(padding).items()}
    # Axes that only unread layers have are not worth padding.
    sizes = {axis: size if axis in used_axes else 0 for axis, size in full.items()}
    loaded = LoadedScenes(None, [], [], np.zeros((0, 2)), [])
    padded: list[dict[str, np.ndarray]] = []
    origins = []
    for entry in entries:
        try:
            leaves, track_ids = _read(entry, needed)
            present = {axis: n if axis in used_axes else 0 for axis, n in entry.sizes.items()}
            present["grid_words"] = leaves["map.grid.masks"].shape[1]
            for path in skipped:
                shape = [n if isinstance(n, int) else present[n] for n in LEAVES[path].axes]
                leaves[path] = np.zeros(shape, LEAVES[path].dtype)
            scenario = pad_scenario(from_leaves(leaves), sizes)
        except (ValueError, OSError) as error:
            loaded.failures.append((Failure(entry.token, str(error)), entry))
            continue
        padded.append(leaves_of(scenario))
        origins.append(leaves["origin"])
        loaded.entries.append(entry)
        loaded.track_ids.append(track_ids)
    if padded:
        loaded.batch = from_leaves(_stack(padded, needed, full, np.dtype(dtype)))
        loaded.origins = np.stack(origins)
    return loaded


def _stack(
    padded: Sequence[Mapping[str, np.ndarray]],
    needed: Sequence[str],
    full: Mapping[str, int],
    dtype: np.dtype,
) -> dict[str, np.ndarray]:
    stacked: dict[str, np.ndarray] = {}
    for path, leaf in LEAVES.items():
        kind = np.dtype(leaf.dtype)
        kind = dtype if np.issubdtype(kind, np.floating) else kind
        if path in needed:
            parts = [leaves[path] for leaves in padded]
            stacked[path] = np.stack(parts, dtype=kind, casting="same_kind")
        else:
            shape = (n if isinstance(n, int) else full[n] for n in leaf.axes)
            stacked[path] = np.broadcast_to(np.zeros((), kind), (len(padded), *shape))
    return stacked


def _read(entry: Entry, needed: Sequence[str]) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Returns the needed leaves and the source ids of the tracks.

    Raises:
      ScenarioError: the file is damaged, or not what it was.
    """
    path = entry.path
    try:
        content = path.read_bytes()
        members = members_of(io.BytesIO(content))
        file = io.BytesIO(content)
        info = json.loads(unpack(file, members[METADATA]))["info"]
        leaves: dict[str, np.ndarray] = {}
        for name in needed:
            member = members[f"{name}.npy"]
            raw = unpack(file, member)
            if zlib.crc32(raw) != member.CRC:
                raise ScenarioError(
                    f"{path}: field {name}: wrong check sum; pack this scenario again"
                )
            shape, kind, begin = array_header(raw[:256])
            leaves[name] = np.frombuffer(raw, kind, offset=begin).reshape(shape)
            if kind != np.dtype(LEAVES[name].dtype) or not _fits(shape, name, entry):
                raise ScenarioError(f"{path}: field {name}: changed while it was in use")
    except DAMAGE as error:
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
