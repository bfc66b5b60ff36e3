"""The verbs of `spdm`: each takes its options and returns whether all went well.

Heavy imports happen inside the verbs. An error that ends a verb is raised (`ValueError` with a
text for the user); what went wrong for single scenarios is printed and makes the verb return False.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spdm_experiments.options import (
    Convert,
    Demo,
    Doctor,
    Label,
    NavsimScript,
    Pack,
    Plan,
    Report,
    Score,
    Show,
    Simulate,
    Sweep,
    Vocab,
)
from spdm_experiments.train_options import Train

if TYPE_CHECKING:
    from spdm_jax.io.pack import PackReport


def convert(options: Convert) -> bool:
    """Writes a model's weights as .safetensors."""
    from spdm_models.weights import load_weights, save_weights

    settings: dict[str, Any] = {}
    if options.variable_cost:
        if options.model != "dtpp":
            raise ValueError(f"--variable-cost is a setting of dtpp, not of {options.model}")
        settings["variable_cost"] = True
    config, params = load_weights(options.source, options.model, options.prefix, **settings)
    save_weights(options.destination, options.model, config, params)
    print(f"{options.destination}: {config}")
    return True


def doctor(options: Doctor) -> bool:
    """Prints versions, devices and the self-test; False if a check fails."""
    from spdm_experiments.runtime import configure_jax

    cache = configure_jax(options)
    from spdm_experiments.doctor import report

    lines, passed = report(cache)
    print("\n".join(lines))
    return passed


def pack(options: Pack) -> bool:
    """Packs a source into scenario files; False if a scenario failed."""
    from spdm_experiments.sources import ChangedSelection, open_source
    from spdm_experiments.terminal import progress_line
    from spdm_jax.interplan.pack import pack_interplan
    from spdm_jax.io.pack import pack as pack_reader

    reader, notes = open_source(options)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    with progress_line("packing", len(reader.tokens())) as advance:
        settings: dict[str, Any] = {
            "overwrite": options.overwrite,
            "progress": lambda done, total, token, outcome: advance(done),
        }
        if isinstance(reader, ChangedSelection):
            report = pack_interplan(reader, options.destination, **settings)
        else:
            report = pack_reader(reader, options.destination, **settings)
    print(summary(report, options.destination))
    return not report.failed


def summary(report: "PackReport", destination: Path) -> str:
    """Returns the outcome of a pack in words, with the reason of each failed scenario."""
    from spdm_experiments.terminal import reasons
    from spdm_jax.io.pack import REPORT_NAME

    head = (
        f"{destination}: {report.total} scenarios, {len(report.written)} written, "
        f"{len(report.skipped)} there already, {len(report.failed)} failed"
    )
    return "\n".join([head, *reasons(report.failed, destination / REPORT_NAME)])


def demo(options: Demo) -> bool:
    """Plans the built-in scenes with both planners; False if a scene failed."""
    from spdm_experiments.runtime import configure_jax

    configure_jax(options)
    from spdm_experiments.demo import run_demo

    return run_demo(options)


def plan(options: Plan) -> bool:
    """Plans once per scenario; False if a scenario failed."""
    from spdm_experiments.runtime import configure_jax

    configure_jax(options)
    from spdm_experiments.runs import run_plan

    return run_plan(options)


def score(options: Score) -> bool:
    """Scores given trajectories; False if a scenario failed."""
    from spdm_experiments.runtime import configure_jax

    configure_jax(options)
    from spdm_experiments.runs import run_score

    return run_score(options)


def show(options: Show) -> bool:
    """Draws one scenario; False if it failed."""
    from spdm_experiments.runtime import configure_jax

    configure_jax(options)
    from spdm_experiments.runs import run_show

    return run_show(options)


def sweep(options: Sweep) -> bool:
    """Plans every scenario at every point of a grid; False if a scenario failed."""
    from spdm_experiments.sweep import run_sweep

    return run_sweep(options)


def simulate(options: Simulate) -> bool:
    """Drives scenarios in simulation; False if a scenario failed."""
    from spdm_experiments.simulate import run_simulate

    return run_simulate(options)


def train(options: Train) -> bool:
    """Trains a learned planner; False if a scenario could not be read."""
    from spdm_experiments.train import run_train

    return run_train(options)


def report(options: Report) -> bool:
    """Writes a page, and figures, for one or two runs of `sweep`."""
    from spdm_experiments.report import run_report

    return run_report(options)


def label(options: Label) -> bool:
    """Scores one vocabulary in every scenario; False if a scenario failed."""
    from spdm_experiments.label import run_label

    return run_label(options)


def navsim_script(options: NavsimScript) -> bool:
    """Writes the script that exports NAVSIM's metric caches."""
    import shutil

    from spdm_jax.navsim import navsim_export

    shutil.copyfile(navsim_export.__file__, options.destination)
    print(
        f"{options.destination}: run it with the Python of your NAVSIM installation:\n"
        f"  python {options.destination} METRIC_CACHE OUT"
    )
    return True


def vocab(options: Vocab) -> bool:
    """Builds a vocabulary; False if a scenario failed."""
    from spdm_experiments.vocabulary import run_build

    return run_build(options)
