"""From options to planners, and back to words for run.json."""

import dataclasses
from typing import Any

import numpy as np

from spdm_experiments.options import Planner
from spdm_jax import PlannerConfig, PlannerSpec, pdm_closed, spdm


def make_planner(options: Planner) -> PlannerSpec:
    """Returns the planner that the options name.

    Raises:
      ValueError: the number of proposals does not fit the grid, or the grid has a wrong value.
    """
    config = PlannerConfig(
        tracker=options.tracker,
        forecast=options.forecast,
        progress_reference=options.progress_reference,
        borrow_oncoming=options.borrow_oncoming,
    )
    grid: dict[str, Any] = {}
    if options.speeds:
        grid["speed_fractions"] = options.speeds
    if options.offsets:
        grid["lateral_offsets"] = options.offsets
    if options.num_proposals is not None:
        grid["num_proposals"] = options.num_proposals
    make = spdm if options.planner == "spdm" else pdm_closed
    return make(config=config, **grid)


def describe(planner: PlannerSpec) -> dict[str, Any]:
    """Returns name, grid and switches of a planner."""
    speeds = np.asarray(planner.params.speed_fractions).tolist()
    offsets = np.asarray(planner.params.lateral_offsets).tolist()
    return {
        "name": planner.name,
        "num_proposals": len(speeds) * (len(offsets) + planner.config.num_route_paths),
        "speed_fractions": speeds,
        "lateral_offsets": offsets,
        **dataclasses.asdict(planner.config),
    }
