"""Rows of one child process of the benchmark: steps, sets of trajectories, batches of scenes."""

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from spdm_experiments.bench_drives import drives
from spdm_experiments.bench_learned import learned
from spdm_experiments.bench_navsim import (
    TRAJECTORIES,
    navsim_batch,
    navsim_fans,
    recorded_frames,
)
from spdm_experiments.bench_scenes import check_counts, scene_files
from spdm_experiments.bench_stages import stages
from spdm_experiments.bench_watch import Stopwatch
from spdm_jax import (
    PlannerConfig,
    PlannerParams,
    PlannerSpec,
    ScenarioSet,
    api,
    functional,
    load,
    pdm_closed,
    plan,
    score,
    spdm,
)
from spdm_jax.batching import BatchConfig, Precision, usable_cores
from spdm_jax.compile_cache import enable_compile_cache
from spdm_jax.decision import poses_only
from spdm_jax.trajectories import to_local
from spdm_jax.types import Scenario, SubScores

METRICS = (
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
)
"""Metrics of one trajectory that do not depend on the others of its set."""
PROGRAMS_DIFFER = 1e-3
"""Share of values in which two differently compiled programs may differ: rounding decides them."""


@dataclass(frozen=True)
class Size:
    """How much to run.

    Attributes:
      repetitions: timed calls of each row.
      planners: name and number of proposals.
      fans: numbers of trajectories.
      batches: numbers of crossings planned in one call, with the last planner.
      mixed: number of built-in scenes planned in one call.
      drives: numbers of scenarios driven through in one call, in closed loop.
      stages: whether to time the stages of each step.
      network_width: of the learned networks' tokens.
      network_batches: scenes in one forward pass of theirs.
      learned_drives: whether learned planners drive a scenario each.
    """

    repetitions: int
    planners: tuple[tuple[str, int], ...]
    fans: tuple[int, ...]
    batches: tuple[int, ...]
    mixed: int
    drives: tuple[int, ...]
    stages: bool = True
    network_width: int = 256
    network_batches: tuple[int, ...] = (1, 32)
    learned_drives: bool = True


SIZES = {
    "full": Size(
        15,
        (("PDM-Closed", 15), ("PDM-Closed", 30), ("PDM-Closed", 60), ("SPDM", 60)),
        (64, 256, 1024, 2048, 4096),
        (1, 4, 16, 32, 64),
        64,
        (1, 8, 16, 32),
    ),
    "half": Size(15, (("PDM-Closed", 15), ("SPDM", 60)), (4096,), (64,), 64, (8,), stages=False),
    "quick": Size(
        3,
        (("PDM-Closed", 15),),
        (64,),
        (2,),
        2,
        (1,),
        network_width=16,
        network_batches=(1, 2),
        learned_drives=False,
    ),
}
GROUPS = ("steps", "fans", "batches", "drives", "learned", "frames")
"""What one child measures."""


def fan(count: int) -> np.ndarray:
    """Returns deterministic ego-frame trajectories `[count, 41, 3]`: speeds x curvatures."""
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


def measure(group: str, size: Size, precision: Precision, folder: Path) -> list[dict[str, Any]]:
    """Measures one group of rows; sets JAX's precision for the whole process.

    Args:
      group: one of `GROUPS`.
      size: how much.
      precision: floating type of everything on the device.
      folder: packed scenes, see `bench_scenes.pack_scenes`; for "frames" exported frames of NAVSIM.

    Raises:
      RuntimeError: results differ that must be equal.
    """
    if precision == "f64":
        jax.config.update("jax_enable_x64", True)
    enable_compile_cache()
    child = Child(size, precision, folder)
    {
        "steps": child.steps,
        "fans": child.fans,
        "batches": child.batches,
        "drives": lambda: drives(child),
        "learned": lambda: learned(child),
        "frames": lambda: recorded_frames(child, fan(max(size.fans))),
    }[group]()
    device = jax.devices()[0]
    about = {
        "group": group,
        "precision": precision,
        "cores": usable_cores(),
        "device": device.device_kind,
        "platform": device.platform,
    }
    return [{**about, **row} for row in child.rows]


