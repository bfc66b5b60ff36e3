"""`spdm score` with one of NAVSIM's profiles."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from spdm_experiments.chunks import Survey, scenario_files, suite_name
from spdm_experiments.inventory import Inventory, split
from spdm_experiments.navsim_files import (
    common_padding,
    frame_inventory,
    load_frames,
    read_previous,
    refuse_foreign,
)
from spdm_experiments.options import Score
from spdm_experiments.record import Record
from spdm_experiments.runs import MAX_LINES, close
from spdm_experiments.runtime import Clock, stop_after
from spdm_experiments.terminal import progress_line
from spdm_experiments.trajectory_file import read_trajectories, stored_shape
from spdm_jax import NavsimScoreSet
from spdm_jax.navsim.evaluate import pose_interval, score_frames
from spdm_jax.navsim.results import component
from spdm_jax.padding import PaddingConfig
from spdm_jax.scoring.profile import Profile, Term, profile_named

SHORT: dict[Term, str] = {
    "no_at_fault_collision": "NC",
    "drivable_area": "DAC",
    "driving_direction": "DDC",
    "traffic_light": "TLC",
    "progress": "EP",
    "time_to_collision": "TTC",
    "lane_keeping": "LK",
    "comfort": "C",
    "extended_comfort": "EC",
}
_LEGEND = (
    "NC no at-fault collision, DAC drivable area, DDC driving direction, TLC traffic lights,\n"
    "EP progress, TTC time to collision, LK lane keeping, C comfort, EC extended comfort"
)


def run_navsim_score(options: Score) -> bool:
    """Scores given trajectories; returns False if a frame failed.

    Raises:
      ValueError: options or files are of no use.
    """
    refuse_foreign(options)
    profile = profile_named(options.profile)
    if options.chunk < 1:
        raise ValueError(f"--chunk is {options.chunk}; it must be at least 1")
    clock = Clock()
    with clock.loading():
        files = scenario_files(options.scenes, options.limit)
        inventory = frame_inventory(files, profile)
    found = _survey(inventory, files)
    dt = pose_interval(stored_shape(options.trajectories), options.dt)
    values = read_trajectories(options.trajectories, dt, found)
    previous = {}
    if options.previous is not None:
        if not profile.judges("extended_comfort"):
            raise ValueError(f"--previous is for navsim2; {profile.name} does not look at it")
        previous = read_previous(options.previous, found.tokens)
    about = {
        "command": "score",
        "suite": suite_name(options.scenes, found.sources),
        "scenes": str(options.scenes),
        "scenarios": found.num_files,
        "precision": options.precision,
        "trajectories": str(options.trajectories),
        "trajectories_shape": list(values.shape),
        "dt": dt,
        "frame": options.frame,
        "profile": profile.name,
        "previous": None if options.previous is None else str(options.previous),
    }
    record = Record(options.out, about, found.failures)
    table = _table(about["suite"], profile)
    done, padding = 0, common_padding(inventory.entries)
    with (
        stop_after("chunk") as stopping,
        progress_line("scoring", len(found.paths)) as advance,
    ):
        for rows in split(len(found.paths), options.chunk):
            if stopping():
                break
            with clock.loading():
                frames = load_frames(
                    [inventory.entries[i] for i in rows], profile, options.precision, padding
                )
            record.failed |= {failure.token: failure.reason for failure in frames.failures}
            if len(frames):
                place = {found.tokens[i]: i for i in rows}
                mine = [place[token] for token in frames.tokens]
                with clock.computing():
                    result = score_frames(
                        frames,
                        values[mine] if values.ndim == 4 else values,
                        profile,
                        dt=dt,
                        frame=options.frame,
                        previous=_plans(previous, frames.tokens),
                        precision=options.precision,
                    )
                record.add(result)
                _add_scores(table, result, max(0, MAX_LINES - done))
            done = rows.stop
            record.save(clock=clock, finished=done == len(found.paths))
            advance(done)
    return close(record, table, clock, found, [], done == len(found.paths))


def _survey(inventory: Inventory, files: Sequence[Path]) -> Survey:
    """Returns what readers of trajectory files ask for."""
    places = {path: place for place, path in enumerate(files)}
    return Survey(
        paths=[entry.path for entry in inventory.entries],
        tokens=[entry.token for entry in inventory.entries],
        places=[places[entry.path] for entry in inventory.entries],
        num_files=len(files),
        sources=sorted({entry.source for entry in inventory.entries}),
        padding=PaddingConfig(),
        longest=0,
        failures=inventory.failures,
    )


def _plans(previous: Mapping[str, np.ndarray], tokens: Sequence[str]) -> np.ndarray | None:
    """Plans `[B, P, 8, 3]` of the frame before, NaN where there are none."""
    if not previous:
        return None
    none = np.full_like(next(iter(previous.values())), np.nan)
    return np.stack([previous.get(token, none) for token in tokens])


def _judged(profile: Profile) -> list[Term]:
    return [name for name in SHORT if profile.judges(name)]


def _table(title: str, profile: Profile) -> Table:
    table = Table(
        title=f"{title}, {profile.name}",
        title_justify="left",
        caption=_LEGEND,
        caption_justify="left",
    )
    table.add_column("frame", no_wrap=True)
    for name in ("rows", "mean", "best", "score", *(SHORT[n] for n in _judged(profile)), "m"):
        table.add_column(name, justify="right")
    table.add_column("costs most")
    return table


def _add_scores(table: Table, result: NavsimScoreSet, count: int) -> None:
    """Adds the best trajectories of the first frames, and what they lost most points for."""
    for i in range(min(count, len(result))):
        if result.status[i] != "ok":
            table.add_row(result.infos[i].token, result.status[i])
            continue
        total = result.scores.total[i]
        best = int(np.argmax(total))
        at = lambda name, i=i, best=best: float(component(result.scores, name)[i, best])
        table.add_row(
            result.infos[i].token,
            str(len(total)),
            f"{total.mean():.3f}",
            str(best),
            f"{total[best]:.3f}",
            *(f"{at(name):.2f}".rstrip("0").rstrip(".") for name in _judged(result.profile)),
            f"{at('progress_raw'):.1f}",
            result.explain(i, best).rule or "",
        )
