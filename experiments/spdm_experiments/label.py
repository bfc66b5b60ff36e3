"""`spdm label`: all sub-scores of one vocabulary in many scenes, into a folder to train from."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import Inventory, Shard, split
from spdm_experiments.label_folder import (
    FORMAT,
    clean,
    digest,
    open_folder,
    read_done,
    write_part,
)
from spdm_experiments.label_scene import COMPONENTS, Switches
from spdm_experiments.label_work import MEMORY, Chunk, Group, Labeller, index_row
from spdm_experiments.navsim_files import refuse_frames
from spdm_experiments.options import Label
from spdm_experiments.parts import part_name
from spdm_experiments.runtime import configure_jax, now, provenance
from spdm_experiments.sequence import Verb, go_on, usable_inventory
from spdm_experiments.work import Done
from spdm_jax import Failure, PlannerConfig
from spdm_jax.batching import ShapeGroup, group_by_shape
from spdm_jax.config import DT
from spdm_jax.labels import INDEX
from spdm_jax.padding import PATH_ROOM, bucket
from spdm_jax.trajectories import check_trajectories, resample

DTYPES = {"f16": np.dtype(np.float16), "f32": np.dtype(np.float32)}


def read_vocabulary(path: Path, dt: float) -> np.ndarray:
    """Reads a vocabulary.

    Args:
      path: .npy, or .npz with "trajectories".
      dt: spacing of its poses, s.

    Returns:
      `[V, 41, 3]` float64, ego frame, 0.1 s apart.

    Raises:
      ValueError: the file holds no such array.
    """
    values = stored_vocabulary(path)
    try:
        return resample(check_trajectories(values, dt, 1), dt)[0]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def stored_vocabulary(path: Path) -> np.ndarray:
    """Reads a vocabulary as it is stored, `[V, T, 3]` float64.

    Raises:
      ValueError: the file holds no such array.
    """
    try:
        content = np.load(path, allow_pickle=False)
        values = content if isinstance(content, np.ndarray) else content["trajectories"]
    except (ValueError, EOFError, KeyError) as error:
        raise ValueError(f"{path}: no .npy file of a plain array ({error})") from error
    if values.ndim != 3 or values.shape[-1] != 3 or not np.issubdtype(values.dtype, np.floating):
        raise ValueError(
            f"{path}: {values.dtype} {values.shape}; a vocabulary is [V, T, 3] of floating-point "
            "numbers, the same in every scenario. One set per scenario goes to: spdm score"
        )
    return values.astype(np.float64)


def parse_components(text: str) -> tuple[str, ...]:
    """Reads names between commas, or "all".

    Raises:
      ValueError: an unknown name, or one twice.
    """
    if text == "all":
        return COMPONENTS
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in COMPONENTS:
            raise ValueError(
                f"--components: no component {name!r}; there are all, {', '.join(COMPONENTS)}"
            )
    if len(set(names)) < len(names):
        raise ValueError(f"--components is {text!r}; name each one once")
    return names


def run_label(options: Label) -> bool:
    """Labels what is not yet labelled; returns False if a scenario of the shard failed.

    Raises:
      ValueError: options or files are of no use, or the folder holds other labels.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    shard = Shard.parse(options.shard)
    if options.chunk < 1:
        raise ValueError(f"--chunk is {options.chunk}; it must be at least 1")
    if options.profile != "tuplan":
        from spdm_experiments.navsim_label import run_navsim_label

        return run_navsim_label(options, shard)
    labeller = Labeller(
        read_vocabulary(options.vocabulary, DT if options.dt is None else options.dt),
        parse_components(options.components),
        DTYPES[options.dtype],
        options.precision,
    )
    files = scenario_files(options.scenes, options.limit)
    refuse_frames(options.scenes, files)
    inventory = usable_inventory(files, options.scenes)
    configure_jax(options)
    return go_on(LabelRun(options, labeller, inventory), inventory, shard)


