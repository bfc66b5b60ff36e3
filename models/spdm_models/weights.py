"""Weights of a named model: from any checkpoint, checked name by name, to a file that says its own
sizes."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jax.typing import DTypeLike

from . import dipp, dtpp, gameformer
from .checkpoint import read_checkpoint, read_metadata, write_checkpoint
from .dipp import DIPPConfig
from .dtpp import DTPPConfig
from .gameformer import GameFormerConfig
from .params import Params
from .scene_encoder import EncoderConfig
from .state_dict import Extras, from_state_dict, to_state_dict

ModelName = Literal["gameformer", "dtpp", "dipp"]
Config = GameFormerConfig | DTPPConfig | DIPPConfig
SMALL_WEIGHTS = Path(__file__).with_name("small")
"""Small trained weights that come with the package: PLANNER.safetensors, and how they were made."""


@dataclass(frozen=True)
class _Family:
    """How the weights of one kind of network are read."""

    config: type[Config]
    config_of: Callable[[Mapping[str, np.ndarray]], Config]
    abstract: Callable[[Any], Params]
    extras: Callable[[Any], Extras]


_FAMILIES: dict[ModelName, _Family] = {
    "gameformer": _Family(
        GameFormerConfig, gameformer.config_of, gameformer.abstract, gameformer.extras
    ),
    "dtpp": _Family(DTPPConfig, dtpp.config_of, dtpp.abstract, dtpp.extras),
    "dipp": _Family(DIPPConfig, dipp.config_of, dipp.abstract_params, lambda config: dipp.EXTRAS),
}


def load_weights(
    path: Path,
    model: ModelName,
    prefix: str = "",
    dtype: DTypeLike = np.float32,
    **settings: Any,
) -> tuple[Any, Params]:
    """Reads a checkpoint of a model, torch's or one of `save_weights`.

    Args:
      path: file of weights, see `checkpoint.read_checkpoint`.
      model: what it holds.
      prefix: the part of the file that holds the weights.
      dtype: of the weights.
      **settings: fields of the configuration that the arrays do not tell (heads, a variable cost).

    Returns:
      the model's configuration and its variables.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file is of another model, or a name, shape or value does not fit.
    """
    family = _FAMILIES[model]
    state = read_checkpoint(path, prefix)
    about = read_metadata(path)
    if about.get("model", model) != model:
        raise ValueError(f"{path} holds weights of {about['model']}, not of {model}")
    try:
        given = about["config"] if about else asdict(family.config_of(state))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    config = _config(family.config, {**given, **settings})
    template, extras = family.abstract(config), family.extras(config)
    return config, from_state_dict(state, template, extras, str(path), dtype)


def save_weights(
    path: Path,
    model: ModelName,
    config: Config,
    params: Params,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Writes variables as `.safetensors` under torch's names, with the configuration inside.

    Args:
      path: file to write.
      model: what the variables belong to.
      config: sizes of the model.
      params: its variables.
      training: where they come from, in JSON; for the file's header.

    Raises:
      ValueError: the file's ending is another.
    """
    state = to_state_dict(params, _FAMILIES[model].extras(config))
    about = {"model": model, "config": asdict(config)}
    write_checkpoint(path, state, {**about, "training": dict(training)} if training else about)


def _config(kind: type[Config], fields: Mapping[str, Any]) -> Config:
    fields = dict(fields)
    if isinstance(fields.get("encoder"), dict):
        fields["encoder"] = EncoderConfig(**fields["encoder"])
    try:
        return kind(**fields)
    except TypeError as error:
        raise ValueError(f"settings of {kind.__name__} do not fit: {error}") from None
