"""Benchmark rows that need a process of their own: first calls, peak memory, a whole sweep.

`python -m spdm_experiments.bench_process MODE ARGUMENTS` prints one JSON object.
"""

import json
import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def _peak_mb() -> float:
    """Largest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e3 if sys.platform != "darwin" else peak / 1e6


def first_call(planner: str, count: str) -> dict[str, Any]:
    """Seconds of the first plan of a process, imports and scene building apart."""
    started = time.perf_counter()
    import jax

    from spdm_experiments.bench import SCENE
    from spdm_jax import from_raw, pdm_closed, plan, spdm
    from spdm_jax.compile_cache import enable_compile_cache
    from spdm_jax.synthetic import make_scene

    enable_compile_cache()
    jax.devices()
    imported = time.perf_counter() - started
    scenes = from_raw([make_scene(*SCENE)])
    spec = pdm_closed(int(count)) if planner == "PDM-Closed" else spdm(int(count))
    began = time.perf_counter()
    plan(scenes, spec)
    return {"first_call_s": time.perf_counter() - began, "import_s": imported}


def memory(kind: str, count: str) -> dict[str, Any]:
    """Peak memory of scoring `count` trajectories, or of planning `count` scenes as packed files.

    Programs come from the compile cache where they are there: compiling them is no part of a run.
    """
    from spdm_experiments.bench import SCENE, fan
    from spdm_jax import from_raw, load, plan, score, spdm
    from spdm_jax.compile_cache import enable_compile_cache
    from spdm_jax.synthetic import make_scene

    enable_compile_cache()
    if kind == "trajectories":
        scenes = from_raw([make_scene(*SCENE)])
        before = _peak_mb()
        score(scenes, fan(int(count)))
        return {"before_mb": before, "peak_mb": _peak_mb()}
    with tempfile.TemporaryDirectory() as folder:
        padding = pack(int(count), Path(folder))
        files = sorted(Path(folder).glob("*.npz"))
        before = _peak_mb()
        for begin in range(0, len(files), 16):
            plan(load(files[begin : begin + 16], padding=padding), spdm(60))
        return {"before_mb": before, "peak_mb": _peak_mb()}


def pack(count: int, folder: Path) -> Any:
    """Packs `count` built-in scenes and returns the padding that holds them all."""
    from spdm_experiments.bench import NAMES
    from spdm_experiments.inventory import take_inventory
    from spdm_jax.batching import group_by_shape
    from spdm_jax.io.pack import pack as pack_reader
    from spdm_jax.synthetic import SyntheticReader

    seeds = range(-(-count // len(NAMES)))
    pack_reader(SyntheticReader(NAMES[: min(count, len(NAMES))], seeds), folder)
    entries = take_inventory(sorted(folder.glob("*.npz"))).entries
    return group_by_shape([entry.sizes for entry in entries])[-1].padding


def sweep(count: str) -> dict[str, Any]:
    """A sweep of SPDM 60 over packed scenes, end to end, next to the time of its kernels."""
    from spdm_experiments import cli

    with tempfile.TemporaryDirectory() as base:
        packed = Path(base, "packed")
        packed.mkdir()
        pack(int(count), packed)
        walls = []
        for run in ("first", "second", "third", "fourth"):
            started = time.perf_counter()
            code = cli.main(
                ["sweep", str(packed), "--num-proposals", "60", "--out", str(Path(base, run))]
            )
            walls.append(time.perf_counter() - started)
            if code:
                raise RuntimeError(f"sweep ended with {code}")
        text = Path(base, "fourth", "progress-all.json").read_text(encoding="utf-8")
        work = json.loads(text)["sessions"][-1]
    return {
        "scenes": int(count),
        "end_to_end_ms": 1e3 * min(walls[1:]) / int(count),
        "kernel_ms": 1e3 * work["run_s"] / int(count),
        "load_ms": 1e3 * work["load_s"] / int(count),
    }


if __name__ == "__main__":
    mode, *arguments = sys.argv[1:]
    found = {"first_call": first_call, "memory": memory, "sweep": sweep}[mode](*arguments)
    print(json.dumps(found))
