"""Scores trajectories in scenes at iteration 0: one scene as a pure function, a batch in blocks."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax import planner as planning
from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.batching import SceneRunner
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.decision import cast_params, poses_only
from spdm_jax.geometry import ego_box
from spdm_jax.padding import bucket
from spdm_jax.proposals.lanes import area_masks, drivable_lanes
from spdm_jax.results import ScenarioSet
from spdm_jax.scoring.aggregate import aggregate_sets
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.types import Array, EgoState, Scenario


class Surroundings(NamedTuple):
    """One scene at iteration 0 as the scorers see it.

    Attributes:
      ego: current state, scalars.
      world: what trajectories are scored against.
      lanes: `[L]` bool, lanes of the drivable map.
      parks: `[C]` bool, car parks of it.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    ego: EgoState
    world: World
    lanes: Array
    parks: Array
    overflow: Array


def surroundings(
    scene: Scenario,
    params: PlannerParams,
    config: PlannerConfig,
    forecast: ForecastPoses | None = None,
) -> Surroundings:
    """Looks around in one scene at iteration 0 (pure).

    Args:
      scene: one scenario on the device.
      params: traced settings, cast to the dtype of the scene.
      config: static settings.
      forecast: supplied forecast for all tracks, or None.
    """
    state = planning.init(scene, params, config)
    given = planning.observe(scene, 0).replace(forecast=forecast)
    seen = planning.see(scene, given, state, params, config)
    box = ego_box(given.ego, params.vehicle)
    lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    masks = area_masks(scene.map, scene.route.lane_on_route, lanes, parks)
    path = jax.tree.map(lambda v: v[0], state.paths)
    if config.progress_reference == "goal":
        path = state.goal
    world = World(scene.map.grid, masks, seen.forecast, path)
    return Surroundings(given.ego, world, lanes, parks, state.overflow | seen.red.overflow)


def score_scene(
    scene: Scenario,
    states: EgoState,
    params: PlannerParams,
    config: PlannerConfig,
    *,
    tracker: bool,
    forecast: ForecastPoses | None = None,
    valid: Array | None = None,
):
    """Scores trajectories `[P, 41]` in one scene at iteration 0 (pure).

    Args:
      scene: one scenario on the device.
      states: reference poses (tracked first) or full states (scored as they are).
      params: traced settings.
      config: static settings; `config.tracker` picks the tracker's fit.
      tracker: whether to track the poses with the LQR.
      forecast: supplied forecast for all tracks, or None.
      valid: `[P]` bool, trajectories that count; all if None.

    Returns:
      `SubScores`, the driven `EgoState` `[P, 41]`, the `AgentForecast` and the overflow flag.
    """
    params = cast_params(params, scene.ego.x.dtype)
    around = surroundings(scene, params, config, forecast)
    world = around.world
    if tracker:
        pose = (states.x, states.y, states.heading)
        states, _ = track(*pose, around.ego, params.vehicle, params.tracker, config.tracker)
    counts = jnp.ones(states.x.shape[0], bool) if valid is None else jnp.asarray(valid)
    scores = score_trajectories(states, counts, world, params.vehicle, params.scoring)
    return scores, states, world.forecast, around.overflow


BLOCK_SIZES = (16, 64, 256, 1024)
"""Proposals scored by one program, padded to the next size; more are scored block by block. The
sizes bound what has to fit into a processor's cache, and how many programs there are."""


class _Block(struct.PyTreeNode):
    """Part of a scene's trajectories: columns `[P, 41]`, `[P]` bool, and a supplied forecast."""

    columns: dict[str, Array]
    valid: Array
    forecast: ForecastPoses | None


def score_block(scene: Scenario, block: _Block, params: PlannerParams, static):
    config, tracks = static
    columns = block.columns
    return score_scene(
        scene,
        poses_only(**columns) if len(columns) == 3 else EgoState(**columns),
        params,
        config,
        tracker=tracks,
        forecast=block.forecast,
        valid=block.valid,
    )


def score_in_blocks(
    scenes: ScenarioSet,
    columns: dict[str, np.ndarray],
    forecast: ForecastPoses | None,
    params: PlannerParams,
    run: SceneRunner,
):
    """Scores columns `[B, P, 41]` of states; returns what `score_scene` returns, `[B, P, ...]`."""
    total, count = columns["x"].shape[:2]
    size = bucket(min(count, BLOCK_SIZES[-1]), BLOCK_SIZES)
    parts = -(-count // size)
    spare = parts * size - count

    def split(values: np.ndarray) -> np.ndarray:
        # Rows beyond the last one repeat it: finite, and not valid.
        if spare:
            values = np.concatenate([values, np.repeat(values[:, -1:], spare, axis=1)], axis=1)
        return values.reshape(total * parts, size, *values.shape[2:])

    valid = np.broadcast_to(np.arange(parts * size) < count, (total, parts * size))
    scene_of = np.repeat(np.arange(total), parts)
    blocks = _Block(
        columns=jax.tree.map(split, columns),
        valid=valid.reshape(total * parts, size),
        forecast=jax.tree.map(lambda values: values[scene_of], forecast),
    )
    found = run(scenes.batch, blocks, params, scene_of=scene_of)
    join = lambda v: v.reshape(total, parts * size, *v.shape[2:])[:, :count]
    scores, tracked = (jax.tree.map(join, tree) for tree in found[:2])
    first = lambda v: v.reshape(total, parts, *v.shape[1:])[:, 0]
    seen, overflow = (jax.tree.map(first, tree) for tree in found[2:])
    if parts > 1:
        # Progress and total relative to all proposals of a scene, not those of a block.
        combined = aggregate_sets(
            scores.no_at_fault_collision * scores.drivable_area * scores.driving_direction,
            scores.progress_raw,
            scores.time_to_collision,
            scores.comfort,
            scores.valid,
            params.scoring,
        )
        scores = scores.replace(progress=combined.progress, total=combined.total)
    return scores, tracked, seen, overflow
