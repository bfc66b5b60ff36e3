"""Many scenes through one program: padding groups, chunks, threads and devices.

A function of one scene is compiled once per padding and run over any number of scenes:

- on a CPU with one device, scene by scene, as many at a time as there are cores. A program of one
  scene keeps its working set in cache and does not know how many scenes there are; a second core
  gains more from a second scene than from splitting the work of one (measured);
- on several devices, as one `jax.sharding` mesh over the scenes; each device loops over its share
  on a CPU and takes it as one batch (`vmap`) on an accelerator.

Either way a scene's result does not depend on its neighbours or on the size of the chunk.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from spdm_jax.padding import PaddingConfig, bucket
from spdm_jax.programs import program
from spdm_jax.schema import LEAVES
from spdm_jax.types import ScenarioBatch

Precision = Literal["f32", "f64"]
S = TypeVar("S")
T = TypeVar("T")

MAX_GROUPS = 4
"""Padding groups of a set at most: each costs one compilation."""
WASTE = 2.0
"""A group takes scenarios in that pad to less than this many times their own size."""
_CHUNKS = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class BatchConfig:
    """How scenes are spread over time and devices.

    Attributes:
      chunk: scenes per device call, None to derive it from `memory`. Scene by scene on one CPU
        device it only bounds what is on its way.
      memory: bytes that the scenes of one chunk may take.
      devices: local devices to use, None for all.
      threads: scenes at a time on one CPU device, None for one per core.
    """

    chunk: int | None = None
    memory: int = 512 * 2**20
    devices: int | None = None
    threads: int | None = None

    def __post_init__(self):
        for name in ("chunk", "memory", "devices", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1")


@dataclass
class BatchStats:
    """What a runner has done so far; compilation apart from running.

    Attributes:
      programs: programs made or loaded from disk.
      compile_s: seconds that took.
      run_s: seconds of all calls, compilation apart.
      scenes: scenes run.
      chunk: scenes per device call of the last call.
      arrangement: how the last call spread its scenes.
      messages: what the user should know, such as a chunk that did not fit.
    """

    programs: int = 0
    compile_s: float = 0.0
    run_s: float = 0.0
    scenes: int = 0
    chunk: int = 0
    arrangement: str = ""
    messages: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ShapeGroup:
    """Scenarios that share one padding.

    Attributes:
      padding: one size per axis.
      rows: their indices.
    """

    padding: PaddingConfig
    rows: list[int]


class SceneRunner:
    """Runs one pure function of a scene over many scenes.

    Args:
      function: `function(scene, mine, shared, static)`, at the top level of a module, pure, of one
        scene: a `Scenario`, or another pytree of arrays with an `origin`. `mine` and `shared` are
        pytrees of arrays (or None): one entry per scene, and the same for all.
      static: hashable settings; a new value compiles anew.
      precision: floating type of the scene's arrays and of `mine` and `shared`.
      config: chunks and devices.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any, Any], Any],
        static: Hashable = None,
        *,
        precision: Precision = "f32",
        config: BatchConfig | None = None,
    ):
        if precision not in ("f32", "f64"):
            raise ValueError(f"precision is {precision!r}; it must be 'f32' or 'f64'")
        self.function, self.static = function, static
        self.precision: Precision = precision
        self.config = config or BatchConfig()
        self.stats = BatchStats()
        self._limit: int | None = None  # learnt from running out of memory

    def __call__(
        self,
        batch: Any,
        mine: Any = None,
        shared: Any = None,
        *,
        scene_of: np.ndarray | None = None,
    ) -> Any:
        """Runs all scenes of a batch.

        Args:
          batch: NumPy leaves `[B, ...]`.
          mine: leaves `[N, ...]`.
          shared: leaves of any shape.
          scene_of: `[N]` scene of each entry of `mine`; one entry per scene if None.

        Returns:
          The function's results as NumPy leaves `[N, ...]`.
        """
        with x64(self.precision):
            started, compiled = time.perf_counter(), self.stats.compile_s
            dtype = np.dtype(np.float64 if self.precision == "f64" else np.float32)
            mine, shared = _cast(mine, dtype), _cast(shared, dtype)
            batch = batch.replace(origin=np.zeros(np.shape(batch.origin), dtype))
            devices = self._devices()
            scene_of = np.arange(len(batch.origin)) if scene_of is None else scene_of
            if len(devices) == 1 and devices[0].platform == "cpu":
                result = self._scene_by_scene(batch, mine, shared, scene_of, dtype, devices[0])
            else:
                result = self._by_chunks(batch, mine, shared, scene_of, dtype, devices)
            elapsed = time.perf_counter() - started
            self.stats.run_s += elapsed - (self.stats.compile_s - compiled)
            self.stats.scenes += len(scene_of)
        return result

    def warmup(self, batch: ScenarioBatch, mine: Any = None, shared: Any = None) -> float:
        """Compiles for batches like this one and returns the seconds that took."""
        before = self.stats.compile_s
        first = lambda tree: jax.tree.map(lambda leaf: leaf[:1], tree)
        scenes, run = self.stats.scenes, self.stats.run_s
        many = len(self._devices()) > 1 or self._devices()[0].platform != "cpu"
        if many:
            self(batch, mine, shared)
        else:
            self(first(batch), first(mine), shared)
        self.stats.scenes, self.stats.run_s = scenes, run
        return self.stats.compile_s - before

    def _devices(self) -> list[Any]:
        found = jax.local_devices()
        return found[: self.config.devices or len(found)]

    def _program(self, name: Hashable, make, args, devices) -> Any:
        made, new = program((name, self.static, self.precision), self.function, make, args, devices)
        if new:
            self.stats.programs += 1
            self.stats.compile_s += made.seconds
        return made

    def _scene_by_scene(self, batch, mine, shared, scene_of, dtype, device) -> Any:
        leaves, tree = jax.tree.flatten(batch)
        own_leaves, own_tree = jax.tree.flatten(mine)
        shape = lambda leaf: _shape(leaf[0], dtype)
        made = self._program(
            "one scene",
            lambda: jax.jit(partial(_one_scene, self.function, self.static)),
            (
                jax.tree.map(shape, batch),
                jax.tree.map(shape, mine),
                jax.tree.map(lambda leaf: _shape(leaf, dtype), shared),
            ),
            [device],
        )
        threads = min(len(scene_of), self.config.threads or usable_cores())
        # Arguments stay NumPy arrays: a call reads those where they are, or copies them by itself
        # in a tenth of the time that placing a hundred of them one by one takes.
        used = made.used[: len(leaves)]
        own_used = made.used[len(leaves) :]

        @lru_cache(maxsize=threads)
        def scene(number: int) -> Any:
            cast = [cast_leaf(v[number], u, dtype) for v, u in zip(leaves, used, strict=True)]
            return jax.tree.unflatten(tree, cast)

        def run(row: int) -> Any:
            with x64(self.precision):  # a setting of the thread
                pairs = zip(own_leaves, own_used, strict=False)
                own = [cast_leaf(v[row], used, dtype) for v, used in pairs]
                own = jax.tree.unflatten(own_tree, own)
                found = made.call(scene(int(scene_of[row])), own, shared)
                return jax.tree.map(np.asarray, found)

        self.stats.chunk, self.stats.arrangement = threads, f"{threads} scenes at a time"
        if threads == 1:
            result = [run(row) for row in range(len(scene_of))]
        else:
            with ThreadPoolExecutor(threads) as pool:
                result = list(pool.map(run, range(len(scene_of))))
        return jax.tree.map(lambda *leaves: np.stack(leaves), *result)

    def _by_chunks(self, batch, mine, shared, scene_of, dtype, devices) -> Any:
        total = len(scene_of)
        size = self._chunk_size(batch, total, len(devices))
        items = (batch, mine, shared, scene_of)
        parts, begin = [], 0
        while begin < total:
            try:
                rows = np.arange(begin, min(begin + size, total))
                parts.append(self._one_chunk(items, dtype, devices, rows, size))
                begin += len(rows)
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or size <= len(devices):
                    raise
                smaller = max(len(devices), size // 2)
                self.stats.messages.append(
                    f"out of device memory with {size} scenes per call; continuing with {smaller}"
                )
                self._limit = size = smaller
        self.stats.chunk = size
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    def _chunk_size(self, batch, total: int, num_devices: int) -> int:
        if self.config.chunk is not None:  # also for a short last chunk: the same program
            size = self.config.chunk
        else:
            each = sum(leaf[0].nbytes for leaf in jax.tree.leaves(batch))
            size = max((c for c in _CHUNKS if c * each <= self.config.memory), default=1)
            size = min(size, total)
        if self._limit is not None:
            size = min(size, self._limit)
        return -(-size // num_devices) * num_devices

    def _one_chunk(self, items, dtype, devices, rows, size: int) -> Any:
        batch, mine, shared, scene_of = items
        mesh = Mesh(np.array(devices), ("scenes",))
        split, whole = (NamedSharding(mesh, PartitionSpec(*s)) for s in (("scenes",), ()))
        share = size // len(devices)
        kind = "loop" if devices[0].platform == "cpu" else "batch"
        # Rows beyond the last scene repeat it: finite numbers, and nobody reads the result.
        filled = np.resize(rows, size)
        filled[len(rows) :] = rows[-1]
        real = np.minimum(np.maximum(len(rows) - share * np.arange(len(devices)), 0), share)
        chunk = (
            jax.tree.map(lambda leaf: leaf[scene_of[filled]], batch),
            jax.tree.map(lambda leaf: leaf[filled], mine),
        )
        shape = lambda leaf: jax.ShapeDtypeStruct(
            leaf.shape, leaf_type(leaf, dtype), sharding=split
        )
        args = (
            jax.tree.map(shape, chunk),
            jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype, sharding=whole), shared),
            jax.ShapeDtypeStruct((len(devices),), np.dtype(np.int32), sharding=split),
        )
        made = self._program(
            (kind, size, len(devices)),
            lambda: jax.jit(partial(_many_scenes, self.function, self.static, kind, mesh)),
            args,
            devices,
        )
        place = lambda leaf: jax.device_put(np.asarray(leaf, leaf_type(leaf, dtype)), split)
        found = made.call(
            jax.tree.map(place, chunk),
            jax.tree.map(lambda v: jax.device_put(v, whole), shared),
            jax.device_put(real.astype(np.int32), split),
        )
        self.stats.arrangement = f"{len(devices)} devices, each its share as one {kind}"
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(rows)], found)