class Child:
    """Rows of one group, and what they need."""

    def __init__(self, size: Size, precision: Precision, folder: Path):
        self.size, self.folder = size, folder
        self.precision: Precision = precision
        self.dtype = jnp.float64 if precision == "f64" else jnp.float32
        self.watch = Stopwatch(size.repetitions)
        self.rows: list[dict[str, Any]] = []

    def add(
        self,
        workload: str,
        call: Callable[[], Any],
        check: Callable[[Any], Mapping[str, Any] | None] | None = None,
        **more: Any,
    ) -> None:
        """Adds a row; what the check of its first result returns goes into it."""
        print(f"  {workload}, {self.precision}", file=sys.stderr, flush=True)
        found: dict[str, Any] = {}

        def checked(result: Any) -> None:
            if check is not None:
                found.update(check(result) or {})

        times = self.watch(call, checked)
        self.rows.append({"workload": workload, **more, **times, **found})

    def crossings(self, count: int) -> tuple[ScenarioSet, dict[str, int]]:
        """Returns the first crossings, and their counts, which are what they should be."""
        scenes = load(scene_files(self.folder, "crossings")[:count])
        return scenes, check_counts(scenes.batch)

    def place(self, scenes: ScenarioSet) -> Scenario:
        """Moves scenes to the device."""
        batch = functional.to_device(scenes.batch, self.dtype)
        return batch.replace(origin=jnp.zeros((len(scenes), 2), self.dtype))

    def steps(self) -> None:
        """Single planning steps: on the device alone, from host to host, and by stages."""
        scenes, counts = self.crossings(1)
        scene = jax.tree.map(lambda leaf: leaf[0], self.place(scenes))
        for name, count in self.size.planners:
            planner = planner_of(name, count)
            config = api.fit_config(scenes, planner.config)
            params = jax.tree.map(lambda v: jnp.asarray(v, self.dtype), planner.params)
            step = jax.jit(lambda s, p, c=config: functional.plan(s, p, c))
            about: dict[str, Any] = {"num_proposals": count, **counts}
            first: list[SubScores] = []

            def keep(found: Any, first=first) -> dict[str, Any]:
                first.append(jax.tree.map(lambda leaf: leaf[0], found.scores))
                return shares(found.scores)

            def same(found: Any, first=first) -> dict[str, Any]:
                return agree("a step on the device and plan()", found.scores, first[0])

            whole = lambda p=planner: plan(scenes, p, precision=self.precision)
            self.add(f"{name} {count}, host to host", whole, keep, **about)
            device = lambda f=step, p=params: jax.block_until_ready(f(scene, p))
            self.add(f"{name} {count}", device, same, **about)
            for stage, call in stages(scene, params, config) if self.size.stages else ():
                self.add(f"{name} {count}: {stage}", call, **about)
                # Compiled before, to feed the stages that follow.
                del self.rows[-1]["first_call_s"]

    def fans(self) -> None:
        """Tracking and scoring of given trajectories in one scene."""
        scenes, counts = self.crossings(1)
        for count in self.size.fans:
            vocabulary = fan(count)

            def same(found: Any, vocabulary=vocabulary, half=count // 2) -> dict[str, Any]:
                # Half of the trajectories fills blocks of the same size: nothing may differ at all.
                some = score(scenes, vocabulary[:half], precision=self.precision).scores
                for name in (*METRICS, "progress_raw"):
                    if not np.array_equal(
                        getattr(found.scores, name)[:, :half], getattr(some, name)
                    ):
                        raise RuntimeError(f"{name} of a trajectory depends on the others")
                return shares(found.scores)

            self.add(
                f"track + score {count}",
                lambda v=vocabulary: score(scenes, v, precision=self.precision),
                same,
                curve="trajectories",
                x=count,
                num_proposals=count,
                **counts,
            )
        count = max(self.size.fans)
        expected = score(scenes, fan(count), precision=self.precision).scores
        self.add(
            f"track + score {count}, one program",
            self._one_program(scenes, fan(count)),
            lambda found: agree(
                "blocks and one program", found, jax.tree.map(lambda leaf: leaf[0], expected)
            ),
            num_proposals=count,
            **counts,
        )

        navsim_fans(self, scenes, fan(count), counts)

    def _one_program(self, scenes: ScenarioSet, vocabulary: np.ndarray) -> Callable[[], SubScores]:
        """Returns a call that scores a set in one block, with everything on the device before."""
        config = api.fit_config(scenes, PlannerConfig())
        scene = jax.tree.map(lambda leaf: leaf[0], self.place(scenes))
        at, ego = int(scenes.batch.num_history[0]), scenes.batch.ego
        pose = np.stack([ego.x[:, at], ego.y[:, at], ego.heading[:, at]], -1)
        local = to_local(vocabulary[None], "ego", pose, np.asarray(scenes.batch.origin))[0]
        columns = [jnp.asarray(local[..., i], self.dtype) for i in range(3)]
        whole = jax.jit(
            lambda scene, columns, params: functional.score_scene(
                scene, poses_only(*columns), params, config, tracker=True
            )[0]
        )
        params = jax.tree.map(lambda v: jnp.asarray(v, self.dtype), PlannerParams())
        return lambda: jax.block_until_ready(whole(scene, columns, params))

    def batches(self) -> None:
        """Many scenes in one call."""
        name, count = self.size.planners[-1]
        planner = planner_of(name, count)
        every, counts = self.crossings(max(self.size.batches))
        for number in self.size.batches:
            some = rows_of(every, slice(number))
            about = {"curve": "scenes", "x": number, "num_proposals": count, **counts}
            self._batch(f"{number} scenes x {count}", some, planner, **about)
        files = scene_files(self.folder, "mixed")[: self.size.mixed]
        self._batch(
            f"{self.size.mixed} mixed scenes x {count}", load(files), planner, num_proposals=count
        )
        navsim_batch(self, every, fan(TRAJECTORIES), **counts)
        expected = plan(every, planner, precision=self.precision).scores
        self.add(
            f"{len(every)} scenes x {count}, placed",
            self._placed(every, planner),
            lambda found: agree("placed scenes and plan()", found, expected),
            num_proposals=count,
            **counts,
        )

    def _batch(self, workload: str, scenes: ScenarioSet, planner: PlannerSpec, **more: Any) -> None:
        number = len(scenes)
        # The chunk is part of the program on an accelerator: one scene takes the same as many.
        run = lambda some: plan(
            some, planner, precision=self.precision, batching=BatchConfig(chunk=number)
        )

        def same(found: Any) -> dict[str, Any]:
            for row in sorted({0, number // 2, number - 1}):
                alone = run(rows_of(scenes, slice(row, row + 1)))
                for mine, other in zip(
                    jax.tree.leaves(found.plans), jax.tree.leaves(alone.plans), strict=True
                ):
                    if not np.array_equal(mine[row], other[0], equal_nan=mine.dtype.kind == "f"):
                        raise RuntimeError(f"a plan depends on the {number} scenes of its batch")
            return shares(found.scores)

        self.add(workload, lambda: run(scenes), same, scenes=number, **more)

    def _placed(self, scenes: ScenarioSet, planner: PlannerSpec) -> Callable[[], SubScores]:
        """Returns a call that plans in scenes which lie on the device, spread as `plan` does."""
        config = api.fit_config(scenes, planner.config)
        batch = self.place(scenes)
        params = jax.tree.map(lambda v: jnp.asarray(v, self.dtype), planner.params)
        one = lambda scene, params: functional.plan(scene, params, config).scores
        if jax.default_backend() != "cpu":
            together = jax.jit(jax.vmap(one, in_axes=(0, None)))
            return lambda: jax.block_until_ready(together(batch, params))
        alone = jax.jit(one)
        each = [jax.tree.map(lambda leaf, i=i: leaf[i], batch) for i in range(len(scenes))]
        pool = ThreadPoolExecutor(usable_cores())
        work = lambda scene: jax.block_until_ready(alone(scene, params))
        return lambda: jax.tree.map(lambda *rows: np.stack(rows), *pool.map(work, each))


def planner_of(name: str, count: int) -> PlannerSpec:
    """Returns a planner by the name that rows use."""
    return pdm_closed(count) if name == "PDM-Closed" else spdm(count)


def rows_of(scenes: ScenarioSet, rows: slice) -> ScenarioSet:
    """Returns some scenes of a set, with the padding of the whole."""
    return ScenarioSet(jax.tree.map(lambda leaf: leaf[rows], scenes.batch), scenes.infos[rows])


def shares(scores: SubScores) -> dict[str, Any]:
    """Returns which share of the valid trajectories fails each metric, and the mean score."""
    valid = np.asarray(scores.valid)
    failing = {
        name: float(np.mean(np.asarray(getattr(scores, name))[valid] < 1)) for name in METRICS
    }
    return {"failing": failing, "mean_score": float(np.mean(np.asarray(scores.total)[valid]))}


def agree(what: str, found: SubScores, expected: SubScores) -> dict[str, Any]:
    """Compares scores of two programs.

    Returns:
      The entries of `shares`, and the share of values that differ.

    Raises:
      RuntimeError: more than `PROGRAMS_DIFFER` of the values differ.
    """
    differing: Sequence[np.ndarray] = [
        np.abs(np.asarray(getattr(found, name)) - np.asarray(getattr(expected, name))) > 1e-3
        for name in (*METRICS, "total")
    ]
    share = float(np.mean(differing))
    if share > PROGRAMS_DIFFER:
        raise RuntimeError(f"{what} differ in {share:.2%} of the values")
    return {**shares(found), "differing": share}
