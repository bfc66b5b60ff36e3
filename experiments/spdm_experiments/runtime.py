"""One run of a verb: device, compile cache, clocks, Ctrl-C and provenance."""

import importlib.metadata
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from spdm_experiments.options import OnDevice

_COMPILE_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
_VERSIONED = ("spdm-jax", "jax", "jaxlib", "numpy", "shapely")


def configure_jax(options: OnDevice) -> Path | None:
    """Applies the options to JAX; to be called before anything is computed.

    Args:
      options: device and compile cache.

    Returns:
      The folder of the compile cache, or None where there is none.

    Raises:
      ValueError: there is no device of the wanted kind.
    """
    import jax

    from spdm_jax.compile_cache import enable_compile_cache

    if options.device != "auto":
        jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[options.device])
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # JAX asserts where a platform has no plugin
        raise ValueError(
            f"--device {options.device}: JAX finds no such device. Use --device cpu, or install "
            'the GPU build: pip install "jax[cuda12]"'
        ) from error
    return enable_compile_cache() if options.compile_cache else None


@dataclass
class Clock:
    """Seconds of a run, compilation (tracing and loading from the cache included) apart.

    Attributes:
      load: reading and padding scenarios.
      compile: making programs.
      run: computing.
    """

    load: float = 0.0
    compile: float = 0.0
    run: float = 0.0

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Counts the time inside as loading."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.load += time.perf_counter() - started

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Counts the time inside as compiling, as far as JAX reports it, and else as running."""
        from jax import monitoring

        compiling = 0.0

        def listen(event: str, duration_secs: float, **_: object) -> None:
            nonlocal compiling
            if event in _COMPILE_EVENTS:
                compiling += duration_secs

        monitoring.register_event_duration_secs_listener(listen)
        started = time.perf_counter()
        try:
            yield
        finally:
            monitoring.unregister_event_duration_listener(listen)
            self.compile += compiling
            self.run += max(0.0, time.perf_counter() - started - compiling)

    def seconds(self) -> dict[str, float]:
        """Returns the times as run.json holds them."""
        return {
            "load_s": round(self.load, 3),
            "compile_s": round(self.compile, 3),
            "run_s": round(self.run, 3),
        }


@contextmanager
def stop_after(unit: str, *more: signal.Signals) -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C into a wish to stop; a second one interrupts at once.

    Args:
      unit: what is finished first, for the message.
      more: other signals that count as Ctrl-C.

    Yields:
      A function that says whether the user wants to stop.
    """
    asked = False

    def ask(signum: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        print(f"stopping after this {unit}; Ctrl-C again stops at once", file=sys.stderr)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, *more)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def now() -> str:
    """Returns the time as files hold it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def version_of(package: str, absent: str = "not installed") -> str:
    """Returns the installed version of a package, or `absent`: a checkout on the path has none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return absent


def provenance() -> dict[str, object]:
    """Returns versions, the commit of the checkout (None outside one) and the device."""
    import jax

    device = jax.devices()[0]
    return {
        "versions": {name: version_of(name) for name in _VERSIONED},
        "commit": commit(),
        "device": f"{device.device_kind} ({device.platform})",
    }


def provenance_text(about: Mapping[str, object]) -> dict[str, str]:
    """Returns what a page says of the run that it shows.

    Args:
      about: further entries; those that are no plain text or number are left out.
    """
    found = provenance()
    versions = found.pop("versions")
    assert isinstance(versions, dict)
    plain = {key: value for key, value in about.items() if isinstance(value, str | int | float)}
    entries = {**plain, **found, "version": versions["spdm-jax"], "jax": versions["jax"]}
    return {key: str(value) for key, value in entries.items() if value is not None}


def commit() -> str | None:
    """Returns the commit this program was checked out at, "-dirty" appended where it was changed.

    An installed package may lie in the working tree of another project: only a file that git
    tracks counts.
    """
    here = Path(__file__)
    git = ["git", "-C", str(here.parent)]
    try:
        tracked = subprocess.run(
            [*git, "ls-files", "--error-unmatch", here.name], capture_output=True, check=False
        )
        if tracked.returncode:
            return None
        described = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:  # no git on this machine
        return None
    return described.stdout.strip() or None
