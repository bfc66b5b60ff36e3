"""`spdm plan`, `spdm score` and `spdm show` at work."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars
from rich.table import Table

from spdm_experiments import tables
from spdm_experiments.chunks import Survey, chunks, head, keep, scenario_files, suite_name, survey
from spdm_experiments.navsim_files import refuse_frames
from spdm_experiments.options import Chunked, Plan, Score, Show
from spdm_experiments.planners import describe, make_planner
from spdm_experiments.record import RUN, Record, unusable
from spdm_experiments.runtime import Clock, provenance_text, stop_after
from spdm_experiments.terminal import print_files, progress_line, reasons
from spdm_experiments.trajectory_file import read_trajectories
from spdm_jax import PlannerConfig, PlanSet, ScenarioSet, ScoreSet, load
from spdm_jax import plan as plan_scenes
from spdm_jax import score as score_scenes
from spdm_jax.config import DT

MAX_LINES = 20
"""Scenes listed on the terminal; the rows file has them all."""


def run_plan(options: Plan) -> bool:
    """Plans once per scenario; returns False if a scenario failed.

    Raises:
      ValueError: options or files are of no use.
    """
    planner = make_planner(options)
    found, clock = _survey(options)
    about = {**_about("plan", options, found), "planners": [describe(planner)]}
    record = Record(options.out, about, found.failures)
    table = tables.plan_table(about["suite"])
    drawn: list[Path] = []

    def compute(scenes: ScenarioSet, rows: list[int]) -> PlanSet:
        return plan_scenes(scenes, planner, precision=options.precision)

    def take(scenes: ScenarioSet, result: ScoreSet, done: int) -> None:
        assert isinstance(result, PlanSet)
        record.add_trajectories(scenes, result)
        tables.add_plans(table, result, planner, _listed(result, done))
        if not done:
            drawn.extend(_draw(options, scenes, result, about))

    finished = _go_through(options, found, record, clock, compute, take)
    return close(record, table, clock, found, drawn, finished)


def run_score(options: Score) -> bool:
    """Scores given trajectories; returns False if a scenario failed.

    Raises:
      ValueError: options or files are of no use.
    """
    if options.profile != "tuplan":
        from spdm_experiments.navsim_score import run_navsim_score

        return run_navsim_score(options)
    if options.previous is not None:
        raise ValueError("--previous is for --profile navsim2; the tuplan score ignores it")
    found, clock = _survey(options)
    dt = DT if options.dt is None else options.dt
    values = read_trajectories(options.trajectories, dt, found)
    config = PlannerConfig(forecast=options.forecast, progress_reference=options.progress_reference)
    about = {
        **_about("score", options, found),
        "trajectories": str(options.trajectories),
        "trajectories_shape": list(values.shape),
        "dt": dt,
        "frame": options.frame,
        "tracker": options.tracker,
        "forecast": options.forecast,
        "progress_reference": options.progress_reference,
    }
    record = Record(options.out, about, found.failures)
    table = tables.score_table(about["suite"])

    def compute(scenes: ScenarioSet, rows: list[int]) -> ScoreSet:
        mine = values
        if values.ndim == 4:
            # Rows beyond the chunk's own are dropped: any trajectory does for them.
            mine = values[rows + rows[:1] * (len(scenes) - len(rows))]
        return score_scenes(
            scenes,
            mine,
            dt=dt,
            frame=options.frame,
            tracker=options.tracker,
            config=config,
            precision=options.precision,
        )

    def take(scenes: ScenarioSet, result: ScoreSet, done: int) -> None:
        tables.add_scores(table, result, _listed(result, done))

    finished = _go_through(options, found, record, clock, compute, take)
    return close(record, table, clock, found, [], finished)


def run_show(options: Show) -> bool:
    """Plans one scenario and draws it; returns False if its scores are not to be used.

    Raises:
      ValueError: there is no such scenario.
    """
    files = scenario_files(options.scenes)
    if options.token is not None:
        scenes = load(options.scenes, tokens=[options.token])
    elif 0 <= options.index < len(files):
        scenes = load(files[options.index])
    else:
        raise ValueError(
            f"--index is {options.index}; {options.scenes} has {len(files)} scenarios, "
            f"0 to {len(files) - 1}"
        )
    from spdm_experiments.drawing import write_png
    from spdm_jax.viz import write_html

    planner = make_planner(options)
    result = plan_scenes(scenes, planner, precision=options.precision)
    table = tables.plan_table(str(options.scenes))
    tables.add_plans(table, result, planner, range(1))
    tables.console().print(table)
    if result.status[0] == "ok":
        print(result.explain(0, int(result.best[0])))
    written = []
    page = options.html
    if page is None and options.png is None:
        page = Path(f"{scenes.infos[0].token}.html")
    if page is not None:
        about = {
            "suite": suite_name(options.scenes, [scenes.infos[0].source]),
            "precision": options.precision,
        }
        written.append(write_html(page, scenes, result, provenance=provenance_text(about)))
    if options.png is not None:
        written.append(write_png(options.png, scenes, [result], 0))
    for failure in unusable(result):
        print(f"failed: {failure.token}: {failure.reason}")
    print_files(written)
    return result.status[0] == "ok"


def _survey(options: Chunked) -> tuple[Survey, Clock]:
    clock = Clock()
    with clock.loading():
        files = scenario_files(options.scenes, options.limit)
        refuse_frames(options.scenes, files)
        found = survey(files)
    return found, clock


def _about(command: str, options: Chunked, found: Survey) -> dict[str, Any]:
    return {
        "command": command,
        "suite": suite_name(options.scenes, found.sources),
        "scenes": str(options.scenes),
        "scenarios": found.num_files,
        "precision": options.precision,
        "chunk": options.chunk,
    }


def _go_through(
    options: Chunked,
    found: Survey,
    record: Record,
    clock: Clock,
    compute: Callable[[ScenarioSet, list[int]], ScoreSet],
    take: Callable[[ScenarioSet, ScoreSet, int], None],
) -> bool:
    """Computes chunk by chunk and saves after each; returns False if the user stopped it.

    Args:
      options: of the verb.
      found: scenarios.
      record: where rows go.
      clock: of the run.
      compute: from a padded chunk and the indices of its real rows to results.
      take: called with the real rows' scenes and results and how many went before.
    """
    total, done = len(found.paths), 0
    label = "planning" if isinstance(options, Plan) else "scoring"
    with stop_after("chunk") as stopping, progress_line(label, total) as advance:
        pending = chunks(found, options.chunk)
        while done < total and not stopping():
            with clock.loading():
                rows, scenes = next(pending)
            with clock.computing():
                result = compute(scenes, rows)
            result = keep(result, len(rows))
            record.add(result)
            take(head(scenes, len(rows)), result, done)
            done += len(rows)
            record.save(clock=clock, finished=done == total)
            advance(done)
    return done == total


def _listed(result: ScoreSet, done: int) -> range:
    """Rows of a chunk that the terminal lists, `done` scenes being before it."""
    return range(min(len(result), max(0, MAX_LINES - done)))


def _draw(options: Plan, scenes: ScenarioSet, result: PlanSet, about: dict) -> list[Path]:
    """Draws the first scenes of a chunk as far as the options ask for it."""
    written: list[Path] = []
    if options.html > 0:
        from spdm_jax.viz import write_html

        count = min(options.html, len(scenes))
        page = options.out / "scenes.html"
        given = {key: about[key] for key in ("suite", "precision")}
        write_html(
            page, head(scenes, count), keep(result, count), provenance=provenance_text(given)
        )
        written.append(page)
    if options.png > 0:
        from spdm_experiments.drawing import write_png

        for i in range(min(options.png, len(scenes))):
            path = options.out / f"{scenes.infos[i].token}.png"
            written.append(write_png(path, scenes, [result], i))
    return written


def close(
    record: Record, table: Table, clock: Clock, found: Survey, drawn: list[Path], finished: bool
) -> bool:
    """Prints the outcome; returns False if a scenario failed.

    Raises:
      KeyboardInterrupt: the user stopped the run.
    """
    tables.console().print(table)
    done = record.num_done()
    line = f"{done} of {found.num_files} scenarios done, {len(record.failed)} failed"
    if done > MAX_LINES:
        line += f" (the first {MAX_LINES} are listed)"
    rows = record.table()
    if "chosen" in rows.columns:
        rows = rows.filter(polars.col("chosen"))
    if done:
        line += f"; mean score {rows['total'].mean():.4f}"
    print(line)
    print(f"load {clock.load:.1f} s, compile {clock.compile:.1f} s, run {clock.run:.2f} s")
    for reason in reasons(record.failed, record.folder / RUN):
        print(reason)
    print_files([*record.files, *drawn])
    if not finished:
        raise KeyboardInterrupt
    return not record.failed
