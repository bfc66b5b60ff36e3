"""Compiled programs, kept in the process and, where a compile cache is in use, on disk.

JAX's own cache stores what XLA made, under a key that needs the whole function traced and lowered
first: seconds for a planner. A program here is found by what it was made from (the source of the
package, the function's name, settings and shapes), so that a new process starts in a fraction of a
second. Stored programs are executable code: they live in the private folder of
`spdm_jax.compile_cache` and nowhere else.
"""

import contextlib
import functools
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
from jax.experimental.serialize_executable import deserialize_and_load, serialize

_FOLDER = "programs"
_KEPT = 200  # stored programs; the ones used least recently go first


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


_PROGRAMS: dict[Hashable, Program] = {}
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
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    key = (name, source, tree, shapes, tuple(devices), jax.config.values["jax_enable_x64"])
    if found := _PROGRAMS.get(key):
        return found, False
    # One at a time: two threads that want the same program must not both compile it.
    with _LOCK:
        if found := _PROGRAMS.get(key):
            return found, False
        started = time.perf_counter()
        path = _path(name, source, tree, shapes, devices)
        loaded = path and _load(path, tree, devices)
        if loaded:
            call, used = loaded
        else:
            traced = make().trace(*args)
            used = _used(traced.jaxpr.jaxpr)
            with _cache_hits() as hits:
                call = traced.lower().compile()
            # What JAX itself loaded from disk cannot be stored again: it lacks parts of the code.
            if path and not hits:
                _store(path, call, used)
        made = Program(call, used, time.perf_counter() - started, bool(loaded))
        _PROGRAMS[key] = made
        return made, True


@contextlib.contextmanager
def _cache_hits() -> Iterator[list[str]]:
    """Collects the programs that JAX loads from its own cache meanwhile."""
    hits: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            hits.append(event)

    jax.monitoring.register_event_listener(listen)
    try:
        yield hits
    finally:
        jax.monitoring.unregister_event_listener(listen)


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
        repr(name),
        source.__module__,
        source.__qualname__,
        hashlib.sha256(written).hexdigest(),
        package_digest(),
        str(tree),
        shapes,
        [(d.platform, d.device_kind, d.id) for d in devices],
        jax.config.values["jax_enable_x64"],
        jax.__version__,
        importlib.metadata.version("jaxlib"),
        os.environ.get("XLA_FLAGS", ""),
    )
    return Path(folder, _FOLDER, hashlib.sha256(repr(facts).encode()).hexdigest())


@functools.cache
def package_digest() -> str:
    """Digest of the source of this package: a program made from other code is another one."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _store(path: Path, call: Any, used: tuple[bool, ...]) -> None:
    """Writes a program; one that cannot be written is made again next time."""
    try:
        binary, _, out_tree = serialize(call)
        # A treedef of library types cannot be pickled, a tree of numbers can.
        outline = jax.tree.unflatten(out_tree, range(out_tree.num_leaves))
        content = pickle.dumps((binary, outline, used))
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


def _load(path: Path, tree: Any, devices: Sequence) -> tuple[Any, tuple[bool, ...]] | None:
    """Reads a program, or returns None: absent, damaged, or not for this machine."""
    try:
        binary, outline, used = pickle.loads(path.read_bytes())
        path.touch()
        in_tree = jax.tree.structure((jax.tree.unflatten(tree, range(tree.num_leaves)), {}))
        out_tree = jax.tree.structure(outline)
        return deserialize_and_load(binary, in_tree, out_tree, execution_devices=devices), used
    except FileNotFoundError:
        return None
    except Exception:  # whatever a foreign or half-written file makes the loaders raise
        with contextlib.suppress(OSError):
            path.unlink()
        return None
