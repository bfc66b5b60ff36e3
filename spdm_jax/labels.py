"""Reads a folder of labels: sub-scores of one vocabulary in many scenes, mapped into memory.

    FOLDER/label.json             components, type, vocabulary, settings, versions
    FOLDER/vocabulary.npy         [V, 41, 3] as it was scored, ego frame
    FOLDER/shards/part-*.npy      [scenes, V, C]
    FOLDER/index/part-*.parquet   token, shard, row, status, reason

`spdm label` writes it. Nothing is read until a scene is asked for, and then only its row.
"""

import json
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

DESCRIPTION = "label.json"
VOCABULARY = "vocabulary.npy"
SHARDS = "shards"
INDEX = "index"
_SAME = ("format", "components", "dtype", "vocabulary", "precision", "config")
"""Entries of label.json in which folders that are opened together must agree."""
_MAX_OPEN = 128
"""Shards mapped at a time; each takes a file descriptor."""


@dataclass(frozen=True)
class _Place:
    folder: Path
    shard: str
    row: int


class Labels:
    """Labels of many scenes, by token. May be used by several threads, pickled and forked.

    Attributes:
      components: names of the last axis.
      dtype: float16 or float32.
      tokens: scenes with labels, in the order of the index.
      failures: token -> reason, of the scenes that have none.
      about: label.json of the (first) folder.
    """

    def __init__(
        self,
        places: dict[str, _Place],
        failures: dict[str, str],
        about: dict[str, Any],
        folder: Path,
    ):
        self.components: tuple[str, ...] = tuple(about["components"])
        self.dtype = np.dtype(about["dtype"])
        self.failures = failures
        self.about = about
        self._shape = (int(about["vocabulary"]["shape"][0]), len(self.components))
        self._places = places
        self._folder = folder
        self._maps: OrderedDict[tuple[Path, str], np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def tokens(self) -> list[str]:
        """Scenes with labels."""
        return list(self._places)

    @property
    def shape(self) -> tuple[int, int]:
        """Trajectories and components of a row."""
        return self._shape

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __contains__(self, token: object) -> bool:
        return token in self._places

    def __getitem__(self, token: str) -> np.ndarray:
        """Returns the row `[V, C]` of a scene, mapped read-only.

        Raises:
          KeyError: the scene has no labels; says why.
        """
        place = self._places.get(token)
        if place is None:
            raise KeyError(self._why_not(token))
        return self._map(place)[place.row]

    def batch(self, tokens: Sequence[str], components: Sequence[str] | None = None) -> np.ndarray:
        """Copies the rows of several scenes into one array.

        Args:
          tokens: B scenes, in any order.
          components: only these, in this order; all if None.

        Returns:
          `[B, V, C]`.

        Raises:
          KeyError: a scene has no labels, or there is no such component.
        """
        columns = None if components is None else [self.column(name) for name in components]
        width = len(self.components) if columns is None else len(columns)
        rows = np.empty((len(tokens), self._shape[0], width), self.dtype)
        for out, token in zip(rows, tokens, strict=True):
            row = self[token]
            out[...] = row if columns is None else row[:, columns]
        return rows

    def column(self, component: str) -> int:
        """Returns the place of a component on the last axis.

        Raises:
          KeyError: there is no such component.
        """
        if component not in self.components:
            raise KeyError(f"no component {component!r}; there are {', '.join(self.components)}")
        return self.components.index(component)

    def vocabulary(self) -> np.ndarray:
        """Returns the scored trajectories `[V, 41, 3]`: x, y, heading in the ego frame."""
        return np.load(self._folder / VOCABULARY)

    def _why_not(self, token: str) -> str:
        if token in self.failures:
            return f"scene {token!r} has no labels: {self.failures[token]}"
        return f"scene {token!r} is not in {self._folder}; label it with the same command"

    def _map(self, place: _Place) -> np.ndarray:
        key = (place.folder, place.shard)
        with self._lock:
            if key not in self._maps:
                found = np.load(place.folder / SHARDS / place.shard, mmap_mode="r")
                if found.shape[1:] != self._shape or found.dtype != self.dtype:
                    raise ValueError(
                        f"{place.folder / SHARDS / place.shard}: {found.dtype} {found.shape}, "
                        f"{place.folder / DESCRIPTION} says {self.dtype} [scenes, "
                        f"{self._shape[0]}, {self._shape[1]}]; label its scenes again"
                    )
                self._maps[key] = found
                if len(self._maps) > _MAX_OPEN:
                    self._maps.popitem(last=False)
            self._maps.move_to_end(key)
            return self._maps[key]

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_maps", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _maps=OrderedDict(), _lock=threading.Lock())

    def __repr__(self) -> str:
        text = (
            f"Labels({len(self)} scenes x {self._shape[0]} trajectories x "
            f"{self._shape[1]} components, {self.dtype}"
        )
        return (
            f"{text}; {len(self.failures)} failed, see .failures)" if self.failures else text + ")"
        )


def open_labels(folder: str | Path | Iterable[str | Path]) -> Labels:
    """Opens what `spdm label` wrote; a run that is not finished may be opened too.

    Args:
      folder: a folder, or the folders of several shards.

    Raises:
      ValueError: that is no such folder, or the folders hold labels of different kinds.
      ImportError: polars is not installed (`pip install "spdm-jax[data]"`).
    """
    folders = [Path(folder)] if isinstance(folder, str | Path) else [Path(f) for f in folder]
    if not folders:
        raise ValueError("no folder given; pass at least one that spdm label has written")
    abouts = [_describe(path) for path in folders]
    for path, about in zip(folders[1:], abouts[1:], strict=True):
        for name in _SAME:
            mine, first = about.get(name), abouts[0].get(name)
            if mine != first:
                raise ValueError(
                    f"{path / DESCRIPTION}: {name} is {mine}, but {first} in {folders[0]}; only "
                    "labels of one kind can be opened together"
                )
    places: dict[str, _Place] = {}
    failures: dict[str, str] = {}
    for path in folders:
        for token, shard, row, status, reason in _read_index(path):
            if token in places or token in failures:
                raise ValueError(
                    f"{path / INDEX}: scene {token!r} occurs twice; delete one of them"
                )
            if status == "ok":
                places[token] = _Place(path, shard, row)
            else:
                failures[token] = f"{status}: {reason}"
    return Labels(places, failures, abouts[0], folders[0])


def _describe(folder: Path) -> dict[str, Any]:
    path = folder / DESCRIPTION
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file; {folder} was not written by spdm label") from error
    except ValueError as error:
        raise ValueError(f"{path}: not readable ({error})") from error
    if not isinstance(about, dict) or about.get("command") != "label":
        raise ValueError(f"{path}: does not describe labels")
    if about["format"] != 1:
        raise ValueError(f"{path}: format is {about['format']!r}, this library reads 1")
    return about


def _read_index(folder: Path) -> Iterator[tuple[str, str, int, str, str]]:
    import polars

    columns = ["token", "shard", "row", "status", "reason"]
    for path in sorted((folder / INDEX).glob("part-*.parquet")):
        yield from polars.read_parquet(path, columns=columns).iter_rows()
