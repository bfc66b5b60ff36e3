"""`python -m spdm_experiments.bench`: times planning and scoring next to a NumPy yardstick.

Every group of rows is measured in a child process of its own, which is bound to its cores before
JAX is imported. The yardstick (one 1,024 x 1,024 float32 matrix product of NumPy on one thread) is
timed between the repetitions, so that figures can be compared between machines and hours. First
calls (compilation) are reported apart. What a child has found is written to `bench.json` at once:
the same command goes on where an interrupted one stopped.
"""

import argparse
import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

FILE = "bench.json"
VERSIONED = ("spdm-jax", "jax", "jaxlib", "numpy")
PLATFORMS = {"cpu": "cpu", "gpu": "cuda"}
FIRST_CALLS = 3
"""First calls of each planner with an empty compile cache (and as many with a full one)."""
KINDS = (
    "steps",
    "fans",
    "batches",
    "drives",
    "learned",
    "frames",
    "first call",
    "first drive",
    "memory",
    "sweep",
)
"""What the names of units begin with."""


class Results:
    """What a benchmark has found so far, kept in a file.

    Attributes:
      path: the file.
      facts: what must be the same for a run that goes on.
      units: name -> rows of a child, or the one row of a process.
      resumed: whether an earlier run of the same facts left something.
      only: kinds of units to measure, of `KINDS`; all if empty.
    """

    def __init__(
        self,
        path: Path,
        facts: Mapping[str, Any],
        about: Mapping[str, Any],
        only: Sequence[str] = (),
    ):
        self.path, self.facts, self.only = path, dict(facts), tuple(only)
        self.about, self.units, self.resumed = dict(about), dict[str, Any](), False
        if path.is_file():
            before = json.loads(path.read_text(encoding="utf-8"))
            if before.get("facts") == self.facts:
                self.about, self.units, self.resumed = before["about"], before["units"], True
        self.save()

    def save(self) -> None:
        """Writes the file; a reader sees the old one or the whole new one."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = {"about": self.about, "facts": self.facts, "units": self.units}
        partial = self.path.with_suffix(".tmp")
        partial.write_text(json.dumps(content, indent=1), encoding="utf-8")
        partial.replace(self.path)

    def unit(self, name: str, measure: Callable[[], Any]) -> Any:
        """Returns what a unit found, now or earlier; None if it was not asked for."""
        if name not in self.units and name.startswith(self.only or ""):
            print(name, file=sys.stderr, flush=True)
            self.units[name] = measure()
            self.save()
        return self.units.get(name)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of all children."""
        return [row for found in self.units.values() if isinstance(found, list) for row in found]

    @property
    def apart(self) -> dict[str, dict[str, Any]]:
        """What was measured in processes of its own."""
        return {name: found for name, found in self.units.items() if isinstance(found, dict)}


def _digest() -> str:
    """Digest of the code that is measured, and of the code that measures."""
    import spdm_models
    from spdm_jax.programs import package_digest

    digest = hashlib.sha256(package_digest().encode())
    for folder in (Path(__file__).parent, Path(str(spdm_models.__file__)).parent):
        for path in sorted(folder.glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _run(module: str, arguments: Sequence[str], **environment: str) -> Any:
    """Runs a module of this package in a process and returns what its last line says."""
    settings = {**os.environ, **environment}
    # One thread for the yardstick; settings that pin an old kernel slow a current NumPy.
    for name in ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE"):
        settings.pop(name, None)
    settings.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    command = [sys.executable, "-m", f"spdm_experiments.{module}", *arguments]
    run = subprocess.run(command, env=settings, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def _child(group: str, cores: int, precision: str, scale: str, scenes: Path) -> Any:
    """Measures one group of rows in a process bound to its cores."""
    what = f"{group}:{cores}:{precision}:{scale}"
    return _run("bench", ["--child", what, "--out", str(scenes)])


def _answer(what: str, scenes: Path) -> int:
    """Does a child's work; JAX is imported only after the process is bound to its cores."""
    group, cores, precision, scale = what.split(":")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(cores)])
    from spdm_experiments.bench_rows import SIZES, measure

    if precision not in ("f32", "f64"):
        raise ValueError(f"precision is {precision!r}; it must be 'f32' or 'f64'")
    print(json.dumps(measure(group, SIZES[scale], precision, scenes)))
    return 0


