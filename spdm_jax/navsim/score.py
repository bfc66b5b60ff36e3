"""NAVSIM's PDM score of predicted trajectories in one frame (pure; `jax.vmap` gives the batch)."""

from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp

from spdm_jax.config import ScoringParams, TrackerParams
from spdm_jax.geometry import principal, unwrap_masked, wrap
from spdm_jax.navsim.observation import replay
from spdm_jax.navsim.types import NavsimScene, NavsimScores, Sampling, Terms
from spdm_jax.scoring.aggregate import relative_progress
from spdm_jax.scoring.history_comfort import extended_comfort
from spdm_jax.scoring.profile import Profile, Term
from spdm_jax.scoring.score import Judged, World, judge
from spdm_jax.tracking.lqr import track
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import Array, EgoState

_UNFILTERED: tuple[Term, ...] = ("extended_comfort",)
"""Sub-scores that the human filter leaves alone."""


class Poses(NamedTuple):
    """Rear-axle poses `[N, T]`, local frame, 0.1 s apart."""

    x: jax.Array
    y: jax.Array
    heading: jax.Array


def reference_poses(poses: Array, ego: EgoState, sampling: Sampling) -> Poses:
    """Brings predicted poses to 0.1 s.

    Args:
      poses: `[N, 8, 3]` in the frame of the ego's rear axle, 0.5 s apart, the first one at 0.5 s.
      ego: `[]` state they start from.
      sampling: of the frame.

    Source: NAVSIM `transform_trajectory` and `get_trajectory_as_array`: linear between poses.
    """
    poses = jnp.concatenate([jnp.zeros_like(poses[:, :1]), poses], axis=1)
    cos, sin = jnp.cos(ego.heading), jnp.sin(ego.heading)
    x = ego.x + cos * poses[..., 0] - sin * poses[..., 1]
    y = ego.y + sin * poses[..., 0] + cos * poses[..., 1]
    heading = wrap(ego.heading + poses[..., 2])
    heading = unwrap_masked(heading, jnp.ones(heading.shape, bool))

    def mix(nodes: jax.Array) -> jax.Array:
        start = nodes[:, sampling.left]
        return start + sampling.share * (nodes[:, sampling.left + 1] - start)

    return Poses(mix(x), mix(y), principal(mix(heading)))


def _track(poses: Poses, start: EgoState, scene: NavsimScene) -> EgoState:
    tracked, _ = track(*poses, start, scene.vehicle, TrackerParams())
    return tracked


def simulate(scene: NavsimScene, poses: Array) -> EgoState:
    """Drives predicted trajectories: interpolation, LQR tracker, kinematic bicycle.

    Args:
      scene: one frame.
      poses: `[N, 8, 3]` in the ego frame, 0.5 ... 4.0 s.

    Returns:
      States `[N, T]` at the rear axle, local frame.

    Source: NAVSIM `pdm_score`; tuplan_garage `PDMSimulator`.
    """
    return _track(reference_poses(poses, scene.ego, scene.sampling), scene.ego, scene)


def simulate_previous(scene: NavsimScene) -> EgoState:
    """Drives the plan of the previous frame from its own start, `[Q, T]`."""
    previous = scene.previous
    poses = reference_poses(previous.poses, previous.ego, previous.sampling)
    return _track(poses, previous.ego, scene)


def simulate_reference(scene: NavsimScene) -> EgoState:
    """Drives PDM-Closed's trajectory, `[1, T]`."""
    poses = Poses(*jnp.moveaxis(scene.reference, -1, 0)[:, None])
    return _track(poses, scene.ego, scene)


def score_trajectories(
    scene: NavsimScene,
    poses: Array,
    profile: Profile,
    params: ScoringParams | None = None,
) -> NavsimScores:
    """Scores predicted trajectories.

    Args:
      scene: one frame.
      poses: `[N, 8, 3]` in the ego frame, 0.5 ... 4.0 s. One that is not finite scores 0 and leaves
        the others alone.
      profile: NAVSIM1, NAVSIM2 or NAVSIM2_UNFILTERED; static.
      params: thresholds; NAVSIM's if None.

    Returns:
      `NavsimScores` `[N]`. Scores of a trajectory do not depend on the others.

    Source: NAVSIM `pdm_score` and `PDMScorer` (v1.1, v2.2).
    """
    finite = jnp.all(jnp.isfinite(poses), axis=(1, 2))
    states = simulate(scene, jnp.where(finite[:, None, None], poses, 0))
    return _score(scene, states, finite, profile, params)


def score_states(
    scene: NavsimScene,
    states: Array,
    profile: Profile,
    params: ScoringParams | None = None,
) -> NavsimScores:
    """Scores trajectories that are given as states, without tracker.

    Args:
      scene: one frame.
      states: `[N, 41, 11]` rear-axle states in nuPlan's columns, local frame, 0.1 s apart.
      profile: see `score_trajectories`.
      params: see `score_trajectories`.

    Returns:
      `NavsimScores` `[N]`.
    """
    columns = {name: states[..., i] for i, name in enumerate(STATE_COLUMNS)}
    return _score(scene, EgoState(**columns), jnp.ones(len(states), bool), profile, params)


