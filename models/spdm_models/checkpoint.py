"""Files of weights: torch's `.pth` (read without torch), `.npz` and `.safetensors`."""

import io
import json
import pickle
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load_file, save_file

# Torch's storage classes and the element type of their bytes.
STORAGES = {
    "DoubleStorage": np.dtype(np.float64),
    "FloatStorage": np.dtype(np.float32),
    "HalfStorage": np.dtype(np.float16),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
    "LongStorage": np.dtype(np.int64),
    "IntStorage": np.dtype(np.int32),
    "ShortStorage": np.dtype(np.int16),
    "CharStorage": np.dtype(np.int8),
    "ByteStorage": np.dtype(np.uint8),
    "BoolStorage": np.dtype(np.bool_),
}
METADATA_KEY = "spdm"


def read_checkpoint(path: Path, prefix: str = "") -> dict[str, np.ndarray]:
    """Reads all arrays of a file of weights.

    Args:
      path: `.pth`, `.pt` or `.ckpt` of torch 1.6 or newer, `.npz` or `.safetensors`.
      prefix: keep only what is below it (`model` of `{"model": ..., "epoch": 3}`).

    Returns:
      Arrays by name; nested dicts are joined by dots, 16-bit floats become float32.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file is no such checkpoint, or holds something else than arrays.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    read = _READERS.get(path.suffix)
    if read is None:
        known = ", ".join(_READERS)
        raise ValueError(f"{path}: ending {path.suffix!r} is not one of {known}; rename the file")
    try:
        found = _flat(read(path))
    except RecursionError:
        raise ValueError(f"{path}: its dicts contain themselves; no plain weights") from None
    if prefix:
        below = f"{prefix}."
        kept = {k.removeprefix(below): v for k, v in found.items() if k.startswith(below)}
        if not kept:
            parts = sorted({name.split(".")[0] for name in found})
            raise ValueError(f"{path}: nothing below {prefix!r}; it holds {', '.join(parts)}")
        found = kept
    for name, value in found.items():
        if not isinstance(value, np.ndarray):
            raise ValueError(
                f"{path}: {name} is {_described(value)}, no array; name the part that holds the "
                "weights by its prefix"
            )
    return {name: _widened(value) for name, value in found.items()}


def read_metadata(path: Path) -> dict[str, Any]:
    """Returns what `write_checkpoint` was given beside the arrays; empty for other files.

    Raises:
      ValueError: the file has no readable header.
    """
    if path.suffix != ".safetensors":
        return {}
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        # A file of another kind may ask for any amount of memory here.
        text = file.read(min(size, path.stat().st_size))
    try:
        return json.loads(json.loads(text).get("__metadata__", {}).get(METADATA_KEY, "{}"))
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path}: damaged, or no .safetensors file ({error})") from None


def write_checkpoint(
    path: Path, state: Mapping[str, np.ndarray], metadata: Mapping[str, Any] | None = None
) -> None:
    """Writes arrays as `.safetensors`, whole or not at all.

    Args:
      path: the file; an existing one is replaced.
      state: arrays by name.
      metadata: anything JSON can hold, kept in the file's header.

    Raises:
      ValueError: the name has another ending.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: weights are written as .safetensors; give the file that ending")
    part = path.with_name(f".{path.name}.part")
    arrays = {name: np.asarray(value, order="C") for name, value in state.items()}
    save_file(arrays, part, {METADATA_KEY: json.dumps(dict(metadata or {}))})
    part.replace(path)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        # NumPy leaves a file that it opened itself open when it is damaged.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return dict(data)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no readable .npz ({error})") from error


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    try:
        return load_file(path)
    except Exception as error:  # the package has one class for all its errors, not a ValueError
        raise ValueError(f"{path}: no readable .safetensors ({error})") from error


def _read_torch(path: Path) -> Any:
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path}: not the zip format of torch 1.6 and newer; load it with torch and save it "
            "again, or save it as .safetensors"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            inner = [name for name in archive.namelist() if name.endswith("/data.pkl")]
            if len(inner) != 1:
                raise pickle.UnpicklingError(f"{len(inner)} files data.pkl inside, expected one")
            return _TorchUnpickler(archive, inner[0].removesuffix("data.pkl")).load()
    except _PICKLE_ERRORS as error:
        raise ValueError(f"{path}: no readable torch checkpoint ({error})") from error


# What damaged or hostile bytes make the standard library raise.
_PICKLE_ERRORS = (
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    zlib.error,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
)

_READERS: dict[str, Callable[[Path], Any]] = {
    ".pth": _read_torch,
    ".pt": _read_torch,
    ".ckpt": _read_torch,
    ".npz": _read_npz,
    ".safetensors": _read_safetensors,
}


class _TorchUnpickler(pickle.Unpickler):
    """Knows tensors, their storages, dicts and plain values; every other name is refused.

    The names of a pickle resolve to the functions below, never to the modules they mention, so
    that nothing of the file is run.
    """

    def __init__(self, archive: zipfile.ZipFile, folder: str):
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder
        self._storages: dict[str, np.ndarray] = {}
        order = f"{folder}byteorder"
        self._swapped = order in archive.namelist() and archive.read(order).strip() == b"big"
        # A pickle may set attributes of what it is given: these functions are this reader's own.
        self._known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch", "Size"): tuple,
            ("torch._utils", "_rebuild_tensor_v2"): lambda *given: _tensor(*given),
            ("torch._utils", "_rebuild_parameter"): lambda data, *_: data,
            **{("torch", name): name for name in STORAGES},
        }

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """Resolves the few names that tensors need."""
        try:
            return self._known[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(
                f"it names {module_name}.{global_name}, which is no part of plain weights; save "
                "the state dict alone"
            ) from None

    def persistent_load(self, pid: Any, /) -> np.ndarray:
        """Returns the elements of a storage."""
        kind, storage, key, _, count = pid
        if kind != "storage" or storage not in STORAGES:
            raise pickle.UnpicklingError(f"unknown persistent object {kind!r}")
        if key not in self._storages:
            stored = self._archive.read(f"{self._folder}data/{key}")
            elements = np.frombuffer(stored, STORAGES[storage])
            if len(elements) < count:
                raise pickle.UnpicklingError(f"storage {key} is cut short")
            self._storages[key] = elements.byteswap() if self._swapped else elements
        return self._storages[key]


def _tensor(
    storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> np.ndarray:
    """Returns a view of a storage; stands in for torch's `_rebuild_tensor_v2`."""
    if 0 in size:
        return np.zeros(size, storage.dtype)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if offset < 0 or min(stride, default=0) < 0 or last >= len(storage):
        raise pickle.UnpicklingError(f"a tensor of shape {size} reaches beyond its storage")
    steps = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps, writeable=False)


def _flat(found: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(found, Mapping):
        return {prefix.removesuffix("."): found}
    flat: dict[str, Any] = {}
    for key, value in found.items():
        flat |= _flat(value, f"{prefix}{key}.")
    return flat


def _described(value: Any) -> str:
    return f"a {type(value).__name__}" if isinstance(value, list | tuple) else repr(value)


def _widened(value: np.ndarray) -> np.ndarray:
    narrow = value.dtype in (np.dtype(np.float16), np.dtype(jnp.bfloat16))
    return value.astype(np.float32) if narrow else value
