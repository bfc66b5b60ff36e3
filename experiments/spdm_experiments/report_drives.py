"""The player of a simulation's report: the worst drives, as they were recorded."""

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
import polars

from spdm_experiments import report_data as numbers
from spdm_experiments import report_grid as grid
from spdm_experiments.drive_page import Drive, render
from spdm_experiments.report_data import Run
from spdm_experiments.report_page import Players
from spdm_jax import load
from spdm_jax.types import Scenario
from spdm_jax.viz.scene_data import take_scene

_MAX_DRIVES = 6
"""Drives of one scene in the player."""


def make_drives(runs: Sequence[Run], count: int, moved: Path | None = None) -> Players:
    """Returns the player for the worst drives of one or two runs.

    Args:
      runs: one or two.
      count: scenes at most.
      moved: folder of the scenario files, if it is not where run.json says.

    Returns:
      The player, or why there is none.
    """
    if not any((run.folder / "histories").is_dir() for run in runs):
        return Players(
            notes=[
                "No player: the drives were not recorded. With spdm simulate ... --record plans "
                "(or history) they are."
            ]
        )
    shown = [
        (number, point)
        for number, run in enumerate(runs)
        for point in range(len(run.points))
        if (run.folder / "histories").is_dir()
    ]
    tokens = _worst(runs, shown, count)
    drives: dict[str, list[Drive]] = {token: [] for token in tokens}
    for number, run in enumerate(runs):
        letter = "" if len(runs) == 1 else f"{'AB'[number]}: "
        for token, drive in _recorded(run, set(tokens), letter):
            drives[token].append(drive)
    source = moved or Path(runs[0].about["scenes"])
    files = [source if source.is_file() else source / f"{token}.npz" for token in tokens]
    try:
        scenes = load(files)
    except (ValueError, OSError) as error:
        return Players(
            notes=[f"No player: {error}. If the files have moved, name their folder with --scenes."]
        )
    entries = []
    for row, info in enumerate(scenes.infos):
        scene = take_scene(scenes, row)
        if mine := [drive for drive in drives[info.token] if _fits(drive, scene)][:_MAX_DRIVES]:
            entries.append((scene, info, mine))
    if not entries:
        return Players(notes=[f"No player: no recorded drive fits the scenario files in {source}."])
    notes = [
        f"{len(entries)} scenes as they were driven. Dashed boxes mark where points were lost; a "
        "click on a red dot or on a line of the list goes there."
    ]
    return Players(render(entries), [info.token for _, info, _ in entries], notes)


def _fits(drive: Drive, scene: Scenario) -> bool:
    """Says whether a drive is of this file: the same frame, and lights of lanes that are there."""
    lanes = int(np.asarray(scene.map.lanes.valid).sum())
    red = np.flatnonzero((drive.arrays["lights"] > 0).any(axis=0))
    same = np.allclose(drive.arrays["origin"], np.asarray(scene.origin), atol=1e-6)
    return bool(same and (not len(red) or red[-1] < lanes))


def _worst(runs: Sequence[Run], shown: Sequence[tuple[int, int]], count: int) -> list[str]:
    """Picks scenes in turn from the lowest scores of each point."""
    lists = [numbers.worst(runs[r], p, count)["token"].to_list() for r, p in shown]
    in_turn = (token for turn in zip_longest(*lists) for token in turn if token is not None)
    return list(dict.fromkeys(in_turn))[:count]


def _recorded(run: Run, tokens: set[str], letter: str) -> Iterator[tuple[str, Drive]]:
    """Yields the recorded drives of some scenes, in the order of the points."""
    keys = grid.distinguishing(run.points)
    found: list[tuple[int, str, Drive]] = []
    for path in sorted((run.folder / "histories").glob("part-*.npz")):
        with np.load(path) as part:
            token, point = part["token"], part["point"]
            rows = [i for i in range(len(token)) if str(token[i]) in tokens]
            if not rows:
                continue
            arrays = {name: part[name] for name in part.files if name not in ("token", "point")}
        for i in rows:
            number, name = int(point[i]), str(token[i])
            row = run.rows.filter((polars.col("point") == number) & (polars.col("token") == name))
            if len(row) != 1 or row["status"][0] != "ok":
                continue
            mine = {key: values[i] for key, values in arrays.items()}
            title = letter + grid.label(run.points[number], keys)
            found.append((number, name, Drive(title, row.row(0, named=True), mine)))
    found.sort(key=lambda entry: entry[:2])
    for _, name, drive in found:
        yield name, drive
