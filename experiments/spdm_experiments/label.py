"""`spdm label`: all sub-scores of one vocabulary in many scenes, into a folder to train from."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import Inventory, Shard, split, take_inventory
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
from spdm_experiments.options import Label
from spdm_experiments.parts import part_name
from spdm_experiments.run_folder import Progress, alone, note
from spdm_experiments.runtime import configure_jax, now, provenance, stop_between_chunks
from spdm_experiments.terminal import RateLine, print_files, reasons
from spdm_jax import PlannerConfig
from spdm_jax.batching import ShapeGroup, group_by_shape
from spdm_jax.io.raw import ScenarioError
from spdm_jax.labels import INDEX
from spdm_jax.padding import PATH_ROOM, bucket
from spdm_jax.trajectories import check_trajectories, resample

DTYPES = {"f16": np.dtype(np.float16), "f32": np.dtype(np.float32)}


@dataclass
class Tally:
    """What is done.

    Attributes:
      done: token -> reason, "" for scenes with labels.
      scenes: of them, those done by this process.
      load_s, write_s: seconds of this process.
    """

    done: dict[str, str]
    scenes: int = 0
    load_s: float = 0.0
    write_s: float = 0.0

    def counts(self, total: int) -> dict[str, Any]:
        """Returns how far the shard is."""
        failed = sum(bool(reason) for reason in self.done.values())
        counts = {"scenarios": total, "done": len(self.done), "failed": failed}
        return {**counts, "finished": len(self.done) == total}


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
    try:
        return resample(check_trajectories(values.astype(np.float64), dt, 1), dt)[0]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


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
    labeller = Labeller(
        read_vocabulary(options.vocabulary, options.dt),
        parse_components(options.components),
        DTYPES[options.dtype],
        options.precision,
    )
    inventory = take_inventory(scenario_files(options.scenes, options.limit))
    if not inventory.entries:
        raise ScenarioError(f"{options.scenes}: no usable scenario: {inventory.failures[0].reason}")
    configure_jax(options)
    origin = provenance()
    about = _about(options, labeller, inventory, origin)
    note(open_folder(options.out, about, labeller.vocabulary))
    with alone(options.out, shard):
        clean(options.out, shard)
        shape = (len(labeller.vocabulary), len(labeller.components))
        done, notes = read_done(options.out, shape, labeller.dtype)
        note(notes)
        tokens = [e.token for e in inventory.entries] + [f.token for f in inventory.failures]
        mine = {token for token in tokens if shard.holds(token)}
        tally = Tally({token: reason for token, reason in done.items() if token in mine})
        missing = mine - tally.done.keys()
        if missing:
            _write_unusable(options.out, labeller, inventory, shard, missing, tally)
            chunks = list(_chunks(options, labeller, inventory, shard, missing))
            progress = Progress(options.out, shard, origin)
            _work(options.out, labeller, chunks, tally, progress, len(mine))
        return _close(options, labeller, tally, len(mine), bool(missing))


def _about(
    options: Label, labeller: Labeller, inventory: Inventory, origin: dict[str, object]
) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "command": "label",
        "components": list(labeller.components),
        "dtype": labeller.dtype.name,
        "vocabulary": {
            "hash": digest(labeller.vocabulary),
            "shape": list(labeller.vocabulary.shape),
        },
        "vocabulary_file": str(options.vocabulary),
        "suite": suite_name(options.scenes, sorted({entry.source for entry in inventory.entries})),
        "scenes": str(options.scenes),
        "num_scenarios": len(inventory),
        "input_hash": inventory.digest,
        "precision": options.precision,
        "config": {
            "tracker": options.tracker,
            "forecast": options.forecast,
            "progress_reference": options.progress_reference,
        },
        **origin,
        "created": now(),
    }


def _chunks(
    options: Label, labeller: Labeller, inventory: Inventory, shard: Shard, missing: set[str]
) -> Iterator[Chunk]:
    for number, found in enumerate(group_by_shape([entry.sizes for entry in inventory.entries])):
        group = _group(options, labeller, inventory, found)
        entries = [inventory.entries[row] for row in found.rows]
        entries = [entry for entry in entries if entry.token in missing]
        for rows in split(len(entries), options.chunk):
            mine = [entries[i] for i in rows]
            name = part_name(shard.name, f"g{number}", [entry.token for entry in mine])
            yield Chunk(name, group, mine)


def _group(options: Label, labeller: Labeller, inventory: Inventory, found: ShapeGroup) -> Group:
    points = max(inventory.entries[row].route_points for row in found.rows)
    config = PlannerConfig(
        tracker="reference" if options.tracker == "none" else options.tracker,
        forecast=options.forecast,
        progress_reference=options.progress_reference,
        max_path_points=bucket(points, PATH_ROOM),
    )
    piece = max(1, MEMORY // labeller.bytes_per_scene(found.padding))
    return Group(found.padding, Switches(config, options.tracker != "none"), piece)


def _write_unusable(
    folder: Path,
    labeller: Labeller,
    inventory: Inventory,
    shard: Shard,
    missing: set[str],
    tally: Tally,
) -> None:
    """Notes files that cannot be read in the index."""
    failures = [failure for failure in inventory.failures if failure.token in missing]
    if failures:
        name = part_name(shard.name, "unusable", [failure.token for failure in failures])
        none = np.zeros((0, len(labeller.vocabulary), len(labeller.components)), labeller.dtype)
        write_part(folder, name, none, [index_row(f, None, "failed") for f in failures])
        tally.done |= {failure.token: failure.reason for failure in failures}


def _work(
    folder: Path,
    labeller: Labeller,
    chunks: Sequence[Chunk],
    tally: Tally,
    progress: Progress,
    total: int,
) -> None:
    line = RateLine(total, len(tally.done))

    def save() -> None:
        seconds = {"load_s": round(tally.load_s, 3), "write_s": round(tally.write_s, 3)}
        work = {"scenarios": tally.scenes, **seconds, **labeller.counters()}
        progress.save(tally.counts(total), work)

    with stop_between_chunks() as stopping:
        line.show(len(tally.done), 0.0, 0, 0.0)
        save()
        labels, rows = [], []
        for piece in labeller.load(chunks):
            mine, index = labeller.score(piece)
            labels.append(mine)
            rows += index
            piece.scenes.release()
            tally.load_s += piece.seconds
            if piece.last:
                started = time.perf_counter()
                write_part(folder, piece.chunk.name, np.concatenate(labels), rows)
                tally.write_s += time.perf_counter() - started
                tally.scenes += len(rows)
                tally.done |= {row["token"]: row["reason"] for row in rows}
                save()
                counters = labeller.counters()
                compile_s = counters["compile_s"]
                line.show(len(tally.done), compile_s, counters["programs"], compile_s)
                labels, rows = [], []
                if stopping():
                    break
    line.close()
    note(labeller.counters()["messages"])


def _close(options: Label, labeller: Labeller, tally: Tally, total: int, worked: bool) -> bool:
    """Prints the outcome.

    Raises:
      KeyboardInterrupt: scenarios are missing because the user stopped the run.
    """
    counts = tally.counts(total)
    whose = "" if options.shard == "1/1" else f" of shard {options.shard}"
    size = len(labeller.vocabulary)
    what = f"{size} trajectories x {len(labeller.components)} components, {labeller.dtype}"
    if counts["finished"] and not worked:
        print(f"all {total} scenarios{whose} were done already, {counts['failed']} failed")
    else:
        print(f"{counts['done']} of {total} scenarios{whose} done, {counts['failed']} failed")
        found = labeller.counters()
        print(
            f"load {tally.load_s:.1f} s, compile {found['compile_s']:.1f} s, "
            f"run {found['run_s']:.1f} s, write {tally.write_s:.1f} s"
        )
    print(f"per scenario: {what}")
    failed = {token: reason for token, reason in tally.done.items() if reason}
    for reason in reasons(failed, options.out / INDEX):
        print(reason)
    print_files([options.out])
    if not counts["finished"]:
        raise KeyboardInterrupt
    return not counts["failed"]
