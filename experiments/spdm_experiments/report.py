"""`spdm report`: one or two folders of `spdm sweep` or `simulate` as a page and as figures."""

import sys

from spdm_experiments.options import Report
from spdm_experiments.report_data import Run, common_terms, failures, load_run
from spdm_experiments.report_page import Players, render
from spdm_experiments.runtime import configure_jax
from spdm_experiments.terminal import print_files
from spdm_jax.io.scenario_file import write_atomically


def run_report(options: Report) -> bool:
    """Writes the page and, if asked for, the figures; returns True.

    Raises:
      ValueError: a folder is no run, or an option is of no use.
    """
    for name, value, least in (("worst", options.worst, 1), ("players", options.players, 0)):
        if value < least:
            raise ValueError(f"--{name} is {value}; it must be at least {least}")
    runs = [load_run(folder) for folder in (options.run, options.run2) if folder is not None]
    for run in runs:
        print(_in_words(run))
    players = _players(options, runs)
    page = render(runs, worst=options.worst, seed=options.seed, players=players)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, page.encode())
    written = [options.out]
    if options.figures is not None:
        from spdm_experiments.figures import write_figures

        written += write_figures(runs, options.figures, seed=options.seed)
    print_files(written)
    return True


def _players(options: Report, runs: list[Run]) -> Players | None:
    if not options.players:
        return None
    configure_jax(options)
    if common_terms(runs).command == "simulate":
        from spdm_experiments.report_drives import make_drives

        players = make_drives(runs, options.players, options.scenes)
    else:
        from spdm_experiments.report_scenes import make_players

        print(f"planning up to {options.players} scenes for the player ...", file=sys.stderr)
        players = make_players(runs, options.players, options.scenes)
    for note in players.notes if players.page is None else players.notes[1:]:
        print(f"note: {note}", file=sys.stderr)
    return players


def _in_words(run: Run) -> str:
    failed = len({row["token"] for row in failures(run)})
    points, total = len(run.points), run.about["num_scenarios"]
    text = f"{run.folder}: {points} grid points, {total} scenarios, {failed} failed"
    return text + (f", {run.missing} missing (the run is not finished)" if run.missing else "")
