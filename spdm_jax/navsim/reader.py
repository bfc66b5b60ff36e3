"""Reads frames that `navsim_export.py` has written (host)."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spdm_jax.io.archive import DAMAGE, METADATA
from spdm_jax.io.raw import ScenarioError
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.frames import FIRST, SECOND, NavsimInfo, NavsimSet
from spdm_jax.navsim.navsim_export import FORMAT, VERSION
from spdm_jax.navsim.timing import MAX_PLAN_AGE_US
from spdm_jax.navsim.types import NUM_FRAMES, NUM_POSES, NavsimScene
from spdm_jax.results import Failure

_FRAMES = {"v1": 11, "v2": 9}
"""Frames of the log that a metric cache covers."""
_NEEDED = {"v1": (), "v2": ("log_red", "red_offsets", "red_xy", "ego_past", "ego_past_us")}


def is_export(path: Path) -> bool:
    """Says whether a file claims to be an exported frame."""
    try:
        with _open(path) as stored:
            return "format" in stored.files and METADATA not in stored.files
    except (OSError, ValueError, TypeError, *DAMAGE):
        return False


def read_frame(path: str | Path) -> tuple[NavsimScene, NavsimInfo]:
    """Reads one exported frame.

    Returns:
      The frame with NumPy leaves, and its description.

    Raises:
      ScenarioError: the file is damaged, of another layout, or holds something of no use; names
        file, field and value.
      OSError: the file cannot be opened.
    """
    path = Path(path)
    arrays = _arrays(path)
    info, devkit = _info(path, arrays), str(arrays["devkit"])
    if missing := [name for name in _NEEDED[devkit] if name not in arrays]:
        raise ScenarioError(f"{path}: {missing[0]} is missing; export this frame again")
    try:
        _fill_frames(arrays, _FRAMES[devkit])
        expect_plan(arrays)
        frame = from_arrays(arrays, name=str(path))
    except ValueError as error:
        text = str(error)
        raise ScenarioError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    return frame, info


def describe_export(path: Path) -> NavsimInfo:
    """Reads what an exported frame says of itself.

    Raises:
      ScenarioError: the file is damaged or of another layout.
      OSError: the file cannot be opened.
    """
    return _info(path, _arrays(path, ("devkit", "token", "log_name")))


def _info(path: Path, arrays: dict[str, np.ndarray]) -> NavsimInfo:
    devkit = str(arrays["devkit"])
    if devkit not in _FRAMES:
        raise ScenarioError(f"{path}: devkit is {devkit!r}; expected v1 or v2. Export it again")
    return NavsimInfo(
        token=str(arrays["token"]),
        log_name=str(arrays["log_name"]),
        source=f"NAVSIM {devkit}",
        profiles=FIRST if devkit == "v1" else SECOND,
    )


def _open(path: Path) -> Any:
    # From memory: NumPy leaves the file of a damaged archive open.
    return np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)


def _arrays(path: Path, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Reads arrays, all if None, after a check of format and version."""
    try:
        with _open(path) as stored:
            if "format" not in stored.files:
                packed = "a packed scenario" if METADATA in stored.files else "no exported frame"
                raise ScenarioError(
                    f"{path}: {packed}; exported frames are written by navsim_export.py"
                )
            found = (str(stored["format"]), stored["version"].tolist())
            if found != (FORMAT, VERSION):
                raise ScenarioError(
                    f"{path}: format is {found[0]!r}, version {found[1]!r}; this library reads "
                    f"{FORMAT!r}, version {VERSION}. Export with the script that comes with it"
                )
            return {name: stored[name] for name in names or stored.files}
    except ScenarioError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, *DAMAGE) as error:
        raise ScenarioError(
            f"{path}: damaged ({error}); delete it and export this frame again"
        ) from error


def _fill_frames(arrays: dict[str, np.ndarray], expected: int) -> None:
    """Brings the log of a v2 cache to 11 frames; the score looks at the first 9 only."""
    for name in ("log_pose", "log_velocity", "log_valid"):
        values = arrays[name]
        if values.ndim < 2 or len(values) != expected:
            raise ValueError(f"{name} has shape {list(values.shape)}; expected {expected} frames")
        spare = np.zeros((NUM_FRAMES - expected, *values.shape[1:]), values.dtype)
        arrays[name] = np.concatenate([values, spare])


def expect_plan(arrays: dict[str, np.ndarray]) -> None:
    """Makes room for the plan of the frame before, which comes with the trajectories.

    Args:
      arrays: of a frame; gains a plan of zeros where the past has a state of the right age.
    """
    stamps = arrays.get("ego_past_us")
    if stamps is None or stamps.ndim != 1 or len(stamps) < 2:
        return
    if stamps[-1] - stamps[-2] <= MAX_PLAN_AGE_US:
        arrays["prev_poses"] = np.zeros((NUM_POSES, 3))
        arrays["prev_start_time_us"] = stamps[-2]


def load_frames(
    source: str | Path | Iterable[str | Path],
    *,
    limit: int | None = None,
    tokens: Sequence[str] | None = None,
) -> NavsimSet:
    """Reads exported frames.

    Args:
      source: a folder, one file, or several files.
      limit: at most that many, in the order of file names.
      tokens: only these, in this order.

    Returns:
      `NavsimSet`; files that cannot be read are listed in its `failures`.

    Raises:
      ScenarioError: no file can be used, or two hold the same frame.
    """
    files = export_files(source)
    if tokens is not None:
        by_token = {path.stem: path for path in files}
        if missing := [token for token in tokens if token not in by_token]:
            raise ScenarioError(f"{source}: no exported frame for token {missing[0]!r}")
        files = [by_token[token] for token in tokens]
    found = NavsimSet([], [])
    seen: dict[str, Path] = {}
    for path in files[:limit]:
        try:
            frame, info = read_frame(path)
        except (ScenarioError, OSError) as error:
            found.failures.append(Failure(path.stem, str(error)))
            continue
        if info.token in seen:
            raise ScenarioError(
                f"{path}: holds frame {info.token!r}, and so does {seen[info.token]}"
            )
        seen[info.token] = path
        found.frames.append(frame)
        found.infos.append(info)
    if not found.infos:
        reason = f": {found.failures[0].reason}" if found.failures else ""
        raise ScenarioError(f"{source}: no usable frame{reason}")
    return found


def export_files(source: str | Path | Iterable[str | Path]) -> list[Path]:
    """Lists exported frames of a folder, in the order of their names, or what else is named.

    Raises:
      ScenarioError: nothing is there.
    """
    if not isinstance(source, str | Path):
        return [Path(path) for path in source]
    path = Path(source)
    if not path.exists():
        raise ScenarioError(f"{path}: no such file or folder")
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files:
        raise ScenarioError(f"{path}: no .npz files; write them with navsim_export.py")
    return files
