"""`spdm label` with one of NAVSIM's profiles."""

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import Entry, Inventory, Shard, split
from spdm_experiments.label import DTYPES, stored_vocabulary
from spdm_experiments.label_folder import FORMAT, clean, digest, open_folder, read_done, write_part
from spdm_experiments.label_work import index_row
from spdm_experiments.navsim_files import (
    common_padding,
    frame_inventory,
    load_frames,
    refuse_foreign,
)
from spdm_experiments.options import Label
from spdm_experiments.parts import part_name
from spdm_experiments.record import REASONS
from spdm_experiments.runtime import Clock, configure_jax, now, provenance
from spdm_experiments.sequence import Verb, go_on
from spdm_experiments.work import Done
from spdm_jax import Failure, NavsimScoreSet, NavsimSet
from spdm_jax.batching import prefetch
from spdm_jax.labels import INDEX
from spdm_jax.navsim.evaluate import navsim_poses, pose_interval, score_frames
from spdm_jax.navsim.results import TERMS, component
from spdm_jax.scoring.profile import Profile, profile_named
from spdm_jax.trajectories import check_trajectories

PIECE = 16
"""Frames in memory at a time."""


def components_of(profile: Profile, text: str) -> tuple[str, ...]:
    """Reads names between commas, or "all".

    Raises:
      ValueError: an unknown name, or one twice.
    """
    # A vocabulary has no plan of the frame before.
    terms = [name for name in TERMS if profile.judges(name) and name != "extended_comfort"]
    known = ("total", *terms, "progress_raw")
    if text == "all":
        return known
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in known:
            raise ValueError(
                f"--components: no component {name!r} in {profile.name}; there are all, "
                f"{', '.join(known)}"
            )
    if len(set(names)) < len(names):
        raise ValueError(f"--components is {text!r}; name each one once")
    return names


def run_navsim_label(options: Label, shard: Shard) -> bool:
    """Labels what is not yet labelled; returns False if a frame of the shard failed.

    Raises:
      ValueError: options or files are of no use, or the folder holds other labels.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    refuse_foreign(options)
    profile = profile_named(options.profile)
    components = components_of(profile, options.components)
    values = stored_vocabulary(options.vocabulary)
    try:
        dt = pose_interval(values.shape, options.dt)
        vocabulary = navsim_poses(check_trajectories(values, dt, 1), dt)[0]
    except ValueError as error:
        raise ValueError(f"{options.vocabulary}: {error}") from error
    inventory = frame_inventory(scenario_files(options.scenes, options.limit), profile)
    configure_jax(options)
    run = NavsimLabelRun(options, profile, vocabulary, components, inventory)
    return go_on(run, inventory, shard)


class NavsimLabelRun(Verb):
    """One folder of labels."""

    def __init__(
        self,
        options: Label,
        profile: Profile,
        vocabulary: np.ndarray,
        components: tuple[str, ...],
        inventory: Inventory,
    ):
        """Puts it together.

        Args:
          options: of the command.
          profile: whose score.
          vocabulary: `[V, 8, 3]` as it is scored.
          components: what a label holds.
          inventory: all frames.
        """
        self.folder, self.rows, self.origin = options.out, options.out / INDEX, provenance()
        self._options, self._profile, self._inventory = options, profile, inventory
        self._vocabulary, self._components = vocabulary, components
        self._dtype = DTYPES[options.dtype]

    def open(self) -> list[str]:
        """See `Verb`."""
        options, inventory = self._options, self._inventory
        about = {
            "format": FORMAT,
            "command": "label",
            "components": list(self._components),
            "dtype": self._dtype.name,
            "vocabulary": {
                "hash": digest(self._vocabulary),
                "shape": list(self._vocabulary.shape),
            },
            "vocabulary_file": str(options.vocabulary),
            "suite": suite_name(
                options.scenes, sorted({entry.source for entry in inventory.entries})
            ),
            "scenes": str(options.scenes),
            "num_scenarios": len(inventory),
            "input_hash": inventory.digest,
            "precision": options.precision,
            "config": {"profile": self._profile.name},
            **self.origin,
            "created": now(),
        }
        return open_folder(self.folder, about, self._vocabulary)

    def clean(self, shard: Shard) -> None:
        """See `Verb`."""
        clean(self.folder, shard)

    def read_done(self) -> tuple[dict[str, str], list[str]]:
        """See `Verb`."""
        return read_done(self.folder, (len(self._vocabulary), len(self._components)), self._dtype)

    def write_unusable(self, name: str, failures: Sequence[Failure]) -> None:
        """See `Verb`."""
        rows = [index_row(failure, None, "failed") for failure in failures]
        write_part(self.folder, name, self._none(), rows)

    def _none(self) -> np.ndarray:
        return np.zeros((0, len(self._vocabulary), len(self._components)), self._dtype)

    def run(self, shard: Shard, missing: set[str], stop: Callable[[], bool]) -> Iterator[Done]:
        """See `Verb`."""
        entries = [entry for entry in self._inventory.entries if entry.token in missing]
        padding = common_padding(self._inventory.entries)
        load = lambda piece: load_frames(piece, self._profile, self._options.precision, padding)
        for rows in split(len(entries), self._options.chunk):
            mine, clock = [entries[i] for i in rows], Clock()
            labels, index = [self._none()], []
            pieces = [[mine[i] for i in piece] for piece in split(len(mine), PIECE)]
            for frames in prefetch(load, pieces, threads=1):
                index += self._failed(frames, mine)
                if len(frames):
                    with clock.computing():
                        result = score_frames(
                            frames,
                            self._vocabulary,
                            self._profile,
                            precision=self._options.precision,
                        )
                    found, good = self._pick(result, mine)
                    labels.append(found)
                    index += good
            started = time.perf_counter()
            name = part_name(shard.name, "frames", [entry.token for entry in mine])
            write_part(self.folder, name, np.concatenate(labels), index)
            yield Done(
                name,
                {row["token"]: row["reason"] for row in index},
                seconds={
                    "compile": clock.compile,
                    "run": clock.run,
                    "write": time.perf_counter() - started,
                },
            )
            if stop():
                return

    def _failed(self, frames: NavsimSet, entries: Sequence[Entry]) -> list[dict]:
        by_token = {entry.token: entry for entry in entries}
        return [index_row(f, by_token.get(f.token), "failed") for f in frames.failures]

    def _pick(
        self, result: NavsimScoreSet, entries: Sequence[Entry]
    ) -> tuple[np.ndarray, list[dict]]:
        """Returns labels `[n, V, C]` of the frames that have any, and all rows of the index."""
        by_token = {entry.token: entry for entry in entries}
        columns = [component(result.scores, name) for name in self._components]
        with np.errstate(over="ignore"):  # beyond float16: not finite, which is looked for below
            labels = np.stack(columns, axis=-1).astype(self._dtype)
        finite = np.isfinite(labels.reshape(len(labels), -1)).all(axis=1)
        rows = []
        for info, ok in zip(result.infos, np.asarray(finite), strict=True):
            reason = "" if ok else REASONS["failed"]
            status = "ok" if ok else "failed"
            rows.append(index_row(Failure(info.token, reason), by_token[info.token], status))
        return labels[finite], rows

    def tell(self) -> None:
        """See `Verb`."""
        size, components = len(self._vocabulary), len(self._components)
        print(
            f"per frame: {size} trajectories x {components} components of {self._profile.name}, "
            f"{self._dtype}"
        )