def _score(
    scene: NavsimScene,
    states: EgoState,
    finite: jax.Array,
    profile: Profile,
    params: ScoringParams | None,
) -> NavsimScores:
    if (profile.observation, profile.areas, profile.progress_norm) != ("replay", "blocks", "pair"):
        raise ValueError(f"profile is {profile.name}; NAVSIM's frames need navsim1 or navsim2")
    params = ScoringParams() if params is None else params
    states, valid = _finite(states, finite, scene.ego)
    with jax.named_scope("reference"):
        # The reference and the human are judged with the others: the first two rows.
        human = simulate(scene, scene.human_poses[None])
        rows = (simulate_reference(scene), human, states)
        together = jax.tree.map(lambda *v: jnp.concatenate(v), *rows)
    with jax.named_scope("replay"):
        forecast = replay(scene.objects, scene.ego, scene.vehicle, profile)
    world = World(scene.grid, scene.masks, forecast, scene.centerline, scene.red, scene.past)
    judged = judge(together, world, scene.vehicle, params, profile)
    terms = _terms(judged, profile)
    terms = terms.replace(comfort=terms.comfort.at[1].set(_unless_past(terms.comfort[1], profile)))
    multiplier = _product(terms, profile)
    weighted = judged.progress_raw * multiplier
    progress = relative_progress(
        judged.progress_raw,
        multiplier,
        jnp.maximum(weighted[0], weighted),
        profile.progress_threshold,
        multiplied=profile.progress_multiplied,
    )
    terms = terms.replace(progress=progress.astype(states.x.dtype))
    # Scored alone, the human is the best there is.
    human = jax.tree.map(lambda v: jnp.where(scene.has_human, v[1], 1), terms)
    human = human.replace(progress=jnp.ones_like(human.progress))
    raw, judged = jax.tree.map(lambda v: v[2:], (terms, judged))
    has_extended = jnp.asarray(False)
    if profile.judges("extended_comfort"):
        with jax.named_scope("extended comfort"):
            has_extended = scene.previous.present
            alike = _extended(scene, states)
            raw = raw.replace(extended_comfort=jnp.where(has_extended, alike, 1))
    raw = jax.tree.map(lambda v: jnp.where(valid, v, 0), raw)
    filtered = _filtered(raw, human, profile) if profile.human_filter else raw
    filtered = jax.tree.map(lambda v: jnp.where(valid, v, 0), filtered)
    total, without, unfiltered = (
        jnp.where(has, _total(of, profile, True), _total(of, profile, False))
        for of, has in ((filtered, has_extended), (filtered, False), (raw, has_extended))
    )
    areas = judged.areas
    return NavsimScores(
        total=total,
        total_without_extended_comfort=without,
        total_unfiltered=unfiltered,
        raw=raw,
        filtered=filtered,
        human=human,
        progress_raw=jnp.where(valid, judged.progress_raw, 0),
        comfort_flags=judged.comfort_flags & valid[:, None],
        collision_index=judged.collision.time_index,
        ttc_index=judged.ttc.time_index,
        red_light_index=judged.red_index,
        multiple_lanes=areas.multiple_lanes,
        non_drivable=areas.non_drivable,
        oncoming=areas.oncoming,
        has_extended_comfort=has_extended,
        valid=valid,
    )


def _finite(states: EgoState, finite: jax.Array, ego: EgoState) -> tuple[EgoState, jax.Array]:
    """Puts the standing ego in place of trajectories that are not finite."""
    for values in jax.tree.leaves(states):
        finite &= jnp.all(jnp.isfinite(values), axis=-1)
    stand = jax.tree.map(lambda v, now: jnp.where(finite[:, None], v, now), states, ego)
    return stand, finite


def _terms(judged: Judged, profile: Profile) -> Terms:
    steps = judged.areas.oncoming.shape[1]
    dtype = judged.progress_raw.dtype
    one = jnp.ones_like(judged.progress_raw)
    return Terms(
        no_at_fault_collision=judged.collision.score,
        drivable_area=judged.drivable,
        driving_direction=judged.direction,
        traffic_light=(judged.red_index >= steps).astype(dtype),
        progress=one,
        time_to_collision=judged.ttc.score,
        lane_keeping=judged.lane_keeping,
        comfort=jnp.all(judged.comfort_flags, axis=-1).astype(dtype),
        extended_comfort=one,
    )


def _unless_past(comfort: jax.Array, profile: Profile) -> jax.Array:
    """The human's comfort; with history it is 1, since nobody gives the human a past."""
    return jnp.ones_like(comfort) if profile.comfort == "history" else comfort


def _extended(scene: NavsimScene, states: EgoState) -> jax.Array:
    earlier = simulate_previous(scene)
    num, plans = states.x.shape[0], earlier.x.shape[0]
    if plans not in (1, num):
        raise ValueError(
            f"the scene holds {plans} previous plans for {num} trajectories; pass one, or one each"
        )
    earlier = jax.tree.map(lambda v: jnp.broadcast_to(v, (num, v.shape[1])), earlier)
    return extended_comfort(states, earlier, scene.previous.steps)


def _product(terms: Terms, profile: Profile) -> jax.Array:
    product = jnp.ones_like(terms.progress)
    for name in profile.multipliers:
        product *= getattr(terms, name)
    return product


def _filtered(terms: Terms, human: Terms, profile: Profile) -> Terms:
    """Sub-scores in which nobody is held to what the human failed."""
    return terms.replace(
        **{
            name: jnp.where(getattr(human, name) == 0, 1, getattr(terms, name))
            for name in get_args(Term)
            if profile.judges(name) and name not in _UNFILTERED
        }
    )


def _total(terms: Terms, profile: Profile, extended: bool) -> jax.Array:
    weights = {name: w for name, w in profile.weights if extended or name != "extended_comfort"}
    mean = sum(w * getattr(terms, name) for name, w in weights.items()) / sum(weights.values())
    return (_product(terms, profile) * mean).astype(terms.progress.dtype)
