"""The state of a training, in one file that is whole or absent."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from flax import struct

from spdm_jax.types import Array

from .checkpoint import read_checkpoint, read_metadata, write_checkpoint
from .params import Params

FORMAT = 1


class TrainState(struct.PyTreeNode, kw_only=True):
    """What a training step changes.

    Attributes:
      params: what is trained.
      optimizer: its state.
      step: `[]` int32 steps done.
      key: `[2]` uint32 data of the random key; step numbers are folded into it.
    """

    params: Params
    optimizer: optax.OptState
    step: Array
    key: Array


@dataclass
class Log:
    """What a training has measured so far.

    Attributes:
      columns: of `losses`; the first is the loss.
      losses: `[S, C]`, one row per step.
      metrics: of `validation`; the first is the number of steps done.
      validation: `[E, M]` m, one row per epoch.
    """

    columns: tuple[str, ...] = ()
    losses: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    metrics: tuple[str, ...] = ()
    validation: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def add_losses(self, columns: tuple[str, ...], rows: np.ndarray) -> None:
        """Appends steps."""
        self.columns, self.losses = columns, _appended(self.losses, rows)

    def add_validation(self, step: int, metrics: Mapping[str, float]) -> None:
        """Appends an epoch."""
        self.metrics = ("step", *metrics)
        row = np.array([[step, *metrics.values()]], np.float32)
        self.validation = _appended(self.validation, row)


def _appended(rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    return np.concatenate([rows, new]) if len(rows) else new


def write_state(path: Path, state: TrainState, log: Log, about: Mapping[str, Any]) -> None:
    """Writes a checkpoint; an existing one is replaced at once.

    Args:
      path: a `.safetensors` file.
      state: of the training.
      log: what was measured.
      about: what is trained on what, in JSON; a training goes on only if it is the same.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named(state).items()}
    arrays |= {"log.losses": log.losses, "log.validation": log.validation}
    notes = {"format": FORMAT, "columns": log.columns, "metrics": log.metrics, "about": about}
    write_checkpoint(path, arrays, notes)


def read_state(
    path: Path, template: TrainState, about: Mapping[str, Any]
) -> tuple[TrainState, Log]:
    """Reads a checkpoint.

    Args:
      path: the file.
      template: a state of the same training, for its structure and shapes.
      about: what this training is.

    Raises:
      ValueError: the file is no such checkpoint, or is of another training; names what differs.
    """
    notes = read_metadata(path)
    if notes.get("format") != FORMAT:
        raise ValueError(f"{path}: no checkpoint of a training; use another folder")
    for name in {**notes["about"], **about}:
        there, here = notes["about"].get(name), about.get(name)
        if there != here:
            raise ValueError(
                f"{path} is of a training with {name} = {there}, this one has {here}. Use another "
                "folder, or the settings of that training"
            )
    arrays = read_checkpoint(path)
    for name, leaf in _named(template).items():
        shape = np.shape(arrays[name]) if name in arrays else "nothing"
        if shape != np.shape(leaf):
            raise ValueError(f"{path}: {name} has {shape}, expected shape {np.shape(leaf)}")
    leaves = [arrays[name] for name in _named(template)]
    log = Log(
        tuple(notes["columns"]), arrays["log.losses"], tuple(notes["metrics"]),
        arrays["log.validation"],
    )  # fmt: skip
    return jax.tree.unflatten(jax.tree.structure(template), leaves), log


def _named(state: TrainState) -> dict[str, Any]:
    """Leaves by their place, in the order of the tree."""
    found = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in found}
