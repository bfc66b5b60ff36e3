"""Compiled programs, kept in the process and, where a compile cache is in use, on disk.

JAX's own cache stores what XLA made, under a key that needs the whole function traced and lowered
first: seconds for a planner. A program here is found by what it was made from (the source of the
package, the function's name, settings and shapes), so that a new process starts in a fraction of a
second; only after a change of the source is it traced, and compiled if it has become another one.
Stored programs are executable code: they live in the private folder of
`spdm_jax.compile_cache` and nowhere else.
"""

import contextlib
import functools
import gc
import hashlib
import importlib.metadata
import inspect
import os
import pickle
import tempfile
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

_FOLDER = "programs"
_KEPT = 400  # names of stored programs; the ones used least recently go first
_LAPACK = "@lapack_"  # in the text of programs that call it
_MAPS, _MAX_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_MAP_SHARE = 0.6  # of the memory maps that a process may have, in use before programs are dropped


@dataclass(frozen=True)
class Program:
    """A compiled function.

    Attributes:
      call: takes arguments of the shapes it was made for, anywhere; returns arrays on its devices.
      used: for each leaf of the arguments, whether the function reads it.
      seconds: what it took to make (or to load).
      stored: whether it came from disk.
    """

    call: Callable[..., Any]
    used: tuple[bool, ...]
    seconds: float
    stored: bool


_PROGRAMS: dict[Hashable, Program] = {}  # the one used last comes last
_LOCK = threading.Lock()


def program(
    name: Hashable,
    source: Callable[..., Any],
    make: Callable[[], Any],
    args: Sequence[Any],
    devices: Sequence[Any],
) -> tuple[Program, bool]:
    """Returns the program of a function for arguments of these shapes, making it at most once.

    Args:
      name: everything that the program depends on besides shapes and source: settings, arrangement.
      source: the function inside, at the top level of a module; its file is part of the key.
      make: returns the function under `jax.jit`.
      args: arguments, or `jax.ShapeDtypeStruct` trees (with shardings where there are several
        devices).
      devices: where it runs.

    Returns:
      The program, and whether this call made it.
    """
    leaves, tree = jax.tree.flatten(args)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    key = (name, source, tree, shapes, tuple(devices), jax.config.values["jax_enable_x64"])
    # One at a time: two threads that want the same program must not both compile it.
    with _LOCK:
        if found := _PROGRAMS.pop(key, None):
            _PROGRAMS[key] = found
            return found, False
        started = time.perf_counter()
        _make_room()
        path = _path(name, source, tree, shapes, devices)
        stored = path and _load(path, tree, devices)
        if stored:
            call, used = stored
        else:
            traced = make().trace(*args)
            lowered, used = traced.lower(), _used(traced.jaxpr.jaxpr)
            text = lowered.as_text() if path else ""
            twin = path and _twin(path, text, (str(tree), shapes, used), devices)
            stored = twin and _load(twin, tree, devices)
            if stored:
                call, _ = stored
            else:
                with _not_kept_by_jax() as hits:
                    call = lowered.compile(compiler_options=_compiler_options(devices))
                if twin and not hits:
                    _store(twin, call, used, _LAPACK in text)
            if path and twin:
                with contextlib.suppress(OSError):
                    os.link(twin, path)
        made = Program(call, used, time.perf_counter() - started, bool(stored))
        _PROGRAMS[key] = made
        return made, True


def _compiler_options(devices: Sequence[Any]) -> dict[str, Any]:
    """Settings of XLA beside its own.

    The autotuner for GPUs compiles and times every kernel in several ways; a planner has a thousand
    small ones, which gain nothing by it.
    """
    return {"xla_gpu_autotune_level": 0} if devices[0].platform == "gpu" else {}


def _make_room() -> None:
    """Drops the programs used least recently while the process is short of memory maps.

    A program for a CPU holds some per kernel, thousands in all; Linux allows a process 65,530 by
    default, and LLVM ends a process that asks for more.
    """
    try:
        allowed = _MAP_SHARE * int(_MAX_MAPS.read_text())
        count = lambda: _MAPS.read_bytes().count(b"\n")
        while _PROGRAMS and count() > allowed:
            del _PROGRAMS[next(iter(_PROGRAMS))]
            gc.collect()
    except OSError:  # not Linux
        return