def _first_calls(mode: str, scenes: Path, *arguments: str) -> dict[str, Any]:
    """First calls of a process with an empty compile cache, and with one that has the program."""
    call = lambda cache: _run(
        "bench_process", [mode, str(scenes), *arguments], SPDM_COMPILE_CACHE=cache
    )
    cold, warm = [], []
    for _ in range(FIRST_CALLS):
        with tempfile.TemporaryDirectory() as cache:
            cold.append(call(cache)["first_call_s"])
            warm.append(call(cache))
    middle = lambda values: sorted(values)[len(values) // 2]
    return {
        "cold_s": middle(cold),
        "warm_s": middle([run["first_call_s"] for run in warm]),
        "import_s": middle([run["import_s"] for run in warm]),
        "repetitions": FIRST_CALLS,
    }


def _memory(scenes: Path, cache: Path, kind: str, count: int) -> dict[str, Any]:
    """Peak memory of a process whose programs the process before has compiled."""
    arguments = ["memory", str(scenes), kind, str(count)]
    runs = [_run("bench_process", arguments, SPDM_COMPILE_CACHE=str(cache)) for _ in range(2)]
    return runs[-1]


def measure_all(results: Results, out: Path, scale: str, frames: Path | None = None) -> None:
    """Measures what is missing, child by child.

    Args:
      results: takes what is measured.
      out: folder for scenes and compiled programs.
      scale: "full" or "quick".
      frames: folder of exported frames of NAVSIM to be timed as well.

    Raises:
      subprocess.CalledProcessError: a child failed.
    """
    from spdm_jax.batching import usable_cores

    full, cores, scenes, cache = scale == "full", usable_cores(), out / "scenes", out / "cache"
    amounts = ("64", "64", "4", "32") if full else ("2", "2", "1", "1")
    # Not under `unit`: files may be lost, and those that are there are kept.
    print("scenes", file=sys.stderr, flush=True)
    _run("bench_process", ["scenes", str(scenes), *amounts])

    def children(cores: int, precision: str, scale: str) -> None:
        for group in ("steps", "fans", "batches", "drives"):
            name = f"{group}, {precision}, {cores} core(s)"
            results.unit(name, lambda g=group: _child(g, cores, precision, scale, scenes))

    children(cores, "f32", scale)
    name = f"learned, f32, {cores} core(s)"
    results.unit(name, lambda: _child("learned", cores, "f32", scale, scenes))
    if frames:
        name = f"frames of {frames.resolve()}, f32, {cores} core(s)"
        results.unit(name, lambda: _child("frames", cores, "f32", scale, frames))
    # A first call compiles anew: too slow for a toy run.
    planners = (("PDM-Closed", 15), ("SPDM", 60)) if full else ()
    memories = (("trajectories", 4096), ("scenes", 16), ("scenes", 64), ("scenes", 256))
    for planner, count in planners:
        found = lambda p=planner, n=count: _first_calls("first_call", scenes, p, str(n))
        results.unit(f"first call, {planner} {count}", found)
    for traffic in ("replay", "reactive") if full else ():
        found = lambda t=traffic: _first_calls("first_drive", scenes, t)
        results.unit(f"first drive, {traffic}", found)
    for kind, count in memories if full else (("trajectories", 64), ("scenes", 2)):
        found = lambda k=kind, n=count: _memory(scenes, cache, k, n)
        results.unit(f"memory, {count} {kind}", found)
    arguments = ["sweep", str(scenes), *(("64", "7") if full else ("2", "2"))]
    results.unit("sweep", lambda: _run("bench_process", arguments, SPDM_COMPILE_CACHE=str(cache)))
    if full:
        if cores > 1 and any(row["platform"] == "cpu" for row in results.rows):
            children(1, "f32", "half")
        children(cores, "f64", "half")


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m spdm_experiments.bench", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="folder to write")
    parser.add_argument("--quick", action="store_true", help="a toy run that shows it works")
    parser.add_argument("--page", type=Path, help="Markdown page to write, with curves beside it")
    parser.add_argument("--only", choices=KINDS, nargs="+", default=(), help="kinds of rows")
    parser.add_argument("--frames", type=Path, help="folder of frames exported from NAVSIM")
    parser.add_argument("--again", action="store_true", help="measure anew what is there already")
    parser.add_argument("--device", choices=("auto", *PLATFORMS), default="auto")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out} is a file; name a folder")
    if options.page and options.page.suffix != ".md":
        parser.error(f"--page {options.page} must end in .md")
    if options.page and options.only:
        parser.error("--page shows all rows; leave --only out, what is measured already stays")
    if options.frames and not any(options.frames.glob("*.npz")):
        parser.error(f"--frames {options.frames} holds no .npz file; see spdm navsim-script")
    return options


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark and writes `bench.json`."""
    options = _options(argv)
    if options.child:
        return _answer(options.child, options.out)
    from spdm_experiments.bench_page import table, write_page
    from spdm_experiments.bench_scenes import SUITE
    from spdm_experiments.runtime import commit, now, version_of
    from spdm_jax.batching import usable_cores

    if options.device != "auto":
        os.environ["JAX_PLATFORMS"] = PLATFORMS[options.device]
    scale = "quick" if options.quick else "full"
    given = sys.argv[1:] if argv is None else argv
    facts = {
        "scale": scale,
        "code": _digest(),
        "machine": processor(),
        "cores": usable_cores(),
        "platforms": os.environ.get("JAX_PLATFORMS", ""),
        "versions": {name: version_of(name) for name in VERSIONED},
        "python": platform.python_version(),
    }
    about = {
        "command": shlex.join(["python", "-m", "spdm_experiments.bench", *given]),
        "commit": commit(),
        "date": now(),
        "suite": f"{SUITE} (generated), seeds from 0",
        "seed": 0,
    }
    if options.again:
        (options.out / FILE).unlink(missing_ok=True)
    results = Results(options.out / FILE, facts, about, options.only)
    if results.resumed:
        print(f"{results.path}: {len(results.units)} units are there already", file=sys.stderr)
    try:
        measure_all(results, options.out, scale, options.frames)
    except subprocess.CalledProcessError as error:
        print(
            f"{shlex.join(error.cmd)} ended with {error.returncode}; {results.path} has what was "
            "finished, and the same command goes on from there",
            file=sys.stderr,
        )
        return 1
    print(table(results.rows))
    for name, found in results.apart.items():
        print(name, {key: round(value, 3) for key, value in found.items()})
    print(f"written: {results.path}")
    if options.page:
        everything = {**results.facts, **results.about, "device": results.rows[0]["device"]}
        for path in write_page(options.page, everything, results.rows, results.apart):
            print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