def _one_scene(function, static, scene, mine, shared):
    return function(scene, mine, shared, static)


def _many_scenes(function, static, kind, mesh, scenes, shared, count):
    """All scenes of a chunk: every device its share, of which `count` are real."""

    def share(scenes, shared, count):
        one = lambda row: function(*row, shared, static)
        if kind == "batch":
            return jax.vmap(one)(scenes)
        at = lambda i: jax.tree.map(lambda leaf: leaf[i], scenes)
        size = jax.tree.leaves(scenes)[0].shape[0]
        outline = jax.eval_shape(lambda: one(at(0)))
        empty = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), outline)

        def visit(i, out):
            return jax.tree.map(lambda all_, mine: all_.at[i].set(mine), out, one(at(i)))

        # The trip count is data: XLA must not unroll the loop where a device has one scene.
        return jax.lax.fori_loop(0, count[0], visit, empty)

    each, whole = PartitionSpec("scenes"), PartitionSpec()
    specs = {"in_specs": (each, whole, each), "out_specs": each}
    return jax.shard_map(share, mesh=mesh, check_vma=False, **specs)(scenes, shared, count)


def x64(precision: Precision):
    """The context in which JAX uses the precision's types."""
    return jax.enable_x64(precision == "f64" or jax.config.values["jax_enable_x64"])


