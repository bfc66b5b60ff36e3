"""Torch state dicts (flat, by name) to the variables of a module and back; nothing goes unseen."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.typing import DTypeLike

from .params import Params

LISTED_PROBLEMS = 12
# Names of arrays that a checkpoint holds beside the weights and that training leaves alone.
BUFFER_NAMES = frozenset({"pe", "scale", "constraint"})


@dataclass(frozen=True)
class Extras:
    """What a torch state dict holds beside the variables of the module.

    Attributes:
      aliases: prefixes of modules that are shared, each with the prefix under which the module's
        variables are kept; torch lists them under every name.
      constants: arrays that follow from the configuration.
    """

    aliases: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)


def flatten(params: Params) -> dict[str, Any]:
    """Returns the leaves by their names (`point_net.0.weight`)."""
    return dict(_named(params, ""))


def _named(params: Params, prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in params.items():
        if isinstance(value, dict):
            yield from _named(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def unflatten(flat: Mapping[str, Any], template: Params) -> Params:
    """Returns a tree like `template` with the leaves of `flat`, which must have all its names."""
    return _filled(template, flat, "")


def _filled(template: Params, flat: Mapping[str, Any], prefix: str) -> Params:
    return {
        key: _filled(value, flat, f"{prefix}{key}.")
        if isinstance(value, dict)
        else flat[f"{prefix}{key}"]
        for key, value in template.items()
    }


def trainable(params: Params) -> Params:
    """Returns a tree of bools, False at the buffers: the mask of an optimiser's weight decay."""
    names = {name: name.split(".")[-1] not in BUFFER_NAMES for name in flatten(params)}
    return unflatten(names, params)


def from_state_dict(
    state: Mapping[str, np.ndarray],
    template: Params,
    extras: Extras | None = None,
    source: str = "state dict",
    dtype: DTypeLike = np.float32,
) -> Params:
    """Returns the variables that a state dict holds.

    Args:
      state: arrays by torch's names.
      template: shapes of the module's variables (`params.abstract_params`).
      extras: what else the state dict holds. Shared modules may be listed once or under every
        name; constants may be missing.
      source: where the state dict is from, for errors.
      dtype: of the result.

    Raises:
      ValueError: a key is missing, unknown, of another shape or not finite, or a shared module or
        a constant has another value than it must have; all such keys are named.
    """
    extras = extras or Extras()
    wanted = flatten(template)
    problems: list[str] = []
    kept: dict[str, np.ndarray] = {}
    for name, given in state.items():
        value = np.asarray(given)
        owner = _owner(name, extras)
        if name in wanted:
            problem = _problem(value, wanted[name].shape)
            if problem is None:
                kept[name] = value.astype(dtype)
        elif name in extras.constants:
            same = np.array_equal(value, extras.constants[name])
            problem = None if same else "differs from what this configuration gives"
        elif owner in wanted:
            same = owner in state and np.array_equal(value, state[owner], equal_nan=True)
            problem = None if same else f"must be the same as {owner} (one shared module)"
        else:
            problem = "is unknown to this model"
        if problem is not None:
            problems.append(f"{name} {problem}")
    problems += [f"{name} is missing" for name in wanted if name not in state]
    if problems:
        listed = "\n  ".join(problems[:LISTED_PROBLEMS])
        more = len(problems) - LISTED_PROBLEMS
        tail = f"\n  and {more} more" if more > 0 else ""
        raise ValueError(
            f"{source} does not fit the model: {len(problems)} keys\n  {listed}{tail}\n"
            "Check the model's name and configuration against those of the training run."
        )
    return jax.device_put(unflatten(kept, template))


def to_state_dict(params: Params, extras: Extras | None = None) -> dict[str, np.ndarray]:
    """Returns every array under torch's names, shared modules under each of their names."""
    extras = extras or Extras()
    state = {name: np.asarray(value) for name, value in flatten(params).items()}
    shared = {
        alias + name.removeprefix(owner): value
        for alias, owner in extras.aliases.items()
        for name, value in state.items()
        if name.startswith(f"{owner}.")
    }
    return state | shared | {name: np.asarray(v) for name, v in extras.constants.items()}


def _owner(name: str, extras: Extras) -> str:
    for alias, owner in extras.aliases.items():
        if name.startswith(f"{alias}."):
            return owner + name.removeprefix(alias)
    return name


def _problem(value: np.ndarray, shape: tuple[int, ...]) -> str | None:
    if value.shape != shape:
        return f"has shape {value.shape}, expected {shape}"
    if not np.issubdtype(value.dtype, np.floating):
        return f"has dtype {value.dtype}, expected floating point"
    if not np.all(np.isfinite(value)):
        return f"holds {np.sum(~np.isfinite(value))} values that are not finite"
    return None
