"""The work of a simulation on one chunk: every point drives every scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spdm_experiments.loading import LoadedScenes
from spdm_experiments.rows import Layout
from spdm_experiments.simulate_points import Point
from spdm_experiments.simulate_rows import histories_of, layout_of, result_rows
from spdm_experiments.simulate_scene import UNREAD, Switches, run_scene
from spdm_experiments.simulate_scripts import Extras, ScriptRoom, scripts_of, verdicts_of
from spdm_experiments.work import Arrays, Engine, Group, Job
from spdm_jax.padding import bucket
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.loop import SimulationConfig

MAX_AGENTS = 128
"""Reactive agents, and replayed objects, that there is room for."""
AGENT_PATH_ROOM = (257, 385, 513, 769, 1025, 2049, 4097)
"""Points of an agent's path."""
PATH_REST = 96
"""Points that may still lie ahead of an agent when the next lane is appended: some 60 m."""


@dataclass(frozen=True)
class SimulateJob(Job):
    """A simulation.

    Attributes:
      runs: the points, in their order.
      replan_every: steps between two plans.
      plans: whether to write the plans of every step beside the histories.
      extras: of interPlan's scenarios.
      rooms: of the scripts of each group; None for a group of scenarios without extras.
    """

    runs: list[Point]
    replan_every: int
    plans: bool
    extras: Extras
    rooms: list[ScriptRoom | None]

    def layout(self) -> Layout:
        """Returns the columns of the rows."""
        return layout_of(self.points)

    def unread(self) -> Sequence[str]:
        """Returns the layers that nobody reads."""
        return UNREAD

    def engine(self) -> "SimulateEngine":
        """Returns what computes the chunks."""
        return SimulateEngine(self)


class SimulateEngine(Engine):
    """Computes chunks of one simulation."""

    job: SimulateJob

    def compute(self, scenes: LoadedScenes, group: int) -> tuple[list[dict[str, Any]], Arrays]:
        """Drives every scene once per point; see `Engine`."""
        assert scenes.batch is not None
        rows: list[dict[str, Any]] = []
        kept: list[Arrays] = []
        shape, room, extras = self.job.groups[group], self.job.rooms[group], self.job.extras
        scripts = None if room is None else scripts_of(extras, scenes, room)
        tokens = [entry.token for entry in scenes.entries]
        kinds = np.array(scenes.batch.tracks.type)
        for number, point in enumerate(self.job.runs):
            runner = self.runner(run_scene, switches_of(point, shape, self.job), shape.chunk)
            before = runner.stats.run_s
            result = runner(scenes.batch, scripts, point.params)
            run_ms = 1e3 * (runner.stats.run_s - before) / len(tokens)
            known = (scenes.entries, scenes.track_ids, kinds)
            verdicts = None if room is None else verdicts_of(extras, scenes, result)
            rows += result_rows(self.layout, *known, result, number, run_ms, verdicts)
            if self.job.arrays:
                ids = scenes.track_ids
                kept.append(histories_of(result, tokens, ids, number, scenes.origins))
        return rows, _join(kept)


def switches_of(point: Point, group: Group, job: SimulateJob) -> Switches:
    """Returns what the program of a point and a shape is made from."""
    assert group.num_iterations is not None
    is_open = point.mode == "open"
    room = min(group.padding.tracks[0], MAX_AGENTS)
    simulation = SimulationConfig(
        num_samples=group.num_iterations - 1,
        traffic="reactive" if point.traffic == "reactive" else "replay",
        ego="log" if is_open else "two_stage",
        replan_every=job.replan_every,
        record_plans=is_open or job.plans,
        sizes=AgentSizes(
            agents=room,
            replayed=room,
            path_points=bucket(group.max_lane_points + PATH_REST, AGENT_PATH_ROOM),
        ),
    )
    config = replace(point.config, max_path_points=group.max_path_points)
    record = job.arrays is not None
    return Switches(point.planner, config, simulation, group.num_iterations, record)


def _join(kept: Sequence[Arrays]) -> Arrays:
    """Puts the runs of all points one after the other; they differ in nothing but the point."""
    if not kept:
        return {}
    names = [name for name in kept[0] if all(name in part for part in kept)]
    return {name: np.concatenate([part[name] for part in kept]) for name in names}
