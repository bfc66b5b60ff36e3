"""What a sweep computes in one scene, as a pure function: one step, read at every N_p.

Only what rows need leaves the device. The file is apart from the rest of the sweep because a stored
program is found by the source that it was made from.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax import planner
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.decision import cast_params
from spdm_jax.nested import read_nested
from spdm_jax.results import SCORE_COLUMNS
from spdm_jax.types import Array, Scenario

UNREAD = (
    "map.lanes.left_boundary",
    "map.lanes.right_boundary",
    "map.drivable",
    "map.crosswalks",
    "map.walkways",
    "map.stop_line",
)
"""Layers that no planner reads."""


@dataclass(frozen=True)
class Switches:
    """What a new value of compiles anew.

    Attributes:
      config: of the planner.
      poses: also return the chosen proposals' poses.
    """

    config: PlannerConfig
    poses: bool = False


class Shared(struct.PyTreeNode, kw_only=True):
    """What all scenes of a call have in common.

    Attributes:
      params: traced settings.
      num_proposals: `[C]` int32, every N_p to read.
      by_goal: `[C]` bool, see `spdm_jax.nested.progress_by_goal`.
    """

    params: PlannerParams
    num_proposals: Array
    by_goal: Array


class Poses(struct.PyTreeNode, kw_only=True):
    """Poses `[C, 41, 3]` of the chosen proposals, local frame: x, y, heading of the rear axle."""

    reference: Array
    tracked: Array


class Reading(struct.PyTreeNode, kw_only=True):
    """One scene, read at C numbers of proposals.

    Attributes:
      best: `[C]` int32, chosen proposal; the four fields that follow are its.
      stage, path, policy: `[C]` int32.
      target_speed: `[C]` m/s.
      scores: the fields `SCORE_COLUMNS` of the chosen proposal, `[C]` each.
      progress_centerline, progress_goal: `[C]` m.
      collision_track, ttc_track: `[C]` int32, track of the object, -1 if there is none.
      emergency_brake: `[C]` bool.
      num_valid: `[C]` int32, real proposals.
      mean_total: `[C]` over the real proposals.
      finite: `[C]` bool, all scores of real proposals are numbers.
      overflow: `[]` bool, a fixed buffer was too small.
      moved: `[]` bool, stage 2 went on from another lane than stage 1 alone would.
      poses: or None.
    """

    best: Array
    stage: Array
    path: Array
    policy: Array
    target_speed: Array
    scores: dict[str, Array]
    progress_centerline: Array
    progress_goal: Array
    collision_track: Array
    ttc_track: Array
    emergency_brake: Array
    num_valid: Array
    mean_total: Array
    finite: Array
    overflow: Array
    moved: Array
    poses: Poses | None


def read_scene(scene: Scenario, mine: None, shared: Shared, static: Switches) -> Reading:
    """Plans once at iteration 0 and reads the set at every N_p.

    Args:
      scene: one scenario on the device.
      mine: nothing.
      shared: traced settings and the N_p.
      static: static settings.
    """
    params = cast_params(shared.params, scene.ego.x.dtype)
    given = planner.observe(scene, 0)
    before = planner.init(scene, params, static.config)
    plans, after = planner.step(scene, given, before, params, static.config)
    proposals, tracked = plans.proposals, plans.tracked

    def read(num_proposals: Array, by_goal: Array):
        found = read_nested(plans, num_proposals, by_goal, given.ego, params)
        best, scores = found.best, found.scores
        track = lambda row: jnp.where(row[best] >= 0, plans.forecast.track[row[best]], -1)
        count = jnp.sum(scores.valid)
        total = jnp.where(scores.valid, scores.total, 0)
        poses = None
        if static.poses:
            pose = lambda s: jnp.stack([s.x[best], s.y[best], s.heading[best]], axis=-1)
            poses = Poses(reference=pose(proposals), tracked=pose(tracked))
        policy = proposals.policy[best]
        return Reading(
            best=best,
            stage=proposals.stage[best],
            path=proposals.path[best],
            policy=policy,
            target_speed=plans.target_speed[policy],
            scores={name: getattr(scores, name)[best] for name in SCORE_COLUMNS},
            progress_centerline=plans.progress_centerline[best],
            progress_goal=plans.progress_goal[best],
            collision_track=track(scores.collision_object),
            ttc_track=track(scores.ttc_object),
            emergency_brake=found.emergency_brake,
            num_valid=count.astype(jnp.int32),
            mean_total=jnp.sum(total) / jnp.maximum(count, 1).astype(total.dtype),
            finite=jnp.all(jnp.isfinite(total)),
            overflow=plans.overflow,
            moved=after.slot != before.slot,
            poses=poses,
        )

    rows = jax.vmap(read)(shared.num_proposals, shared.by_goal)
    # The last two are of the scene, not of a reading.
    return rows.replace(overflow=plans.overflow, moved=after.slot != before.slot)
