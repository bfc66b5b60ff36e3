"""`spdm demo`: the built-in scenes, planned by SPDM and PDM-Closed, in a table and in pictures."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from spdm_experiments import tables
from spdm_experiments.options import Demo
from spdm_experiments.planners import describe
from spdm_experiments.record import RUN, Record
from spdm_experiments.runtime import Clock, provenance_text
from spdm_experiments.terminal import print_files, reasons
from spdm_jax import PlanSet, from_raw, pdm_closed, plan, spdm
from spdm_jax.config import NUM_STATES
from spdm_jax.synthetic import make_scene, scene_names

SUITE = "built-in scenes"


def run_demo(options: Demo) -> bool:
    """Plans, compares, draws and writes; returns False if a scene failed.

    Raises:
      ValueError: an unknown scene, or a negative seed.
    """
    from spdm_experiments.drawing import write_png
    from spdm_jax.viz import write_html

    terminal = tables.console()
    clock = Clock()
    planners = (pdm_closed(), spdm())
    about = {
        "command": "demo",
        "suite": SUITE,
        "seed": options.seed,
        "precision": options.precision,
        "planners": [describe(planner) for planner in planners],
    }
    with clock.loading():
        names = options.scenes or scene_names()
        scenes = from_raw(make_scene(name, options.seed) for name in names)
    one = lambda planner: plan(scenes, planner, precision=options.precision)
    record = Record(options.out, about, scenes.failures)
    started = time.perf_counter()
    print("compiling (about a minute, seconds once they are cached) ...", file=sys.stderr)
    with ThreadPoolExecutor(len(planners)) as pool:  # the compiler uses one core per program
        list(pool.map(one, planners))
    clock.compile = time.perf_counter() - started
    results: list[PlanSet] = []
    for planner in planners:
        with clock.computing():
            results.append(one(planner))
        record.add(results[-1])
    clock.compile = max(0.0, clock.compile - clock.run)

    table = tables.plan_table(f"{SUITE}, seed {options.seed}")
    for i in range(len(scenes)):
        for planner, result in zip(planners, results, strict=True):
            tables.add_plans(table, result, planner, range(i, i + 1))
    terminal.print(table)

    record.save(clock=clock, finished=True)
    files = list(record.files)
    page = options.out / "scenes.html"
    files.append(write_html(page, scenes, results, provenance=provenance_text(about)))
    for i in range(len(scenes)):
        if is_interesting(results, i):
            path = options.out / f"{scenes.infos[i].token}.png"
            files.append(write_png(path, scenes, results, i))
    print(
        f"{len(scenes)} scenes built in {clock.load:.1f} s; compiled {len(planners)} programs in "
        f"{clock.compile:.1f} s; planned in {clock.run:.2f} s"
    )
    for line in reasons(record.failed, options.out / RUN):
        print(line)
    print_files(files)
    return not record.failed


def is_interesting(results: list[PlanSet], scene: int) -> bool:
    """Says whether the planners drive apart: more than 2 m lie between their plans after 4 s."""
    ends = [
        np.array(
            [
                np.asarray(values)[scene, NUM_STATES - 1]
                for values in (r.trajectory.x, r.trajectory.y)
            ]
        )
        for r in results
    ]
    return any(float(np.hypot(*(end - ends[0]))) > 2.0 for end in ends[1:])
