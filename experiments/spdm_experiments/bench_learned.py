"""Benchmark rows of learned planners: one forward pass, one drive each; weights are random."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from spdm_experiments.bench_drives import SUITE, TYPES, check
from spdm_experiments.bench_scenes import scene_files
from spdm_experiments.bench_watch import Stopwatch
from spdm_experiments.inventory import take_inventory
from spdm_experiments.options import Simulate
from spdm_experiments.simulate_options import LearnedName
from spdm_experiments.simulate_points import NAMES, make_points
from spdm_experiments.simulate_together import together
from spdm_jax.config import DT
from spdm_models import dipp, dtpp, gameformer
from spdm_models.dipp import DIPPConfig, DIPPFeatures
from spdm_models.dtpp import STEPS_PER_TOKEN, DTPPConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.params import Params
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures
from spdm_models.weights import Config, ModelName, save_weights

if TYPE_CHECKING:
    from spdm_experiments.bench_rows import Child

DRIVERS: Final[tuple[LearnedName, ...]] = ("gameformer", "gameformer-dipp", "dipp", "dtpp")
BRANCHES = 30
REPETITIONS = 2
"""Timed calls of a drive."""


@dataclass(frozen=True)
class Network:
    """What is timed of one network.

    Attributes:
      model: whose weights.
      config: sizes.
      init: makes weights.
      forward: from weights and inputs `[B, ...]` to outputs.
      inputs: makes inputs of a batch.
      block: scenes that a processor takes at a time: what they compute stays in its caches.
    """

    model: ModelName
    config: Config
    init: Callable[[jax.Array], Params]
    forward: Callable[[Params, Any], Any]
    inputs: Callable[[int], Any]
    block: int

    def compiled(self) -> Callable[[Params, Any], Any]:
        """Returns the forward pass of a batch, in blocks where that is faster."""

        def run(params: Params, given: Any) -> Any:
            return jax.lax.map(partial(self.forward, params), given, batch_size=self.block)

        return jax.jit(run if jax.default_backend() == "cpu" else self.forward)


def networks(width: int) -> dict[str, Network]:
    """Returns the networks by their names in tables.

    Args:
      width: of a token; the published one is 256.
    """
    encoder = EncoderConfig(width=width)
    levels, tree = GameFormerConfig(encoder), DTPPConfig(encoder)
    own = DIPPConfig(width=width)

    def two_stages(params: Params, given: Any) -> Any:
        features, branches = given
        encoding = dtpp.encode(params, tree, features)
        steps = tree.seconds * STEPS_PER_TOKEN
        return dtpp.decode(params, tree, encoding, features, branches, steps)

    return {
        "GameFormer": Network(
            "gameformer",
            levels,
            lambda key: gameformer.init(levels, key),
            lambda params, given: gameformer.apply(params, levels, given),
            _scene,
            block=4,
        ),
        "DTPP": Network(
            "dtpp",
            tree,
            lambda key: dtpp.init(tree, key),
            two_stages,
            lambda batch: (_scene(batch), _random(1, batch, BRANCHES, 80, 6)),
            block=1,
        ),
        "DIPP": Network(
            "dipp",
            own,
            lambda key: dipp.init(own, key),
            lambda params, given: dipp.apply(params, own, given),
            _actors,
            block=4,
        ),
    }


def _random(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def _scene(batch: int) -> SceneFeatures:
    return SceneFeatures(
        ego_past=_random(2, batch, 21, 7),
        neighbors_past=_random(3, batch, 20, 21, 11),
        lanes=_random(4, batch, 40, 50, 7),
        crosswalks=_random(5, batch, 5, 30, 3),
        route_lanes=_random(6, batch, 10, 50, 3),
    )


def _actors(batch: int) -> DIPPFeatures:
    lanes = np.array(_random(7, batch, 11, 6, 100, 17))
    # Columns of types hold whole numbers.
    lanes[..., 10:] = 1
    neighbors = np.array(_random(8, batch, 10, 20, 9))
    neighbors[..., 8] = 1
    return DIPPFeatures(
        ego=_random(9, batch, 20, 8),
        neighbors=jnp.asarray(neighbors),
        map_lanes=jnp.asarray(lanes),
        map_crosswalks=_random(10, batch, 11, 4, 100, 3),
    )


def learned(child: Child) -> None:
    """Adds the rows of all networks and planners to a child's.

    Raises:
      RuntimeError: an output is not finite, or a drive failed.
    """
    found = networks(child.size.network_width)
    for name, network in found.items():
        _forward(child, name, network)
    if child.size.learned_drives:
        with tempfile.TemporaryDirectory() as folder:
            _drives(child, found, Path(folder))


def _forward(child: Child, name: str, network: Network) -> None:
    params = network.init(jax.random.key(0))
    run = network.compiled()
    for batch in child.size.network_batches:
        given = network.inputs(batch)

        def finite(output: Any, name=name) -> None:
            if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(output)):
                raise RuntimeError(f"{name}: an output is not finite")

        child.add(
            f"{name} forward, batch {batch}",
            lambda given=given: jax.block_until_ready(run(params, given)),
            finite,
            network=name,
            batch=batch,
        )


def _drives(child: Child, found: Mapping[str, Network], folder: Path) -> None:
    files: dict[ModelName, Path] = {}
    for network in found.values():
        path = folder / f"{network.model}.safetensors"
        save_weights(path, network.model, network.config, network.init(jax.random.key(0)))
        files[network.model] = path
    file = scene_files(child.folder, "drives")[:1]
    child.watch = Stopwatch(REPETITIONS, warmups=0)
    for name in DRIVERS:
        model: ModelName = "gameformer" if name == "gameformer-dipp" else name
        options = Simulate(
            scenes=file[0].parent,
            planner=(name,),
            weights=files[model],
            traffic=("replay",),
            precision=child.precision,
        )
        entries = take_inventory(file).entries
        job = together(options, entries, make_points(options))
        engine, scenes = job.engine(), job.loader().load(entries, job.groups[0].padding)
        child.add(
            f"{NAMES[name]}, one drive",
            lambda engine=engine, scenes=scenes: engine.compute(scenes, 0)[0],
            lambda rows: check(rows, None),
            planner=NAMES[name],
            seconds=DT * (entries[0].num_iterations - 1),
            suite=SUITE,
            kinds=len(TYPES),
        )