class LabelRun(Verb):
    """One folder of labels."""

    def __init__(self, options: Label, labeller: Labeller, inventory: Inventory):
        """Puts it together."""
        self.folder, self.rows, self.origin = options.out, options.out / INDEX, provenance()
        self._options, self._labeller, self._inventory = options, labeller, inventory

    def open(self) -> list[str]:
        """See `Verb`."""
        options, labeller, inventory = self._options, self._labeller, self._inventory
        sources = sorted({entry.source for entry in inventory.entries})
        about = {
            "format": FORMAT,
            "command": "label",
            "components": list(labeller.components),
            "dtype": labeller.dtype.name,
            "vocabulary": {
                "hash": digest(labeller.vocabulary),
                "shape": list(labeller.vocabulary.shape),
            },
            "vocabulary_file": str(options.vocabulary),
            "suite": suite_name(options.scenes, sources),
            "scenes": str(options.scenes),
            "num_scenarios": len(inventory),
            "input_hash": inventory.digest,
            "precision": options.precision,
            "config": {
                "tracker": options.tracker,
                "forecast": options.forecast,
                "progress_reference": options.progress_reference,
            },
            **self.origin,
            "created": now(),
        }
        return open_folder(self.folder, about, labeller.vocabulary)

    def clean(self, shard: Shard) -> None:
        """See `Verb`."""
        clean(self.folder, shard)

    def read_done(self) -> tuple[dict[str, str], list[str]]:
        """See `Verb`."""
        labeller = self._labeller
        shape = (len(labeller.vocabulary), len(labeller.components))
        return read_done(self.folder, shape, labeller.dtype)

    def write_unusable(self, name: str, failures: Sequence[Failure]) -> None:
        """See `Verb`."""
        labeller = self._labeller
        none = np.zeros((0, len(labeller.vocabulary), len(labeller.components)), labeller.dtype)
        write_part(self.folder, name, none, [index_row(f, None, "failed") for f in failures])

    def run(self, shard: Shard, missing: set[str], stop: Callable[[], bool]) -> Iterator[Done]:
        """See `Verb`. A chunk comes in pieces that fit into memory."""
        labeller = self._labeller
        labels: list[np.ndarray] = []
        rows: list[dict[str, Any]] = []
        before, load_s = labeller.counters(), 0.0
        for piece in labeller.load(list(self._chunks(shard, missing))):
            mine, index = labeller.score(piece)
            labels.append(mine)
            rows += index
            piece.scenes.release()
            load_s += piece.seconds
            if not piece.last:
                continue
            started = time.perf_counter()
            write_part(self.folder, piece.chunk.name, np.concatenate(labels), rows)
            counters = labeller.counters()
            spent = lambda name, now=counters, then=before: now[name] - then[name]
            yield Done(
                piece.chunk.name,
                {row["token"]: row["reason"] for row in rows},
                spent("programs"),
                {
                    "load": load_s,
                    "compile": spent("compile_s"),
                    "run": spent("run_s"),
                    "write": time.perf_counter() - started,
                },
                counters["messages"][len(before["messages"]) :],
            )
            labels, rows, before, load_s = [], [], counters, 0.0
            if stop():
                return

    def _chunks(self, shard: Shard, missing: set[str]) -> Iterator[Chunk]:
        inventory = self._inventory
        for number, found in enumerate(group_by_shape([e.sizes for e in inventory.entries])):
            group = self._group(found)
            entries = [inventory.entries[row] for row in found.rows]
            entries = [entry for entry in entries if entry.token in missing]
            for rows in split(len(entries), self._options.chunk):
                mine = [entries[i] for i in rows]
                name = part_name(shard.name, f"g{number}", [entry.token for entry in mine])
                yield Chunk(name, group, mine)

    def _group(self, found: ShapeGroup) -> Group:
        options, labeller = self._options, self._labeller
        points = max(self._inventory.entries[row].route_points for row in found.rows)
        config = PlannerConfig(
            tracker="reference" if options.tracker == "none" else options.tracker,
            forecast=options.forecast,
            progress_reference=options.progress_reference,
            max_path_points=bucket(points, PATH_ROOM),
        )
        piece = max(1, MEMORY // labeller.bytes_per_scene(found.padding))
        return Group(found.padding, Switches(config, options.tracker != "none"), piece)

    def tell(self) -> None:
        """See `Verb`."""
        labeller = self._labeller
        size, components = len(labeller.vocabulary), len(labeller.components)
        print(f"per scenario: {size} trajectories x {components} components, {labeller.dtype}")
