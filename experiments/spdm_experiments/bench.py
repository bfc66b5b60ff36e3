"""`python -m spdm_experiments.bench`: times planning and scoring next to a NumPy yardstick.

One child process per (cores, precision), pinned before JAX is imported. Within a child the NumPy
yardstick (one 1,024 x 1,024 float32 matrix product) is timed between the repetitions, so that
figures can be compared between machines and hours. The first call (compilation) is reported apart.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, cast

QUOTED = {
    "PDM-Closed 15": "200-265 ms",
    "PDM-Closed 30": "220-275 ms",
    "PDM-Closed 60": "400-440 ms",
    "SPDM 60": "400-440 ms (PDM-Closed grid of 60)",
    "track + score 4096": "24 s",
    "64 scenes x 60": "27 s",
}
"""The published reference on one thread of this class of machine, when the yardstick took 29 ms:
quoted, not measured here."""
SCENE = ("platoon", 3)
"""Generated scene and seed that the single-scene rows use: the densest of the built-in ones."""
NAMES = (
    "platoon",
    "straight",
    "parked_car",
    "curve",
    "open_road",
    "jaywalker",
    "lane_ends",
    "oncoming",
)
"""Scenes of the batched rows, each with several seeds; they share one padding."""


@dataclass(frozen=True)
class Size:
    """How much to run."""

    repetitions: int
    planners: tuple[tuple[str, int], ...]
    fans: tuple[int, ...]
    batches: tuple[int, ...]


FULL = Size(
    15,
    (("PDM-Closed", 15), ("PDM-Closed", 30), ("PDM-Closed", 60), ("SPDM", 60)),
    (64, 256, 1024, 2048, 4096),
    (1, 4, 16, 32, 64),
)
HALF = Size(15, (("PDM-Closed", 15), ("SPDM", 60)), (4096,), (64,))
QUICK = Size(3, (("PDM-Closed", 15),), (64,), (2,))


def fan(count: int):
    """Deterministic ego-frame trajectories `[count, 41, 3]`: speeds x curvatures."""
    import numpy as np

    rows = int(np.sqrt(count))
    index = np.arange(count)
    speed = 0.5 + 15.0 * (index // rows) / max(1, (count - 1) // rows)
    curvature = 0.06 * (2 * (index % rows) / max(1, rows - 1) - 1)
    way = speed[:, None] * np.arange(41) * 0.1
    heading = curvature[:, None] * way
    step = np.diff(way, axis=1, prepend=0.0)
    x = np.cumsum(step * np.cos(heading), axis=1)
    y = np.cumsum(step * np.sin(heading), axis=1)
    return np.stack([x, y, heading], axis=-1)


class Stopwatch:
    """Times calls between repetitions of the yardstick."""

    def __init__(self, repetitions: int):
        import numpy as np

        self._repetitions = repetitions
        self._matrix = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)

    def _yardstick(self) -> float:
        started = time.perf_counter()
        _ = self._matrix @ self._matrix
        return time.perf_counter() - started

    def __call__(self, call) -> dict[str, float]:
        """First call apart, two warm-ups, then interleaved repetitions; milliseconds."""
        import numpy as np

        started = time.perf_counter()
        call()
        first = time.perf_counter() - started
        call()
        self._yardstick()
        runs, sticks = [], []
        for _ in range(self._repetitions):
            sticks.append(self._yardstick())
            started = time.perf_counter()
            call()
            runs.append(time.perf_counter() - started)
        return {
            "first_call_s": first,
            "median_ms": 1e3 * float(np.median(runs)),
            "min_ms": 1e3 * min(runs),
            "yardstick_ms": 1e3 * float(np.median(sticks)),
        }


def measure(size: Size, precision: Literal["f32", "f64"]) -> list[dict[str, Any]]:
    """Runs all rows of one child process."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    if precision == "f64":
        jax.config.update("jax_enable_x64", True)
    from spdm_jax import ScenarioSet, api, from_raw, functional, pdm_closed, plan, score, spdm
    from spdm_jax.compile_cache import enable_compile_cache
    from spdm_jax.synthetic import make_scene

    enable_compile_cache()
    dtype = jnp.float64 if precision == "f64" else jnp.float32
    watch = Stopwatch(size.repetitions)
    scenes = from_raw([make_scene(*SCENE)])
    device = functional.to_device(scenes.batch, dtype).replace(origin=jnp.zeros((1, 2), dtype))
    scene = jax.tree.map(lambda leaf: leaf[0], device)
    now = int(scenes.batch.num_history[0])
    about = {
        "objects": int(scenes.batch.tracks.valid[0, :, now].sum()),
        "polygons": int(scenes.batch.map.lanes.valid.sum()),
        "edges": int(scenes.batch.map.lanes.polygon.valid.sum()),
    }
    rows = []

    def add(workload: str, count: int, call, **more: Any):
        print(f"{precision} on {os.environ['BENCH_CORES']} core(s): {workload}", file=sys.stderr)
        rows.append({"workload": workload, "num_proposals": count, **about, **more, **watch(call)})

    for name, count in size.planners:
        planner = pdm_closed(count) if name == "PDM-Closed" else spdm(count)
        config = api.fit_config(scenes, planner.config)
        params = jax.tree.map(lambda value: jnp.asarray(value, dtype), planner.params)
        step = jax.jit(lambda s, p, c=config: functional.plan(s, p, c))
        add(f"{name} {count}", count, lambda f=step, p=params: jax.block_until_ready(f(scene, p)))
        safe = np.asarray(step(scene, params).scores.no_at_fault_collision)
        rows[-1]["share_in_collision"] = float(np.mean(safe < 1))
    for name, count in size.planners:
        planner = pdm_closed(count) if name == "PDM-Closed" else spdm(count)
        config = api.fit_config(scenes, planner.config)
        if size is HALF:  # stages on all cores in one precision are enough
            continue
        for stage, call in stages(scene, planner.params, config):
            add(f"{name} {count}: {stage}", count, call)
    for count in size.fans:
        vocabulary = fan(count)
        add(
            f"track + score {count}",
            count,
            lambda v=vocabulary: score(scenes, v, precision=precision),
        )
        whole = score(scenes, vocabulary, precision=precision)
        part = score(scenes, vocabulary[: count // 2], precision=precision)
        rows[-1]["share_in_collision"] = float(np.mean(whole.no_at_fault_collision < 1))
        # Progress is relative to the set; everything else must not depend on the company.
        for term in ("no_at_fault_collision", "drivable_area", "time_to_collision", "comfort"):
            if not np.array_equal(getattr(whole, term)[:, : count // 2], getattr(part, term)):
                raise RuntimeError(f"{term} of {count} trajectories depends on the chunk")
    planner = spdm(60) if len(size.planners) > 1 else pdm_closed(15)
    count = 60 if len(size.planners) > 1 else 15
    largest = max(size.batches)
    every = from_raw(make_scene(NAMES[i % len(NAMES)], i // len(NAMES)) for i in range(largest))
    alone = plan(every, planner, precision=precision)
    for number in size.batches:
        some = ScenarioSet(
            jax.tree.map(lambda leaf, n=number: leaf[:n], every.batch), every.infos[:number]
        )
        add(
            f"{number} scenes x {count}",
            count,
            lambda s=some: plan(s, planner, precision=precision),
            scenes=number,
        )
        found = plan(some, planner, precision=precision)
        for mine, other in zip(
            jax.tree.leaves(found.plans), jax.tree.leaves(alone.plans), strict=True
        ):
            if not np.array_equal(mine, other[:number], equal_nan=mine.dtype.kind == "f"):
                raise RuntimeError(f"a plan depends on the {number} scenes of its batch")
        for term in ("no_at_fault_collision", "drivable_area", "time_to_collision", "comfort"):
            values = getattr(found.scores, term)[found.scores.valid]
            rows[-1][f"share_failing_{term}"] = float(np.mean(values < 1))
    return rows


def stages(scene, params, config) -> list[tuple[str, Any]]:
    """The stages of one planning step, each compiled alone and fed by the one before.

    Returns:
      Names and calls; each call waits for its result.
    """
    import jax
    import jax.numpy as jnp

    from spdm_jax import decision, planner
    from spdm_jax.geometry import ego_box
    from spdm_jax.proposals import idm, lanes, spline
    from spdm_jax.scoring.score import World, score_trajectories
    from spdm_jax.tracking.lqr import track

    params = decision.cast_params(params, scene.ego.x.dtype)
    vehicle, ego = params.vehicle, planner.observe(scene, 0).ego
    calls: list[tuple[str, Any]] = []

    def run(name: str, function, *arguments):
        compiled = jax.jit(function)
        calls.append((name, lambda: jax.block_until_ready(compiled(*arguments))))
        # Evaluated by another compiled copy, so that the timed one still has to compile.
        return jax.jit(lambda *values: function(*values))(*arguments)

    state = run("init", lambda s: planner.init(s, params, config), scene)
    seen = run(
        "see", lambda s, m: planner.see(s, planner.observe(s, 0), m, params, config), scene, state
    )

    def look_up(s, now):
        box = ego_box(now, vehicle)
        near, parks = lanes.drivable_lanes(s.map, box.x, box.y, params.map_radius)
        lane = lanes.starting_lane(s.map, s.route, near, now, vehicle)
        return lane, lanes.area_masks(s.map, s.route.lane_on_route, near, parks)

    lane, masks = run("look up lanes", look_up, scene, ego)
    targets = decision.target_speeds(scene.map.lanes.speed_limit[lane], params)
    start = jax.vmap(lambda path: idm.project(path, ego.x, ego.y))(state.paths)
    contents = run(
        "corridors",
        lambda p, at, v, w: idm.corridor_contents(p, at, v.max(), w.forecast, w.red, vehicle),
        state.paths,
        start,
        targets,
        seen,
    )
    run(
        "IDM rollout",
        lambda p, at, now, v, w, c: idm.rollout(
            p, at, now.vx, v, w.forecast, w.red, c, vehicle, params.idm, 41
        ),
        state.paths,
        start,
        ego,
        targets,
        seen,
        contents,
    )
    stage1 = jax.jit(lambda p, now, v, w: decision.stage1_proposals(p, now, v, w, params))(
        state.paths, ego, targets, seen
    )
    center = jax.tree.map(lambda leaf: leaf[0], state.paths)
    routes = driven = None
    if config.num_route_paths:

        def route_lanes(s, m, now, at, v):
            paths = spline.route_lane_paths(
                s.map.lanes,
                s.route,
                m.slot,
                s.map.lanes.roadblock[at],
                jax.tree.map(lambda leaf: leaf[0], m.paths),
                m.goal,
                now,
                params.spline,
                config.num_route_paths,
                config.max_path_points,
            )
            return paths, spline.drive(paths, now, v, params.spline, 81)

        routes, driven = run("route lanes", route_lanes, scene, state, ego, lane, targets)
    proposals = decision.merge(stage1, driven, routes)
    tracked = run(
        "track",
        lambda p, now: track(p.x, p.y, p.heading, now, vehicle, params.tracker)[0],
        proposals,
        ego,
    )
    run(
        "score",
        lambda t, ok, m, w, path, grid: score_trajectories(
            t, ok, World(grid, m, w.forecast, path), vehicle, params.scoring
        ),
        tracked,
        proposals.valid,
        masks,
        seen,
        center,
        scene.map.grid,
    )
    run(
        "extend to 8 s",
        lambda p, v, one, w: decision.extend_stage1(p, jnp.int32(0), v, one, w, params),
        state.paths,
        targets,
        stage1,
        seen,
    )
    return calls


def table(rows: list[dict[str, Any]]) -> str:
    """Plain-text table of all rows."""
    head = (
        f"{'workload':<28} {'dtype':>5} {'cores':>5} {'median ms':>10} {'min ms':>9} "
        f"{'first s':>8} {'yardstick':>9} {'ratio':>7}  reference (quoted)"
    )
    lines = [head]
    for row in rows:
        ratio = row["median_ms"] / row["yardstick_ms"]
        lines.append(
            f"{row['workload']:<28} {row['precision']:>5} {row['cores']:>5} "
            f"{row['median_ms']:>10.2f} {row['min_ms']:>9.2f} {row['first_call_s']:>8.1f} "
            f"{row['yardstick_ms']:>9.1f} {ratio:>7.2f}  {QUOTED.get(row['workload'], '')}"
        )
    return "\n".join(lines)


def _child(cores: int, precision: str, scale: str) -> list[dict[str, Any]]:
    """Starts one pinned child and reads its rows."""
    environment = {**os.environ, "BENCH_CORES": str(cores)}
    # One thread for the yardstick; settings that pin an old kernel slow a current NumPy.
    for name in ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE"):
        environment.pop(name, None)
    environment.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    command = [sys.executable, "-m", "spdm_experiments.bench", "--child", f"{cores}:{precision}"]
    run = subprocess.run(
        [*command, "--scale", scale], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    rows = json.loads(run.stdout.splitlines()[-1])
    return [{**row, "cores": cores, "precision": precision} for row in rows]


def _processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _process(mode: str, *arguments: str, cache: str) -> dict[str, Any]:
    """Runs `bench_process` with the compile cache in a folder."""
    environment = {**os.environ, "SPDM_COMPILE_CACHE": cache}
    command = [sys.executable, "-m", "spdm_experiments.bench_process", mode, *arguments]
    print(f"process: {mode} {' '.join(arguments)}", file=sys.stderr)
    run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def processes() -> dict[str, Any]:
    """First calls with a cold and a warm cache, peak memory, and a sweep."""
    with tempfile.TemporaryDirectory() as cache:
        found: dict[str, Any] = {"first_call": {}, "memory": {}}
        for name, count in (("PDM-Closed", "15"), ("SPDM", "60")):
            cold = _process("first_call", name, count, cache=cache)
            warm = [_process("first_call", name, count, cache=cache) for _ in range(3)]
            found["first_call"][f"{name} {count}"] = {
                "cold_s": cold["first_call_s"],
                "warm_s": sorted(run["first_call_s"] for run in warm)[1],
                "import_s": sorted(run["import_s"] for run in warm)[1],
            }
        for kind, count in (("trajectories", "4096"), ("scenes", "16"), ("scenes", "64")):
            _process("memory", kind, count, cache=cache)  # compiles
            found["memory"][f"{count} {kind}"] = _process("memory", kind, count, cache=cache)
        found["sweep"] = _process("sweep", "64", cache=cache)
    return found


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark and writes `bench.json`."""
    parser = argparse.ArgumentParser(prog="python -m spdm_experiments.bench", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--quick", action="store_true", help="a toy run that shows it works")
    parser.add_argument("--page", type=Path, help="Markdown page to write, with curves beside it")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    parser.add_argument("--scale", default="full", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.child:
        cores, precision = options.child.split(":")
        if hasattr(os, "sched_setaffinity"):
            usable = sorted(os.sched_getaffinity(0))[: int(cores)]
            os.sched_setaffinity(0, usable)
        size = {"full": FULL, "half": HALF, "quick": QUICK}[options.scale]
        print(json.dumps(measure(size, cast(Literal["f32", "f64"], precision))))
        return 0
    cases = [(2, "f32", "full"), (1, "f32", "half"), (2, "f64", "half")]
    if options.quick:
        cases = [(1, "f32", "quick")]
    rows = [row for case in cases for row in _child(*case)]
    apart = {} if options.quick else processes()
    import jax

    from spdm_experiments.runtime import commit

    about = {
        "machine": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "scene": f"{SCENE[0]}-{SCENE[1]}",
    }
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "bench.json"
    partial = target.with_suffix(".tmp")
    partial.write_text(
        json.dumps({"about": about, "rows": rows, **apart}, indent=1), encoding="utf-8"
    )
    partial.replace(target)
    print(", ".join(f"{key} {value}" for key, value in about.items()))
    print(table(rows))
    print(f"written: {target}")
    if options.page:
        from spdm_experiments.bench_page import write_page

        for path in write_page(options.page, about, rows, apart):
            print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
