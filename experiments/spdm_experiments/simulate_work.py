"""The work of a simulation on one chunk: every point drives every scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from spdm_experiments.loading import LoadedScenes
from spdm_experiments.rows import Layout
from spdm_experiments.simulate_points import Point
from spdm_experiments.simulate_rows import histories_of, layout_of, result_rows
from spdm_experiments.simulate_scene import (
    UNREAD,
    UNREAD_BY_LEARNED,
    Result,
    Switches,
    run_scene,
)
from spdm_experiments.simulate_scripts import Extras, ScriptRoom, scripts_of, verdicts_of
from spdm_experiments.work import Arrays, Engine, Group, Job
from spdm_jax.padding import bucket
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.loop import SimulationConfig
from spdm_jax.simulation.script import Script
from spdm_jax.types import ScenarioBatch

MAX_AGENTS = 128
"""Reactive agents, and replayed objects, that there is room for at first."""
AGENT_PATH_ROOM = (257, 385, 513, 769, 1025, 2049, 4097)
"""Points of an agent's path."""
PATH_REST = 96
"""Points that may still lie ahead of an agent when the next lane is appended: some 60 m."""
AMPLE_LIGHTS, AMPLE_LIGHT_EDGES, AMPLE_OUTLINE = 64, 8192, 8
"""Red lights, their edges, and blocks of an outline, for scenarios that need more than usual."""
AMPLE_LINES = 32
"""Lanes that a learned planner may follow, for the same."""


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
        return UNREAD_BY_LEARNED if any(point.learned for point in self.runs) else UNREAD

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
            result, seconds = self._drive(point, shape, scenes.batch, scripts)
            run_ms = 1e3 * seconds / len(tokens)
            known = (scenes.entries, scenes.track_ids, kinds)
            verdicts = None if room is None else verdicts_of(extras, scenes, result)
            rows += result_rows(self.layout, *known, result, number, run_ms, verdicts)
            if self.job.arrays:
                ids = scenes.track_ids
                kept.append(histories_of(result, tokens, ids, number, scenes.origins))
        return rows, _join(kept)

    def _drive(
        self, point: Point, shape: Group, batch: ScenarioBatch, scripts: Script | None
    ) -> tuple[Result, float]:
        """Drives all scenes, and again with all the room there is those that lacked some.

        Returns:
          Results and run time in seconds.
        """
        usual = switches_of(point, shape, self.job)
        result, seconds = self._run(usual, shape.chunk, point, batch, scripts)
        rows = np.flatnonzero(result.overflow)
        if not len(rows):
            return result, seconds
        pick = lambda tree: jax.tree.map(lambda leaf: leaf[rows], tree)
        ample = switches_of(point, shape, self.job, ample=True)
        again, more = self._run(ample, shape.chunk, point, pick(batch), pick(scripts))

        def put(whole, part):
            whole = np.array(whole)
            whole[rows] = part
            return whole

        return jax.tree.map(put, result, again), seconds + more

    def _run(
        self,
        switches: Switches,
        chunk: int,
        point: Point,
        batch: ScenarioBatch,
        scripts: Script | None,
    ) -> tuple[Result, float]:
        runner = self.runner(run_scene, switches, chunk)
        before = runner.stats.run_s
        return runner(batch, scripts, point.params), runner.stats.run_s - before


def switches_of(point: Point, group: Group, job: SimulateJob, *, ample: bool = False) -> Switches:
    """Returns what the program of a point and a shape is made from.

    Args:
      point: who drives.
      group: the shape.
      job: the simulation.
      ample: make room for whatever a scenario of this shape can hold, at the cost of time.
    """
    assert group.num_iterations is not None
    is_open = point.mode == "open"
    room = group.padding.tracks[0] if ample else min(group.padding.tracks[0], MAX_AGENTS)
    points = group.max_lane_points + PATH_REST
    points = min(4 * points if ample else points, AGENT_PATH_ROOM[-1])
    simulation = SimulationConfig(
        num_samples=group.num_iterations - 1,
        traffic="reactive" if point.traffic == "reactive" else "replay",
        ego="log" if is_open else "two_stage",
        replan_every=job.replan_every,
        record_plans=is_open or job.plans,
        sizes=AgentSizes(
            agents=room,
            replayed=room,
            path_points=bucket(points, AGENT_PATH_ROOM),
            outline_blocks=AMPLE_OUTLINE if ample else AgentSizes.outline_blocks,
        ),
    )
    config = replace(point.config, max_path_points=group.max_path_points)
    if ample:
        config = replace(config, max_red_lights=AMPLE_LIGHTS, max_red_edges=AMPLE_LIGHT_EDGES)
    record, learned = job.arrays is not None, point.learned
    if learned is not None:
        lines = AMPLE_LINES if ample else learned.num_lines
        learned = replace(learned, max_path_points=group.max_path_points, num_lines=lines)
    return Switches(point.planner, config, simulation, group.num_iterations, record, learned)


def _join(kept: Sequence[Arrays]) -> Arrays:
    """Puts the runs of all points one after the other; they differ in nothing but the point."""
    if not kept:
        return {}
    names = [name for name in kept[0] if all(name in part for part in kept)]
    return {name: np.concatenate([part[name] for part in kept]) for name in names}