def leaf_type(leaf: np.ndarray, dtype: np.dtype) -> np.dtype:
    """Type of a leaf in a computation whose floating type is `dtype`."""
    return dtype if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype


def _shape(leaf: Any, dtype: np.dtype) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(np.shape(leaf), leaf_type(leaf, dtype))


def cast_leaf(leaf: np.ndarray, used: bool, dtype: np.dtype) -> np.ndarray:
    """Returns a leaf in the type of the computation, an array without memory if nobody reads it."""
    kind = leaf_type(leaf, dtype)
    return np.asarray(leaf, kind) if used else np.broadcast_to(np.zeros((), kind), leaf.shape)


def _cast(tree: Any, dtype: np.dtype) -> Any:
    return jax.tree.map(lambda v: np.asarray(v, leaf_type(np.asarray(v), dtype)), tree)


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def padded_bytes(sizes: Mapping[str, int]) -> int:
    """Bytes of one scenario padded to these sizes."""
    words = max(1, -(-(sizes["lanes"] + sizes["car_parks"] + sizes["intersections"]) // 32))
    sizes = {**sizes, "grid_words": words}
    total = 0
    for leaf in LEAVES.values():
        entries = 1
        for axis in leaf.axes:
            entries *= axis if isinstance(axis, int) else sizes[axis]
        total += entries * np.dtype(leaf.dtype).itemsize
    return total


def group_by_shape(
    sizes: Sequence[Mapping[str, int]],
    padding: PaddingConfig | None = None,
    waste: float = WASTE,
) -> list[ShapeGroup]:
    """Puts scenarios of similar size into few groups of one padding each.

    One common padding would make every scenario as large as the largest of each axis; a padding
    for each would compile anew for each. Scenarios are taken by size, and a group ends where it
    would cost more than `waste` times what its scenarios need alone.

    Args:
      sizes: length of every free axis of each scenario, see `padding.sizes_of`.
      padding: bucket sizes.
      waste: at least 1; more of it gives fewer groups.

    Returns:
      At most `MAX_GROUPS` groups, smallest scenarios first; rows in ascending order.

    Raises:
      ValueError: a scenario exceeds the largest bucket.
    """
    allowed = padding or PaddingConfig()
    axes = [f.name for f in PaddingConfig.__dataclass_fields__.values()]
    own = [{axis: bucket(s[axis], getattr(allowed, axis)) for axis in axes} for s in sizes]
    alone = [padded_bytes(s) for s in own]
    order = sorted(range(len(own)), key=lambda i: (alone[i], i))

    def split(waste: float) -> list[tuple[dict[str, int], list[int]]]:
        groups: list[tuple[dict[str, int], list[int]]] = []
        for i in order:
            if groups:
                common, rows = groups[-1]
                larger = {axis: max(common[axis], own[i][axis]) for axis in axes}
                if padded_bytes(larger) <= waste * alone[rows[0]]:
                    groups[-1] = (larger, [*rows, i])
                    continue
            groups.append((own[i], [i]))
        return groups

    while len(groups := split(waste)) > MAX_GROUPS:
        waste *= 2
    return [
        ShapeGroup(PaddingConfig(**{axis: (n,) for axis, n in common.items()}), sorted(rows))
        for common, rows in groups
    ]


def prefetch(make: Callable[[S], T], items: Iterable[S], threads: int = 2) -> Iterator[T]:
    """Yields `make` of each item, in order, made ahead of time by some threads.

    Args:
      make: called in a thread; what it raises is raised here, in its place.
      items: arguments; taken one by one, as many ahead as there are threads.
      threads: items in the making at a time.
    """
    ahead: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                ahead.append(pool.submit(make, item))
                if len(ahead) > threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()
