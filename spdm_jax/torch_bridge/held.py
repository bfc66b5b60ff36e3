"""Scenarios that stay on a device between calls."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import numpy as np

from spdm_jax.api import fit_config
from spdm_jax.batching import Precision, cast_leaf, leaf_type, x64
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.navsim.types import NavsimScene
from spdm_jax.programs import Program
from spdm_jax.results import ScenarioSet
from spdm_jax.types import Scenario

if TYPE_CHECKING:
    from torch import Tensor  # pyright: ignore[reportMissingImports]

Scene: TypeAlias = Scenario | NavsimScene
PROBLEMS = {
    1: "more path points or red lights than there is room for; raise "
    "PlannerConfig.max_red_lights or max_red_edges",
    2: "a score is not a finite number; compare with precision='f64'",
}


class UnusableScene(ValueError):
    """A scene that cannot be scored."""


class Held:
    """The scenes of a set on one device, in one precision; filled as they are asked for."""

    def __init__(self, scenes: ScenarioSet | NavsimSet, precision: Precision, device: Any):
        self.device = device
        self.precision: Precision = precision
        self.dtype = np.dtype(np.float64 if precision == "f64" else np.float32)
        self.tokens = [info.token for info in scenes.infos]
        self._row = {token: i for i, token in enumerate(self.tokens)}
        self._failed = {failure.token: failure.reason for failure in scenes.failures}
        self._batch = scenes.stacked() if isinstance(scenes, NavsimSet) else scenes.batch
        self._scenes: dict[int, Scene] = {}
        self._stacked: Scene | None = None
        self._params: PlannerParams | None = None
        self._pools: dict[int, ThreadPoolExecutor] = {}
        self._lock = threading.RLock()
        self.path_room: int | None = None  # frames hold their path
        if isinstance(scenes, ScenarioSet):
            self.path_room = fit_config(scenes, PlannerConfig()).max_path_points

    def __len__(self) -> int:
        return len(self.tokens)

    def rows(self, tokens: Sequence[str] | None, count: int) -> np.ndarray:
        """Returns `[B]` rows of the set."""
        if tokens is None:
            if count != len(self):
                raise ValueError(
                    f"trajectories holds {count} scenes, the scenario set {len(self)}; pass tokens "
                    "to say which ones"
                )
            return np.arange(count)
        if isinstance(tokens, str) or len(tokens) != count:
            raise ValueError(f"tokens is {tokens!r}; it must name {count} scenes")
        for token in tokens:
            if token not in self._row:
                reason = self._failed.get(token)
                why = f"it failed to load: {reason}" if reason else "load it with the others"
                raise ValueError(f"scene {token!r} is not in the scenario set; {why}")
        return np.array([self._row[token] for token in tokens])

    def refuse(self, rows: np.ndarray, problems: np.ndarray) -> None:
        """Raises what went wrong in a scene."""
        for row in np.flatnonzero(problems):
            reason = PROBLEMS[int(problems[row])]
            raise UnusableScene(
                f"scene {self.tokens[rows[row]]!r}: {reason}, or leave the scene out "
                "(TorchScorer.unusable lists all such scenes)"
            )

    def from_global(self, trajectories: Tensor, rows: np.ndarray) -> Tensor:
        """Subtracts the origin of each scene's frame."""
        import torch  # pyright: ignore[reportMissingImports]

        if trajectories.dtype != torch.float64:
            raise ValueError(
                f"trajectories in map coordinates are {trajectories.dtype}; pass float64, or poses "
                "in the ego frame"
            )
        shift = np.zeros((len(rows), 1, 1, 3))
        shift[..., :2] = np.asarray(self._batch.origin)[rows, None, None]
        return trajectories - torch.from_numpy(shift).to(trajectories.device)

    def params(self, params: PlannerParams | None) -> PlannerParams:
        """Returns settings on the device."""
        if params is None and self._params is not None:
            return self._params
        with x64(self.precision):
            move = lambda value: jax.device_put(np.asarray(value, self.dtype), self.device)
            moved = jax.tree.map(move, params or PlannerParams())
        if params is None:
            self._params = moved
        return moved

    def shape(self, count: int | None = None) -> Scene:
        """Returns the shape of one scenario, or of `count` stacked ones."""
        lead = () if count is None else (count,)
        kind = lambda leaf: leaf_type(leaf, self.dtype)
        like = lambda leaf: jax.ShapeDtypeStruct((*lead, *leaf.shape[1:]), kind(leaf))
        return jax.tree.map(like, self._batch)

    def scene(self, row: int, made: Program) -> Scene:
        """Returns one scenario on the device."""
        if (found := self._scenes.get(row)) is None:
            with self._lock:
                if (found := self._scenes.get(row)) is None:
                    found = self._scenes[row] = self._place(made, lambda leaf: leaf[row])
        return found

    def stacked(self, made: Program) -> Scene:
        """Returns all scenarios on the device."""
        with self._lock:
            if self._stacked is None:
                self._stacked = self._place(made, lambda leaf: leaf)
            return self._stacked

    def pool(self, threads: int) -> ThreadPoolExecutor:
        """Returns the threads that scenes run in."""
        with self._lock:
            if threads not in self._pools:
                self._pools[threads] = ThreadPoolExecutor(threads, "spdm-torch")
            return self._pools[threads]

    def _place(self, made: Program, pick: Any) -> Scene:
        leaves, tree = jax.tree.flatten(self._batch)
        used = made.used[: len(leaves)]
        cast = [cast_leaf(pick(v), u, self.dtype) for v, u in zip(leaves, used, strict=True)]
        read = [v for v, u in zip(cast, used, strict=True) if u]
        placed = iter(jax.device_put(read, self.device))
        # What nobody reads stays on the host.
        leaves = [next(placed) if u else v for v, u in zip(cast, used, strict=True)]
        return jax.tree.unflatten(tree, leaves)


class _Cache(dict[Any, Held]):
    """What a scenario set keeps of its devices; a copied or pickled set starts with none."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (_Cache, ())


def held_scenes(scenes: ScenarioSet | NavsimSet, precision: Precision, device: Any) -> Held:
    """Returns what a set keeps on a device, made at the first call."""
    cache = vars(scenes).setdefault("_on_devices", _Cache())
    key = (precision, device)
    if key not in cache:
        # Of two threads that come here at once, one is served by the other's.
        cache.setdefault(key, Held(scenes, precision, device))
    return cache[key]
