"""The work of `spdm label` on some scenes: load them, place the vocabulary, score it."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spdm_experiments.inventory import Entry, split
from spdm_experiments.label_scene import Part, Scored, Switches, join, place, score_part
from spdm_experiments.loading import LoadedScenes, Loader
from spdm_experiments.record import REASONS
from spdm_experiments.sweep_scene import UNREAD
from spdm_jax import Failure, PlannerParams
from spdm_jax.batching import BatchConfig, Precision, SceneRunner, padded_bytes, prefetch
from spdm_jax.config import NUM_STATES
from spdm_jax.padding import PaddingConfig, bucket
from spdm_jax.scene_score import BLOCK_SIZES
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import ScenarioBatch

MEMORY = 64 * 2**20
"""Bytes that the scenes of one piece and their trajectories may take; three are in memory."""


@dataclass(frozen=True)
class Group:
    """Scenes of one shape.

    Attributes:
      padding: one size per axis.
      switches: static settings of their program.
      piece: scenes in memory at a time.
    """

    padding: PaddingConfig
    switches: Switches
    piece: int


@dataclass(frozen=True)
class Chunk:
    """Scenes that make one part of the folder.

    Attributes:
      name: of the part.
      group: their shape.
      entries: their files.
    """

    name: str
    group: Group
    entries: Sequence[Entry]


@dataclass
class Piece:
    """Some scenes of a chunk, in memory.

    Attributes:
      chunk: what they are part of.
      last: no further piece of the chunk follows.
      scenes: the files that could be read, and the others.
      parts: their trajectories `[n * parts, P, ...]`, or None where no file could be read.
      seconds: what loading took.
    """

    chunk: Chunk
    last: bool
    scenes: LoadedScenes
    parts: Part | None
    seconds: float


@dataclass
class Labeller:
    """Scores one vocabulary, scene after scene.

    Attributes:
      vocabulary: `[V, 41, 3]`, ego frame, float64.
      components: what a label holds.
      dtype: of labels.
      precision: of all computation.
    """

    vocabulary: np.ndarray
    components: tuple[str, ...]
    dtype: np.dtype
    precision: Precision
    params: PlannerParams = field(default_factory=PlannerParams)
    runners: dict[Switches, SceneRunner] = field(default_factory=dict)

    @property
    def block(self) -> int:
        """Trajectories that are scored by one program."""
        return bucket(min(len(self.vocabulary), BLOCK_SIZES[-1]), BLOCK_SIZES)

    @property
    def parts(self) -> int:
        """Blocks of the vocabulary."""
        return -(-len(self.vocabulary) // self.block)

    def bytes_per_scene(self, padding: PaddingConfig) -> int:
        """What a scene and its trajectories take in memory."""
        scene = padded_bytes({axis: sizes[0] for axis, sizes in vars(padding).items()})
        return scene + self.parts * self.block * NUM_STATES * len(STATE_COLUMNS) * 8

    def load(self, chunks: Sequence[Chunk]) -> Iterator[Piece]:
        """Reads scenes and brings the vocabulary to them, a little ahead of their use."""
        # float64, so that trajectories are placed as `spdm score` places them.
        loader = Loader(unread=UNREAD)

        def read(item: tuple[Chunk, bool, Sequence[int]]) -> Piece:
            chunk, last, run = item
            started = time.perf_counter()
            scenes = loader.load([chunk.entries[i] for i in run], chunk.group.padding)
            parts = None if scenes.batch is None else self._parts(scenes.batch, chunk)
            return Piece(chunk, last, scenes, parts, time.perf_counter() - started)

        items = [
            (chunk, run is runs[-1], run)
            for chunk in chunks
            for runs in [split(len(chunk.entries), chunk.group.piece)]
            for run in runs
        ]
        return prefetch(read, items)

    def _parts(self, batch: ScenarioBatch, chunk: Chunk) -> Part:
        count, rows = len(self.vocabulary), self.parts * self.block
        # Rows beyond the last one repeat it: finite, and not valid.
        filled = self.vocabulary[np.minimum(np.arange(rows), count - 1)]
        states = place(filled, batch, chunk.group.switches.tracks)
        states = states.astype(np.float64 if self.precision == "f64" else np.float32, copy=False)
        scenes = len(states)
        valid = np.broadcast_to(np.arange(rows) < count, (scenes, rows))
        shape = (scenes * self.parts, self.block)
        return Part(states=states.reshape(*shape, *states.shape[2:]), valid=valid.reshape(shape))

    def score(self, piece: Piece) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Scores the scenes of a piece.

        Returns:
          Labels `[n, V, C]` of the scenes that have any, and a row of the index for every scene.
        """
        rows = [index_row(failure, entry, "failed") for failure, entry in piece.scenes.failures]
        if piece.parts is None or piece.scenes.batch is None:
            return np.zeros((0, len(self.vocabulary), len(self.components)), self.dtype), rows
        switches, scenes = piece.chunk.group.switches, piece.scenes
        if switches not in self.runners:
            self.runners[switches] = SceneRunner(
                score_part, switches, precision=self.precision, config=BatchConfig(memory=MEMORY)
            )
        number = np.repeat(np.arange(len(scenes.entries)), self.parts)
        found = self.runners[switches](
            piece.scenes.batch, piece.parts, self.params, scene_of=number
        )
        return self._pick(join(found, len(self.vocabulary), self.parts, self.params), scenes, rows)

    def _pick(
        self, found: Scored, scenes: LoadedScenes, rows: list[dict[str, Any]]
    ) -> tuple[np.ndarray, list[dict[str, Any]]]:
        with np.errstate(over="ignore"):  # beyond float16: not finite, which is looked for below
            labels = np.stack([found.scores[c] for c in self.components], -1).astype(self.dtype)
        finite = np.isfinite(labels).all(axis=(1, 2))
        finite &= np.isfinite(found.scores["total"]).all(axis=1)
        status = np.where(found.overflow, "overflow", np.where(finite, "ok", "failed"))
        for entry, text in zip(scenes.entries, status.tolist(), strict=True):
            reason = "" if text == "ok" else REASONS[text]
            rows.append(index_row(Failure(entry.token, reason), entry, text))
        return labels[status == "ok"], rows

    def counters(self) -> dict[str, Any]:
        """Returns what the programs did so far."""
        stats = [runner.stats for runner in self.runners.values()]
        return {
            "programs": sum(s.programs for s in stats),
            "compile_s": round(sum(s.compile_s for s in stats), 3),
            "run_s": round(sum(s.run_s for s in stats), 3),
            "messages": [message for s in stats for message in s.messages],
        }


def index_row(failure: Failure, entry: Entry | None, status: str) -> dict[str, Any]:
    """Returns a row of the index, but for the place of its labels."""
    names = ("log_name", "map_name", "scenario_type")
    about = {name: getattr(entry, name) if entry else None for name in names}
    return {"token": failure.token, **about, "status": status, "reason": failure.reason}
