"""A run on a Ray cluster: one chunk is one task, and tasks share nothing.

A task reads its scenarios, computes, writes its own part of the run folder and returns names and
counts. A task whose worker is lost is run again; it writes the same part under the same name, so
nothing is there twice. The run folder has to be one that all machines see.
"""

import dataclasses
import os
import re
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

from spdm_experiments.loading import Loader
from spdm_experiments.options import OverGrid
from spdm_experiments.runtime import configure_jax, provenance
from spdm_experiments.work import Chunk, Done, Engine, Job, load_chunk
from spdm_jax.batching import BatchConfig

RETRIES = 5
"""How often a chunk is tried again after its worker was lost."""
_engines: dict[str, Engine] = {}
"""In a worker: the engine of the run at hand, which keeps its compiled programs."""
_loaders: dict[str, Loader] = {}
"""In a worker: what reads for that engine."""


class Cluster:
    """The workers of a Ray cluster do the work; this process hands it out."""

    serial = False
    """One worker computes while another compiles."""

    def __init__(self, options: OverGrid):
        """Connects to the cluster that the options name, or starts one.

        Raises:
          ImportError: Ray is not installed.
          ValueError: there is no such cluster.
        """
        try:
            import ray
        except ImportError as error:
            raise ImportError(
                'Ray is not installed, which --cluster needs: pip install "spdm-jax[cluster]"'
            ) from error
        self._ray = ray
        self._options = options
        if not ray.is_initialized():
            _connect(ray, str(options.cluster))
        self.kind: Literal["cpu", "gpu"] = "gpu" if options.device == "gpu" else "cpu"
        needs: dict[str, Any] = {"num_cpus": 1, "max_retries": RETRIES}
        if self.kind == "gpu":
            needs["num_gpus"] = 1
        self._task = ray.remote(**needs)(run_chunk)
        self._about = ray.remote(**needs)(about)

    def provenance(self) -> dict[str, object]:
        """Returns versions, commit and device of a worker."""
        return self._ray.get(self._about.remote(self._options))

    def run(self, job: Job, chunks: Sequence[Chunk], stop: Callable[[], bool]) -> Iterator[Done]:
        """Hands out chunks until all are done or the user wants to stop.

        Raises:
          ValueError: a chunk was given up; all others are done.
        """
        ray = self._ray
        from ray.exceptions import OutOfMemoryError, WorkerCrashedError

        job = dataclasses.replace(job, folder=job.folder.absolute())
        shared, key = ray.put(job), uuid.uuid4().hex
        waiting, lost = list(reversed(chunks)), []
        running: dict[Any, Chunk] = {}
        while running or (waiting and not stop()):
            # Few tasks wait in the cluster's queue, so that Ctrl-C need not take them back.
            while waiting and not stop() and len(running) < self._slots():
                chunk = waiting.pop()
                entries = [dataclasses.replace(e, path=e.path.absolute()) for e in chunk.entries]
                chunk = dataclasses.replace(chunk, entries=entries)
                running[self._task.remote(key, self._options, shared, chunk)] = chunk
            ready, _ = ray.wait(list(running), timeout=1.0)
            for task in ready:
                chunk = running.pop(task)
                try:
                    yield ray.get(task)
                except (WorkerCrashedError, OutOfMemoryError) as error:
                    lost.append(f"{chunk.name}: {type(error).__name__}")
        if lost:
            raise ValueError(
                f"{len(lost)} chunks were given up after {RETRIES} lost workers each "
                f"({lost[0]}); the same command tries them again"
            )

    def _slots(self) -> int:
        resources = self._ray.cluster_resources()
        return max(2, 2 * int(resources.get(self.kind.upper(), 1)))


def _connect(ray: Any, address: str) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports home otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "warning"}
    local = re.fullmatch(r"local(?::([1-9]\d*))?", address)
    try:
        if local:
            count = int(local[1]) if local[1] else None
            ray.init(address="local", num_cpus=count, include_dashboard=False, **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f'--cluster {address}: {reason}. Use "local", "auto", or the address of a cluster'
        ) from error


def run_chunk(key: str, options: OverGrid, job: Job, chunk: Chunk) -> Done:
    """Computes a chunk in a worker.

    Args:
      key: of this run, so that the worker keeps its programs from one chunk to the next.
      options: device and compile cache.
      job: of the run.
      chunk: scenarios.
    """
    if key not in _engines:
        _prepare(options)
        _engines.clear()
        threads = BatchConfig(devices=1, threads=1)
        _engines[key] = dataclasses.replace(job, batching=threads).engine()
        _loaders.clear()
        _loaders[key] = job.loader()
    return _engines[key].process(load_chunk(chunk, job, _loaders[key]))


def about(options: OverGrid) -> dict[str, object]:
    """Returns versions, commit and device of a worker."""
    _prepare(options)
    return provenance()


def _prepare(options: OverGrid) -> None:
    # A worker has one core; JAX would start a thread for each of the machine's. It reads this
    # when it first computes, not when it is imported.
    os.environ["NPROC"] = "1"
    configure_jax(options)