def _twin(path: Path, text: str, arguments: tuple, devices: Sequence) -> Path:
    """Returns where a program lies under its own text: other source may have given the same.

    The text says nothing of arguments that the function does not read, but a stored program knows
    its arguments by their places among all of them.
    """
    digest = hashlib.sha256((repr(arguments) + text).encode())
    return path.with_name(f"{_platform(devices)}-{digest.hexdigest()}")


@contextlib.contextmanager
def _not_kept_by_jax() -> Iterator[list[str]]:
    """Keeps JAX from storing what is compiled meanwhile in its own cache.

    It would be there twice, and what JAX loads from disk cannot be stored again by us: it lacks
    parts of the code. Collects the programs for which that has happened.
    """
    hits: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            hits.append(event)

    name = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[name]
    jax.config.update(name, float("inf"))
    jax.monitoring.register_event_listener(listen)
    try:
        yield hits
    finally:
        jax.monitoring.unregister_event_listener(listen)
        jax.config.update(name, before)


def _used(jaxpr: Any) -> tuple[bool, ...]:
    """Which inputs of a jaxpr any of its equations (or its outputs) reads."""
    read = {id(v) for equation in jaxpr.eqns for v in equation.invars}
    read |= {id(v) for v in jaxpr.outvars}
    return tuple(id(v) in read for v in jaxpr.invars)


def _path(
    name: Hashable, source: Callable[..., Any], tree: Any, shapes: tuple, devices: Sequence
) -> Path | None:
    """Returns where a program is stored, or None where programs are not."""
    folder: str | None = jax.config.values["jax_compilation_cache_dir"]
    if not folder or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    try:
        written = Path(inspect.getfile(source)).read_bytes()
    except (OSError, TypeError):  # typed at a prompt
        return None
    facts = (
        _platform(devices),
        repr(name),
        source.__module__,
        source.__qualname__,
        hashlib.sha256(written).hexdigest(),
        package_digest(),
        str(tree),
        shapes,
    )
    return Path(folder, _FOLDER, hashlib.sha256(repr(facts).encode()).hexdigest())


def _platform(devices: Sequence) -> str:
    """Digest of what a program depends on besides its own text."""
    facts = (
        [(d.platform, d.device_kind, d.id) for d in devices],
        jax.config.values["jax_enable_x64"],
        jax.__version__,
        importlib.metadata.version("jaxlib"),
        os.environ.get("XLA_FLAGS", ""),
    )
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


@functools.cache
def package_digest() -> str:
    """Digest of the source of this package: a program made from other code is another one."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _store(path: Path, call: Any, used: tuple[bool, ...], lapack: bool) -> None:
    """Writes a program; one that cannot be written is made again next time."""
    try:
        binary, _, out_tree = serialize(call)
        # A treedef of library types cannot be pickled, a tree of numbers can.
        outline = jax.tree.unflatten(out_tree, range(out_tree.num_leaves))
        content = pickle.dumps((binary, outline, used, lapack))
    except (ValueError, NotImplementedError, pickle.PickleError, RuntimeError):
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(mode=0o700, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(partial, path)
        stored = sorted(path.parent.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in stored[_KEPT:]:
            old.unlink(missing_ok=True)


@functools.cache
def _bind_lapack() -> None:
    """Makes JAX look up LAPACK's functions, which programs call by address.

    It does so when a call of one is lowered for a CPU, and a stored program skips that: it would
    jump to nowhere.
    """
    square = jax.ShapeDtypeStruct((1, 1), np.float32)
    jax.jit(jnp.linalg.cholesky).trace(square).lower(lowering_platforms=("cpu",))


def _load(path: Path, tree: Any, devices: Sequence) -> tuple[Any, tuple[bool, ...]] | None:
    """Reads a program, or returns None: absent, damaged, or not for this machine."""
    try:
        binary, outline, used, lapack = pickle.loads(path.read_bytes())
        path.touch()
        if lapack:
            _bind_lapack()
        in_tree = jax.tree.structure((jax.tree.unflatten(tree, range(tree.num_leaves)), {}))
        out_tree = jax.tree.structure(outline)
        return deserialize_and_load(binary, in_tree, out_tree, execution_devices=devices), used
    except FileNotFoundError:
        return None
    except Exception:  # whatever a foreign or half-written file makes the loaders raise
        with contextlib.suppress(OSError):
            path.unlink()
        return None
