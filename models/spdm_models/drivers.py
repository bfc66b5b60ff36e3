"""Learned planners by name: from a file of weights to a driver of the closed loop."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import numpy as np

from spdm_jax.simulation.drivers import Driver

from .checkpoint import read_metadata
from .dipp import NUM_WEIGHTS, DIPPConfig
from .dipp_driver import DIPPDriverConfig, dipp_driver
from .dipp_on_gameformer import DIPPRefinerConfig, even_weights
from .dipp_planner import DIPPPlannerConfig
from .dtpp import DTPPConfig
from .dtpp_driver import DTPPDriverConfig, dtpp_driver
from .dtpp_planner import DTPPPlannerConfig
from .gameformer_driver import gameformer_driver
from .gameformer_planner import GameFormerPlannerConfig, Refinement
from .params import Params
from .predictions import Prediction
from .route_lines import RouteLineConfig
from .weights import Config, ModelName, load_weights

LearnedName = Literal["gameformer", "gameformer-path", "gameformer-dipp", "dipp", "dtpp"]
TITLES: Mapping[LearnedName, str] = {
    "gameformer": "GameFormer",
    "gameformer-path": "GameFormer + path",
    "gameformer-dipp": "GameFormer + DIPP",
    "dipp": "DIPP",
    "dtpp": "DTPP",
}
"""Planners, and how tables call them."""
MODELS: Mapping[LearnedName, tuple[ModelName, ...]] = {
    "gameformer": ("gameformer",),
    "gameformer-path": ("gameformer",),
    "gameformer-dipp": ("gameformer",),
    "dipp": ("dipp", "gameformer"),
    "dtpp": ("dtpp",),
}
"""Whose weights a planner takes. "dipp" with GameFormer's (N_l = 0) is the paper's, with its own
network's the public code's."""
_REFINEMENTS: Mapping[LearnedName, Refinement] = {
    "gameformer": "none",
    "gameformer-path": "path",
    "gameformer-dipp": "dipp",
    "dipp": "dipp",
}


@dataclass(frozen=True)
class LearnedPlanner:
    """What a compiled program depends on; the weights are its arguments.

    Attributes:
      name: of the planner.
      model: whose weights.
      network: sizes of the network.
      prediction: what it takes for the neighbours' futures.
      code: digest of this package: stored programs are found by it.
      max_path_points: room for the map's points along a line.
      num_lines: room for lanes that may be followed.
    """

    name: LearnedName
    model: ModelName
    network: Config
    prediction: Prediction
    code: str
    max_path_points: int = 2048
    num_lines: int = 8


@dataclass(frozen=True)
class Weights:
    """A file of weights.

    Attributes:
      path: the file.
      model: whose weights.
      network: sizes of the network.
      arrays: `network` (its variables) and `cost_weights` `[9]` of DIPP's problem.
      digest: of the file.
      training: what the file's header says of it; empty for weights of elsewhere.
    """

    path: Path
    model: ModelName
    network: Config
    arrays: dict[str, Any]
    digest: str
    training: Mapping[str, Any]

    @property
    def sizes(self) -> str:
        """The network's sizes, for people."""
        network = self.network
        if isinstance(network, DIPPConfig):
            return f"width {network.width}, {network.modes} modes, {network.horizon} steps"
        encoder = f"width {network.encoder.width}, {network.encoder.layers} encoder layers"
        if isinstance(network, DTPPConfig):
            return encoder
        return f"{encoder}, N_l = {network.levels}, {network.modes} modes"


def read_weights(path: Path, name: LearnedName) -> Weights:
    """Reads the weights of a planner.

    Args:
      path: a file of `spdm convert` or `spdm train`, or any checkpoint that `load_weights` reads.
      name: of the planner.

    Raises:
      ValueError: there is no such file, it is of another model, or it does not fit; names the file.
    """
    if not path.is_file():
        raise ValueError(
            f"{path}: no such file of weights for {name}; make one with spdm train or spdm convert"
        )
    about = read_metadata(path)
    said = about.get("model")
    if said is not None and said not in MODELS[name]:
        raise ValueError(
            f"{path} holds weights of {said}; {name} takes those of {' or '.join(MODELS[name])}"
        )
    model: ModelName = said or MODELS[name][0]
    network, params = load_weights(path, model)
    training = about.get("training", {})
    given = training.get("cost_weights")
    costs = np.asarray(even_weights() if given is None else given, np.float32)
    if costs.shape != (NUM_WEIGHTS,) or not np.isfinite(costs).all():
        raise ValueError(f"{path}: cost_weights is {given}; expected {NUM_WEIGHTS} finite numbers")
    arrays = {"network": jax.tree.map(np.asarray, params), "cost_weights": costs}
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return Weights(path, model, network, arrays, digest, training)


def learned_planner(name: LearnedName, weights: Weights, prediction: Prediction) -> LearnedPlanner:
    """Returns the static settings of a planner with these weights."""
    if name not in get_args(LearnedName):
        raise ValueError(f"no learned planner {name!r}; there are {', '.join(TITLES)}")
    return LearnedPlanner(name, weights.model, weights.network, prediction, package_digest())


def make_driver(planner: LearnedPlanner, arrays: Mapping[str, Any]) -> Driver:
    """Returns the driver of a planner; to be called inside `jit`, with traced arrays.

    Args:
      planner: static settings.
      arrays: of `Weights`.
    """
    params: Params = arrays["network"]
    network, room = planner.network, planner.max_path_points
    if isinstance(network, DTPPConfig):
        lines = RouteLineConfig(num_lines=planner.num_lines, max_path_points=room)
        config = DTPPDriverConfig(
            planner=DTPPPlannerConfig(network=network, lines=lines), prediction=planner.prediction
        )
        return dtpp_driver(params, config)
    if isinstance(network, DIPPConfig):
        refiner = DIPPRefinerConfig(
            problem=_problem(network.horizon, DIPPPlannerConfig()), max_path_points=room
        )
        return dipp_driver(
            params,
            DIPPDriverConfig(network=network, refiner=refiner, prediction=planner.prediction),
        )
    default = DIPPRefinerConfig()
    config = GameFormerPlannerConfig(
        network=network,
        prediction=planner.prediction,
        refinement=_REFINEMENTS[planner.name],
        dipp=replace(
            default, problem=_problem(network.steps, default.problem), max_path_points=room
        ),
        lines=RouteLineConfig(num_lines=planner.num_lines, min_length=24.0, max_path_points=room),
    )
    title = TITLES[planner.name]
    return gameformer_driver(title, params, arrays["cost_weights"], config)


def _problem(horizon: int, usual: DIPPPlannerConfig) -> DIPPPlannerConfig:
    """A problem of another horizon: steps beyond it do not count."""
    steps = tuple(step for step in usual.safety_steps if step < horizon)
    return replace(usual, horizon=horizon, safety_steps=steps)


@cache
def package_digest() -> str:
    """Digest of the source of this package."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
