"""What the checks of the learned models share: weights, relative tolerances, gradients."""

import json
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from spdm_models.params import Params
from spdm_models.state_dict import Extras, flatten, from_state_dict

LOSS_TOLERANCE = 1e-5
"""Relative; the reference's own float32 error is 4e-7."""
GRADIENT_TOLERANCE = 1e-3
"""Of a tensor's largest entry, float32; the reference's own error is up to 1e-4."""
ROUNDING_SHARE = 1e-3
"""A tensor's gradient below this share of the norm of all is held to it."""
EXACT_TOLERANCE = 1e-9
"""Float64 against float64, relative to the largest entry."""


def load_weights(path: Path, template: Params, extras: Extras, dtype) -> Params:
    """Reads a state dict of a golden; every name and shape must fit."""
    with np.load(path) as data:
        state = {name: data[name] for name in data.files}
    return from_state_dict(state, template, extras, path.name, dtype)


def formula_weights(template: Params, seed: int, zero_rows: tuple[str, ...] = ()) -> dict:
    """Returns the weights that need no file, by name.

    Args:
      template: names and shapes.
      seed: of the recipe.
      zero_rows: names whose row 0 is zero.
    """
    weights = {}
    for name, leaf in flatten(template).items():
        shape = leaf.shape
        random = np.random.RandomState((zlib.crc32(name.encode()) ^ seed) & 0xFFFFFFFF)
        u = random.uniform(-1, 1, size=shape)
        if len(shape) >= 2:
            value = u * np.sqrt(3 / shape[1])
        elif name.endswith("weight"):
            value = 1 + 0.1 * u
        else:
            value = 0.1 * u
        weights[name] = value.astype(np.float32)
    for name in zero_rows:
        weights[name][0] = 0
    return weights


def check_recipe(report, file: str, weights: dict, data) -> None:
    """Compares names, shapes and sums of formula weights with the golden's."""
    names = [str(name) for name in data["param_names"]]
    report.equal(file, "parameter names", sorted(weights) == sorted(names), True)
    shapes = json.loads(str(data["param_shapes"])) if "param_shapes" in data.files else {}
    same = all(tuple(shape) == weights[name].shape for name, shape in shapes.items())
    report.equal(file, "parameter shapes", same, True)
    sums = [weights[name].astype(np.float64).sum() for name in names]
    report.close(file, "parameter sums", sums, data["param_sums"], 1e-9)


def close_relative(
    report, file, array, ours, reference, tolerance, mask=None, note="", least=1e-6
) -> None:
    """Compares with a tolerance in parts of the reference's largest entry, at least of `least`."""
    reference = np.asarray(reference, float)
    finite = np.abs(reference[np.isfinite(reference)])
    largest = max(float(finite.max()) if finite.size else 0.0, least)
    report.close(file, array, ours, reference, tolerance * largest, mask, note=note)


def close_gradients(
    report, file, prefix: str, norms: str, gradients: Params, data, tolerance: float
) -> None:
    """Compares the gradients of a golden with ours.

    Args:
      report: takes one row per tensor and one for all norms.
      file: name of the golden.
      prefix: of whole tensors in it, with the last slash.
      norms: prefix of norms of all tensors, with the last slash.
      gradients: like the weights.
      data: the golden's arrays.
      tolerance: of each tensor's largest entry.
    """
    flat = flatten(gradients)
    names = [key.removeprefix(norms) for key in data.files if key.startswith(norms)]
    reference = np.array([float(data[norms + name]) for name in names])
    # Gradients that are zero but for rounding have no relative error.
    floor = max(ROUNDING_SHARE * float(np.sqrt(np.sum(reference**2))), 1e-6)
    for key in data.files:
        if key.startswith(prefix):
            name = key.removeprefix(prefix)
            close_relative(report, file, key, flat[name], data[key], tolerance, least=floor)
    if names:
        ours = np.array([float(jnp.sqrt(jnp.sum(jnp.square(flat[name])))) for name in names])
        relative = (ours - reference) / np.maximum(reference, floor)
        report.close(file, f"{norms}*", relative, np.zeros_like(relative), tolerance)


NO_GRADIENT = ("in_proj_bias", "score.decode.3.bias")
"""Ends of names of parameters whose gradient is zero in theory, or is so in part: Adam scales the
rounding error there to whole steps."""


def close_parameters(report, file: str, weights: dict, data, rate: float) -> None:
    """Compares sums, norms and some whole arrays of the weights after five optimiser steps.

    Args:
      report: takes one row per kind.
      file: name of the golden.
      weights: by name.
      data: the golden's arrays.
      rate: learning rate; a whole step of single entries may differ in a sum.
    """
    names = [str(name) for name in data["param_names"]]
    counted = np.array([not name.endswith(NO_GRADIENT) for name in names])
    values = [np.asarray(weights[name], np.float64) for name in names]
    sums = np.array([value.sum() for value in values])
    norms = np.array([np.sqrt(np.sum(value**2)) for value in values])
    note = "without parameters whose gradient is only rounding"
    report.close(file, "param_sums", sums, data["param_sums"], 10 * rate, counted, note=note)
    report.close(file, "param_norms", norms, data["param_norms"], rate, counted, note=note)
    for key in data.files:
        name = key.removeprefix("final/")
        if key.startswith("final/") and name.endswith(NO_GRADIENT):
            report.not_compared(file, key, "its gradient is only rounding")
        elif key.startswith("final/"):
            report.close(file, key, weights[name], data[key], rate)


def arrays(data, prefix: str, names, dtype) -> dict[str, jax.Array]:
    """Returns some of a golden's arrays on the device."""
    return {name: jnp.asarray(data[prefix + name], dtype) for name in names}


def check_named(checks: Mapping[str, Callable[..., None]], path: Path, report: Any, dtype) -> bool:
    """Runs the check whose pattern is the file's whole name; returns whether there is one."""
    for pattern, check in checks.items():
        if match := re.fullmatch(pattern, path.stem):
            check(match, path, report, dtype)
            return True
    return False
