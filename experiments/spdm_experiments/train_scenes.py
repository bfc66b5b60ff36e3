"""From the scenarios of `spdm train` to samples in memory."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.chunks import scenario_files
from spdm_experiments.inventory import Entry, Inventory, split, take_inventory
from spdm_experiments.packed_suites import packed_suite
from spdm_experiments.terminal import progress_line
from spdm_experiments.train_options import Train
from spdm_jax import Failure, load
from spdm_jax.batching import group_by_shape, prefetch
from spdm_jax.config import DT
from spdm_jax.io.raw import ScenarioError
from spdm_jax.padding import PaddingConfig
from spdm_jax.synthetic import suites
from spdm_models.train_data import (
    SampleConfig,
    SampleMaker,
    TrainSample,
    concatenate,
    count,
    from_leaves,
    leaves_of,
    take,
)

CHUNK = 16
"""Scenarios that are in memory together."""
WASTE = 4.0
"""How much larger than need be a scenario may become to share a program."""
_ABOUT, _TOKEN = "about", "token"


@dataclass(frozen=True)
class Samples:
    """Samples of a training.

    Attributes:
      train: to learn from.
      held_out: of other scenarios, to test on; None without any.
      failures: scenarios that could not be read, and why.
      unused: scenarios that have no sample, and why.
    """

    train: TrainSample
    held_out: TrainSample | None
    failures: list[Failure]
    unused: list[Failure]


def find_scenes(options: Train) -> Inventory:
    """Returns the scenarios that the options name; packs a suite's scenes that are missing.

    Raises:
      ValueError: there is no such suite or folder, or nothing in it can be used.
    """
    for name in ("per_type", "limit"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; it must be at least 1")
    if not options.scenes:
        raise ValueError("SCENES is missing: name a folder of scenario files or a suite")
    files = [path for name in options.scenes for path in _files(name, options)]
    inventory = take_inventory(files)
    if not inventory.entries:
        raise ScenarioError(f"{files[0]}: no usable scenario: {inventory.failures[0].reason}")
    return inventory


def _files(name: str, options: Train) -> list[Path]:
    if name in suites.suite_names() and not Path(name).exists():
        # The first scenes are the suite proper, which trained planners are tested on.
        first = suites.SCENES_PER_TYPE
        reader = suites.SuiteReader(name, range(first, first + options.per_type))
        tokens = reader.tokens()[: options.limit]
        folder = packed_suite(reader, name, tokens)
        return [folder / f"{token}.npz" for token in tokens]
    try:
        return scenario_files(Path(name), options.limit)
    except ValueError as error:
        names = ", ".join(suites.suite_names())
        raise ValueError(f"{error}. The built-in suites are {names}") from error


def make_samples(inventory: Inventory, config: SampleConfig, options: Train) -> Samples:
    """Computes all samples, or reads them from the file that the options name.

    Raises:
      ValueError: no scenario gives a sample, or the file holds other samples.
    """
    if not 0 <= options.held_out < 1:
        raise ValueError(f"--held-out is {options.held_out}; it must be in [0, 1)")
    stride = round(options.stride / DT)
    about = {"scenes": inventory.digest, "config": repr(config), "stride": stride}
    failures = list(inventory.failures)
    unused: list[Failure] = []
    path = options.samples
    if path is not None and path.exists():
        samples, tokens = _read(path, about, config)
    else:
        samples, tokens, failed, unused = _compute(inventory.entries, config, stride)
        failures += failed
        if path is not None:
            _write(path, about, samples, tokens)
    held = _held_out(sorted(set(tokens.tolist())), options.held_out)
    kept = np.isin(tokens, sorted(held))
    return Samples(
        train=take(samples, np.flatnonzero(~kept)),
        held_out=take(samples, np.flatnonzero(kept)) if held else None,
        failures=failures,
        unused=unused,
    )


def _held_out(tokens: Sequence[str], share: float) -> set[str]:
    """Picks scenarios by their names alone; at least one is left to learn from."""
    number = min(round(share * len(tokens)) or int(share > 0), len(tokens) - 1)
    order = sorted(tokens, key=lambda token: hashlib.sha256(token.encode()).digest())
    return set(order[:number])


def _compute(
    entries: Sequence[Entry], config: SampleConfig, stride: int
) -> tuple[TrainSample, np.ndarray, list[Failure], list[Failure]]:
    maker = SampleMaker(config, stride)
    groups = group_by_shape([entry.sizes for entry in entries], waste=WASTE)
    jobs = [
        ([entries[group.rows[i]].path for i in part], group.padding)
        for group in groups
        for part in split(len(group.rows), CHUNK)
    ]
    parts: list[TrainSample] = []
    tokens: list[np.ndarray] = []
    failures: list[Failure] = []
    unused: list[Failure] = []
    done = 0
    with progress_line("samples", len(entries)) as advance:
        for scenes in prefetch(_load, jobs):
            samples, rows = maker(scenes.batch)
            names = np.array([info.token for info in scenes.infos])
            parts.append(samples)
            tokens.append(names[rows])
            failures += scenes.failures
            lacking = sorted(set(names.tolist()) - set(names[rows].tolist()))
            unused += [Failure(token, _lacking(config)) for token in lacking]
            done += len(names) + len(scenes.failures)
            advance(done)
    found = concatenate(parts)
    if count(found) == 0:
        first = (unused or failures)[0]
        raise ValueError(f"no scenario can be learnt from: {first.token}: {first.reason}")
    return found, np.concatenate(tokens), failures, unused


def _load(job: tuple[list[Path], PaddingConfig]):
    paths, padding = job
    return load(paths, padding=padding)


def _lacking(config: SampleConfig) -> str:
    reason = f"no start time with {config.steps * DT:g} s of the ego's future on record"
    if config.inputs == "dtpp":
        return f"{reason} and a tree of paths along the route that comes near it"
    return reason if config.inputs == "gameformer" else f"{reason} and a route"


def _write(path: Path, about: dict[str, Any], samples: TrainSample, tokens: np.ndarray) -> None:
    arrays: dict[str, Any] = {**leaves_of(samples), _TOKEN: tokens}
    arrays[_ABOUT] = np.array(json.dumps(about))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        np.savez(file, **arrays)
    part.replace(path)


def _read(
    path: Path, about: dict[str, Any], config: SampleConfig
) -> tuple[TrainSample, np.ndarray]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            arrays = dict(data)
        there = json.loads(str(arrays.pop(_ABOUT)))
        tokens = arrays.pop(_TOKEN)
        samples = from_leaves(arrays, config.inputs)
    except (ValueError, OSError, EOFError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds no samples of {config.inputs} ({error})") from error
    if changed := [name for name in about if there.get(name) != about[name]]:
        raise ValueError(
            f"--samples {path}: was made with other {', '.join(changed)}; remove it, or name "
            "another file"
        )
    return samples, tokens
