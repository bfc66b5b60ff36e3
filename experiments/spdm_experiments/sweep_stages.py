"""How long proposal generation, tracking and scoring take at each number of proposals.

Each stage is a function compiled alone and fed by the one before. They add up to less than a whole
step, which also looks up lanes and areas and extends the chosen plan.
"""

import functools
import io
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars

from spdm_experiments.inventory import Entry
from spdm_experiments.sweep_grid import Point
from spdm_jax import planner
from spdm_jax.batching import Precision, x64
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.decision import cast_params
from spdm_jax.geometry import ego_box
from spdm_jax.io.scenario_file import read_scenario, write_atomically
from spdm_jax.padding import PATH_ROOM, batch, bucket, to_device
from spdm_jax.proposals.lanes import area_masks, drivable_lanes
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.types import Scenario

FILE = "stages.parquet"
SCENES = 3
REPETITIONS = 15


def pick(entries: Sequence[Entry], seed: int) -> list[Entry]:
    """Picks the scenarios to time, in the order of their names."""
    chosen = random.Random(seed).sample(list(entries), min(SCENES, len(entries)))
    return sorted(chosen, key=lambda entry: entry.path.name)


def write_stage_times(
    folder: Path,
    points: Sequence[Point],
    entries: Sequence[Entry],
    precision: Precision,
    note: Callable[[str], None],
) -> Path:
    """Measures the stages of every planner and N_p of a grid, at its first point.

    Args:
      folder: of the run.
      points: of the grid.
      entries: scenarios to time.
      precision: of all computation.
      note: told what is being timed; compilation takes its time.
    """
    first: dict[tuple[str, int], Point] = {}
    for point in points:
        first.setdefault((point.planner, point.num_proposals), point)
    rows = []
    for (name, count), point in first.items():
        note(f"timing the stages of {name} with {count} proposals")
        for entry in entries:
            config = point.spec.config
            about = {"planner": name, "num_proposals": count, "token": entry.token}
            for stage, call in stages(entry, config, point.spec.params, precision):
                rows.append({**about, "stage": stage, **measure(call)})
    schema = {
        "planner": polars.String,
        "num_proposals": polars.Int32,
        "stage": polars.String,
        "median_ms": polars.Float64,
        "min_ms": polars.Float64,
        "repetitions": polars.Int32,
        "token": polars.String,
    }
    buffer = io.BytesIO()
    polars.DataFrame(rows, schema=schema).write_parquet(buffer)
    write_atomically(folder / FILE, buffer.getvalue())
    return folder / FILE


def measure(call: Callable[[], Any], repetitions: int = REPETITIONS) -> dict[str, float]:
    """Times a call after two that do not count, in milliseconds."""
    call()
    call()
    times = []
    for _ in range(repetitions):
        started = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - started))
    return {
        "median_ms": float(np.median(times)),
        "min_ms": min(times),
        "repetitions": repetitions,
    }


def stages(
    entry: Entry, config: PlannerConfig, params: PlannerParams, precision: Precision
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yields the stages of one step in one scenario; each call waits for its result."""
    config = replace(config, max_path_points=bucket(entry.route_points, PATH_ROOM))
    with x64(precision):
        dtype = np.float64 if precision == "f64" else np.float32
        device = to_device(batch([read_scenario(entry.path)[0]]), dtype)
        scene = jax.tree.map(lambda leaf: leaf[0], device.replace(origin=np.zeros((1, 2), dtype)))
        params = jax.tree.map(lambda value: np.asarray(value, dtype), params)
        proposals, forecast, masks, path, ego = _prepared(scene, params, config)
        tracked = _tracked(proposals, ego, params, config)
        calls = {
            "proposals": lambda: _proposals(scene, params, config),
            "tracking": lambda: _tracked(proposals, ego, params, config),
            "scoring": lambda: _scored(
                tracked, proposals.valid, scene.map.grid, masks, forecast, path, params
            ),
            "total": lambda: _step(scene, params, config),
        }
        for name, call in calls.items():
            yield name, lambda call=call: jax.block_until_ready(call())


@functools.partial(jax.jit, static_argnames="config")
def _step(scene: Scenario, params: PlannerParams, config: PlannerConfig):
    return planner.plan(scene, params, config)


@functools.partial(jax.jit, static_argnames="config")
def _proposals(scene: Scenario, params: PlannerParams, config: PlannerConfig):
    # What the proposals do not need is left out by the compiler.
    return planner.plan(scene, params, config).proposals


@functools.partial(jax.jit, static_argnames="config")
def _prepared(scene: Scenario, params: PlannerParams, config: PlannerConfig):
    """Proposals, forecast, area masks, progress path and ego of the step."""
    params = cast_params(params, scene.ego.x.dtype)
    given, state = planner.observe(scene, 0), planner.init(scene, params, config)
    plans, _ = planner.step(scene, given, state, params, config)
    box = ego_box(given.ego, params.vehicle)
    lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    masks = area_masks(scene.map, scene.route.lane_on_route, lanes, parks)
    path = jax.tree.map(lambda leaf: leaf[0], state.paths)
    return plans.proposals, plans.forecast, masks, path, given.ego


@functools.partial(jax.jit, static_argnames="config")
def _tracked(proposals, ego, params: PlannerParams, config: PlannerConfig):
    pose = (proposals.x, proposals.y, proposals.heading)
    return track(*pose, ego, params.vehicle, params.tracker, config.tracker)[0]


@jax.jit
def _scored(tracked, valid, grid, masks, forecast, path, params: PlannerParams):
    world = World(grid, masks, forecast, path)
    return score_trajectories(tracked, valid, world, params.vehicle, params.scoring)
