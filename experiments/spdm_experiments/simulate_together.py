"""Scenarios of a simulation padded to one shape, whatever their sizes: one program drives all."""

from collections.abc import Sequence
from dataclasses import replace

from spdm_experiments.grid_run import group_of
from spdm_experiments.inventory import Entry
from spdm_experiments.options import Simulate
from spdm_experiments.simulate_points import Point, entries_of
from spdm_experiments.simulate_work import SimulateJob
from spdm_jax.batching import BatchConfig
from spdm_jax.padding import PaddingConfig, bucket


def together(options: Simulate, entries: Sequence[Entry], points: Sequence[Point]) -> SimulateJob:
    """Returns the job that drives scenarios in one call, as its only group.

    Args:
      options: precision and settings of the loop.
      entries: scenarios of as many iterations each.
      points: who drives.

    Raises:
      ValueError: the scenarios differ in their number of iterations.
    """
    counts = sorted({entry.num_iterations for entry in entries})
    if len(counts) != 1:
        raise ValueError(f"scenarios of {counts} iterations cannot be driven by one program")
    rooms = vars(PaddingConfig())
    largest = {
        axis: (max(bucket(entry.sizes[axis], sizes) for entry in entries),)
        for axis, sizes in rooms.items()
    }
    group = group_of(
        replace(options, chunk=len(entries)),
        PaddingConfig(**largest),
        entries,
        "cpu",
        num_iterations=counts[0],
    )
    return SimulateJob(
        folder=options.out,
        points=entries_of(points),
        groups=[group],
        precision=options.precision,
        batching=BatchConfig(),
        arrays=None,
        runs=list(points),
        replan_every=options.replan_every,
        plans=False,
        extras={},
        rooms=[None],
    )
