"""Benchmark rows that need a process of their own: first calls, peak memory, a whole sweep.

`python -m spdm_experiments.bench_process MODE ARGUMENTS` prints one JSON object in its last line.
"""

import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal


def peak_mb() -> float:
    """Returns the largest resident size of this process so far, MB.

    Linux hands `ru_maxrss` on from the process that started this one; its own mark is asked first.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def scenes(folder: str, crossings: str, mixed: str, copies: str, drives: str) -> dict[str, Any]:
    """Packs the scenes of a run."""
    from spdm_experiments.bench_drives import pack_drives
    from spdm_experiments.bench_scenes import pack_scenes

    started = time.perf_counter()
    pack_scenes(Path(folder), int(crossings), int(mixed), int(copies))
    pack_drives(Path(folder), int(drives))
    return {"seconds": time.perf_counter() - started}


def first_call(folder: str, planner: str, count: str) -> dict[str, Any]:
    """Measures the first plan of a process, imports and reading the scene apart."""
    started = time.perf_counter()
    import jax

    from spdm_experiments.bench_rows import planner_of
    from spdm_experiments.bench_scenes import scene_files
    from spdm_jax import load, plan
    from spdm_jax.compile_cache import enable_compile_cache

    enable_compile_cache()
    jax.devices()
    imported = time.perf_counter() - started
    scene = load(scene_files(Path(folder), "crossings")[0])
    spec = planner_of(planner, int(count))
    began = time.perf_counter()
    plan(scene, spec)
    return {"first_call_s": time.perf_counter() - began, "import_s": imported}


def first_drive(folder: str, traffic: Literal["replay", "reactive"]) -> dict[str, Any]:
    """Measures the first drive of a process, imports and reading the scenario apart."""
    started = time.perf_counter()
    import jax

    from spdm_experiments.bench_drives import Drives, check
    from spdm_experiments.bench_scenes import scene_files
    from spdm_jax.compile_cache import enable_compile_cache

    enable_compile_cache()
    jax.devices()
    imported = time.perf_counter() - started
    engine, scenario = Drives(scene_files(Path(folder), "drives")[:1], traffic, "f32").load(1)
    began = time.perf_counter()
    rows, _ = engine.compute(scenario, 0)
    seconds = time.perf_counter() - began
    check(rows, None)
    return {"first_call_s": seconds, "import_s": imported}


def memory(folder: str, kind: str, count: str) -> dict[str, Any]:
    """Measures the peak memory of scoring trajectories in one scene, or of `spdm sweep`.

    Programs come from the compile cache where they are there: compiling them is no part of a run.
    """
    from spdm_experiments import cli
    from spdm_experiments.bench_rows import fan
    from spdm_experiments.bench_scenes import scene_files
    from spdm_jax import load, score
    from spdm_jax.compile_cache import enable_compile_cache

    enable_compile_cache()
    before = peak_mb()
    if kind == "trajectories":
        score(load(scene_files(Path(folder), "crossings")[0]), fan(int(count)))
    else:
        with tempfile.TemporaryDirectory() as base:
            _sweep(cli.main, Path(folder, "many"), Path(base, "run"), int(count))
    return {"before_mb": before, "peak_mb": peak_mb()}


def sweep(folder: str, count: str, repetitions: str) -> dict[str, Any]:
    """Measures `spdm sweep` of SPDM 60 over packed scenes, next to the time of its kernels.

    Returns:
      Medians over the runs after the first, ms per scenario. The kernel's time is what the library
      takes from padded scenarios on the host to results on the host.
    """
    import numpy as np

    from spdm_experiments import cli
    from spdm_experiments.bench_watch import Stopwatch

    watch, runs = Stopwatch(int(repetitions)), []
    with tempfile.TemporaryDirectory() as base:
        for number in range(1 + int(repetitions)):
            stick, out = watch.yardstick(), Path(base, str(number))
            started, cpu = time.perf_counter(), time.process_time()
            _sweep(cli.main, Path(folder, "many"), out, int(count))
            wall, used = time.perf_counter() - started, time.process_time() - cpu
            text = (out / "progress-all.json").read_text(encoding="utf-8")
            work = json.loads(text)["sessions"][-1]
            seconds = {name: work[f"{name}_s"] for name in ("load", "compile", "run", "write")}
            runs.append({"wall": wall, "cpu": used, "stick": stick, **seconds})
    first, *warm = runs
    each = {
        name: 1e3 * float(np.median([run[name] for run in warm])) / int(count)
        for name in ("wall", "cpu", "load", "run", "write")
    }
    return {
        "scenes": int(count),
        "first_run_s": first["wall"],
        "end_to_end_ms": each["wall"],
        "kernel_ms": each["run"],
        "load_ms": each["load"],
        "write_ms": each["write"],
        "cpu_ms": each["cpu"],
        "ratio": float(np.median([run["wall"] / run["run"] for run in warm])),
        "yardstick_ms": 1e3 * float(np.median([run["stick"] for run in warm])),
        "repetitions": int(repetitions),
    }


def _sweep(run: Callable[[list[str]], int], folder: Path, out: Path, count: int) -> None:
    options = ["--num-proposals", "60", "--limit", str(count), "--out", str(out)]
    if code := run(["sweep", str(folder), *options]):
        raise RuntimeError(f"sweep ended with {code}")


MODES: dict[str, Callable[..., dict[str, Any]]] = {
    "scenes": scenes,
    "first_call": first_call,
    "first_drive": first_drive,
    "memory": memory,
    "sweep": sweep,
}

if __name__ == "__main__":
    mode, *arguments = sys.argv[1:]
    print(json.dumps(MODES[mode](*arguments)))
