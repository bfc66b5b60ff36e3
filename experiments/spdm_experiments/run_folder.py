"""The folder of a run: described once, filled part by part, never changed afterwards.

    RUN/run.json                 # what is computed; every later start is compared with it
    RUN/rows/part-*.parquet      # one per finished chunk
    RUN/trajectories/part-*.npz  # on request, of a sweep
    RUN/histories/part-*.npz     # on request, of a simulation
    RUN/progress-*.json          # times and counts of the processes that worked on it

Every file appears whole, by rename, and a part of rows is the last thing written of its chunk: what
has rows is done, whatever stopped the process before.
"""

import io
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import polars

from spdm_experiments.description import describe
from spdm_experiments.inventory import Shard
from spdm_experiments.parts import clean_parts, read_parts
from spdm_experiments.runtime import now
from spdm_jax.io.scenario_file import write_atomically

RUN = "run.json"
ROWS = "rows"
ARRAYS = ("trajectories", "histories")
"""Folders of arrays that lie beside the rows, if asked for; a run has one of them or none."""
FORMAT = 1
COMPARED = (
    "format",
    "command",
    "precision",
    "seed",
    "config",
    "points",
    "num_scenarios",
    "input_hash",
    "versions",
)
"""Entries of run.json that must be the same for a run to go on."""
NOTED = ("commit", "device")
"""Entries whose change is only mentioned."""


def open_run(folder: Path, about: Mapping[str, Any], arrays: str | None) -> list[str]:
    """Describes a new run, or checks that this is the one that the folder holds.

    Args:
      folder: made if absent.
      about: run.json.
      arrays: one of `ARRAYS`, or None.

    Returns:
      What is different without consequence, in words.

    Raises:
      ValueError: the folder holds another run; names entry and both values.
    """
    path = folder / RUN
    if not path.exists() and any((folder / ROWS).glob("part-*.parquet")):
        raise ValueError(f"{folder}: has rows but no {RUN} that says of what; use another --out")
    folder.mkdir(parents=True, exist_ok=True)
    notes = describe(path, about, COMPARED, NOTED)
    for name in (ROWS, arrays) if arrays else (ROWS,):
        (folder / name).mkdir(exist_ok=True)
    return notes


@contextmanager
def alone(folder: Path, shard: Shard) -> Iterator[None]:
    """Keeps a second process from working on the same scenarios; ends with the process.

    Raises:
      ValueError: another process does.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system: up to the user
        yield
        return
    kinds = {"all": fcntl.LOCK_EX if shard.count == 1 else fcntl.LOCK_SH}
    if shard.count > 1:
        kinds[shard.name] = fcntl.LOCK_EX
    files = []
    try:
        for name, kind in kinds.items():
            file = open(folder / f".lock-{name}", "w")
            files.append(file)
            try:
                fcntl.flock(file, kind | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ValueError(
                    f"{folder}: another process is at work on these scenarios; wait for it, or "
                    "give each process its --shard"
                ) from error
            except OSError:  # a file system without locks
                pass
        yield
    finally:
        for file in files:
            file.close()


def clean(folder: Path, shard: Shard) -> None:
    """Removes what a killed process of this shard left half done."""
    for arrays in ARRAYS:
        clean_parts(folder / ROWS, folder / arrays, shard)


def read_done(folder: Path, num_points: int) -> tuple[dict[str, str], list[str]]:
    """Reads which scenarios have rows; see `parts.read_parts`.

    Args:
      folder: of the run.
      num_points: rows per scenario.

    Returns:
      Token -> why its rows are not all "ok" ("" where they are), and what the user should know.
    """

    def read(path: Path) -> Iterator[tuple[str, str]]:
        part = polars.read_parquet(path, columns=["token", "point", "status", "reason"])
        bad = polars.col("status") != "ok"
        rows = part.group_by("token", maintain_order=True).agg(
            polars.col("point").sort().alias("points"),
            polars.col("reason").filter(bad).first().fill_null("").alias("reason"),
        )
        if any(points != list(range(num_points)) for points in rows["points"].to_list()):
            raise ValueError(f"not one row for each of {num_points} points")
        return zip(rows["token"], rows["reason"], strict=True)

    return read_parts(folder / ROWS, read, "not readable")


def write_part(
    folder: Path,
    name: str,
    rows: polars.DataFrame,
    arrays: Mapping[str, np.ndarray],
    kind: str | None,
) -> None:
    """Writes a finished chunk, its rows last.

    Args:
      folder: of the run.
      name: of the part, without ending.
      rows: one per scenario and point.
      arrays: what lies beside them; nothing is written where there are none.
      kind: where that goes, one of `ARRAYS`; None for a run without.
    """
    if arrays:
        assert kind in ARRAYS
        buffer = io.BytesIO()
        content: dict[str, Any] = dict(arrays)
        np.savez_compressed(buffer, **content)
        write_atomically(folder / kind / f"{name}.npz", buffer.getvalue())
    buffer = io.BytesIO()
    rows.write_parquet(buffer)
    write_atomically(folder / ROWS / f"{name}.parquet", buffer.getvalue())


class Progress:
    """What one process did in a run, in RUN/progress-SHARD.json, written anew after each chunk."""

    def __init__(self, folder: Path, shard: Shard, about: Mapping[str, Any]):
        """Takes over what earlier processes of this shard wrote.

        Args:
          folder: of the run.
          shard: names the file.
          about: device, commit and versions of this process.
        """
        self._path = folder / f"progress-{shard.name}.json"
        self._session = {"started": now(), **about}
        self._earlier: list[Any] = []
        with suppress(OSError, ValueError, KeyError, TypeError):
            self._earlier = json.loads(self._path.read_text(encoding="utf-8"))["sessions"]

    def save(self, counts: Mapping[str, Any], work: Mapping[str, Any]) -> None:
        """Writes the file.

        Args:
          counts: of the shard: scenarios, done, failed, finished.
          work: of this process: scenarios, programs, seconds, messages.
        """
        session = {**self._session, "ended": now(), **work}
        content = {**counts, "sessions": [*self._earlier, session]}
        write_atomically(self._path, (json.dumps(content, indent=1) + "\n").encode())


def note(lines: Sequence[str]) -> None:
    """Tells the user something on the error stream."""
    for line in lines:
        print(f"note: {line}", file=sys.stderr)
