"""`soft_score`: the PDM score as a differentiable function of trajectories, for training losses."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.api import fit_config
from spdm_jax.config import DT, PlannerConfig, PlannerParams, Tracker
from spdm_jax.decision import cast_params, poses_only
from spdm_jax.padding import to_device
from spdm_jax.results import ScenarioSet
from spdm_jax.scene_score import surroundings
from spdm_jax.scoring.soft import SoftScores, SoftWorld, soft_score_trajectories
from spdm_jax.torch_bridge.task import Task, differentiated, place
from spdm_jax.tracking.lqr import track
from spdm_jax.trajectories import Frame, resample
from spdm_jax.types import Array, EgoState, Scenario, ScenarioBatch

__all__ = ["SoftScores", "soft_score", "soft_score_scene"]


def soft_score_scene(
    scene: Scenario,
    states: EgoState,
    params: PlannerParams,
    config: PlannerConfig,
    temperature: Array | float,
    *,
    tracker: bool,
    forecast: ForecastPoses | None = None,
    valid: Array | None = None,
) -> SoftScores:
    """Smooth scores of trajectories `[P, 41]` in one scene at iteration 0 (pure).

    The counterpart of `functional.score_scene`; gradients flow from the states, not from the scene.

    Args:
      scene: one scenario on the device.
      states: reference poses (tracked first) or full states (scored as they are), local frame.
      params: traced settings.
      config: static settings; `config.tracker` picks the tracker's fit.
      temperature: positive; see `soft_score`.
      tracker: whether to track the poses with the LQR.
      forecast: supplied forecast for all tracks, or None.
      valid: `[P]` bool, trajectories that count; all if None.

    Returns:
      `SoftScores` `[P]`.
    """
    dtype = scene.ego.x.dtype
    params = cast_params(params, dtype)
    around = jax.lax.stop_gradient(surroundings(scene, params, config, forecast))
    if tracker:
        pose = (states.x, states.y, states.heading)
        states, _ = track(*pose, around.ego, params.vehicle, params.tracker, config.tracker)
    world = SoftWorld(
        hard=around.world,
        lanes=scene.map.lanes.polygon,
        car_parks=scene.map.car_parks,
        lane_drivable=around.lanes,
        park_drivable=around.parks,
        lane_on_route=jnp.asarray(scene.route.lane_on_route),
    )
    counts = jnp.ones(states.x.shape[0], bool) if valid is None else jnp.asarray(valid)
    warmth = jnp.asarray(temperature, dtype)
    return soft_score_trajectories(states, counts, world, params.vehicle, params.scoring, warmth)


def soft_score(
    scenes: ScenarioSet,
    trajectories: Any,
    *,
    temperature: Array | float = 0.1,
    valid: Any = None,
    dt: float = DT,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
) -> SoftScores:
    """Scores trajectories with a smooth PDM score, for `jax.grad`, `jax.jit` and losses.

    Every rule becomes a sigmoid of its margin over the temperature; as the temperature goes to 0
    the scores go to those of `spdm_jax.score`. Values and gradients are finite everywhere. What is
    computed follows the type of `trajectories` (float32 or float64).

    Args:
      scenes: from `load` or `from_raw`; moved to the device once and kept there.
      trajectories: `[B, P, T, 3]` rear-axle poses (x, y, heading), or `[P, T, 3]` for the same ones
        in every scene. NumPy or JAX, traced or not.
      temperature: positive, traced or not: m for distances, a fraction of the bound for comfort.
      valid: `[B, P]` bool, trajectories that count (the others score 0); all if None.
      dt: their interval, s; resampled to 41 states at 0.1 s as `score` does.
      frame: "ego" (x forward from the current rear axle), "local" (the scene's own) or "global"
        (map coordinates; float64 only).
      tracker: "reference" or "corrected" tracks poses with the LQR and the bicycle first, as PDM
        does; "none" differentiates them.
      config: forecast mode, progress reference and caps.
      params: weights, thresholds, vehicle.

    Returns:
      `SoftScores` with JAX leaves `[B, P]`.

    Raises:
      ValueError: shape, type, interval or temperature is of no use, or a pose is not finite (which
        only shows outside `jit`).
    """
    if tracker not in ("reference", "corrected", "none"):
        raise ValueError(f"tracker is {tracker!r}; it must be 'reference', 'corrected' or 'none'")
    if frame not in ("ego", "local", "global"):
        raise ValueError(f"frame is {frame!r}; it must be 'ego', 'local' or 'global'")
    poses = _check_poses(trajectories, dt, len(scenes))
    _check_temperature(temperature)
    counts = jnp.ones(poses.shape[:2], bool) if valid is None else jnp.asarray(valid, bool)
    if counts.shape != poses.shape[:2]:
        raise ValueError(f"valid has shape {counts.shape}; expected {poses.shape[:2]}")
    if frame == "global":
        if poses.dtype != jnp.float64:
            raise ValueError(
                f"trajectories in map coordinates are {poses.dtype}; pass float64, or poses in the "
                "ego frame"
            )
        origin = np.pad(np.asarray(scenes.batch.origin), ((0, 0), (0, 1)))
        poses, frame = poses - origin[:, None, None], "local"
    config = fit_config(scenes, config or PlannerConfig())
    if tracker != "none":
        config = replace(config, tracker=tracker)
    task = Task(config, tracker != "none", frame, float(dt))
    placed = _on_device(scenes, poses.dtype)
    warmth = jnp.asarray(temperature, poses.dtype)
    return _score_batch(task, placed, poses, counts, params or PlannerParams(), warmth)


def _check_poses(trajectories: Any, dt: float, num_scenes: int) -> jax.Array:
    """Brings trajectories to `[B, P, T, 3]` of a floating type and checks what can be seen."""
    poses = jnp.asarray(trajectories)
    if not jnp.issubdtype(poses.dtype, jnp.floating) or poses.dtype.itemsize < 4:
        raise ValueError(f"trajectories is {poses.dtype}; pass float32 or float64")
    if poses.ndim == 3:
        poses = jnp.broadcast_to(poses, (num_scenes, *poses.shape))
    if poses.ndim != 4 or poses.shape[-1] != 3 or 0 in poses.shape:
        raise ValueError(
            f"trajectories has shape {poses.shape}; expected [B, P, T, 3] for {num_scenes} scenes, "
            "or [P, T, 3] for the same trajectories in every scene"
        )
    if poses.shape[0] != num_scenes:
        raise ValueError(
            f"trajectories holds {poses.shape[0]} scenes, the scenario set {num_scenes}; "
            "pass one set per scene, or [P, T, 3] for all of them"
        )
    if not dt > 0:
        raise ValueError(f"dt is {dt}; it must be a positive number of seconds")
    resample(np.zeros((1, 1, poses.shape[2], 3)), dt)  # says what is wrong with steps and interval
    if not isinstance(poses, Tracer):
        bad = np.argwhere(~np.isfinite(np.asarray(poses)))
        if len(bad):
            at = tuple(int(i) for i in bad[0])
            raise ValueError(
                f"trajectories{list(at)} is {poses[at]}; all poses must be finite "
                f"({len(bad)} values are not)"
            )
    return poses


def _check_temperature(temperature: Array | float) -> None:
    if isinstance(temperature, Tracer):
        return
    value = np.asarray(temperature)
    if value.shape != () or not np.isfinite(value) or not value > 0:
        raise ValueError(f"temperature is {temperature}; it must be one positive number")


class _Placed(dict[Any, ScenarioBatch]):
    """What a scenario set keeps on the device; a copied or pickled set starts with nothing."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (_Placed, ())


def _on_device(scenes: ScenarioSet, dtype: Any) -> ScenarioBatch:
    """The scenarios on the default device, moved there once per type."""
    cache = vars(scenes).setdefault("_placed", _Placed())
    if dtype not in cache:
        # The call may be inside a trace; what is kept must not be part of it.
        with jax.ensure_compile_time_eval():
            placed = to_device(scenes.batch, dtype)
            cache[dtype] = placed.replace(origin=jnp.zeros(placed.origin.shape, dtype))
    return cache[dtype]


@partial(jax.jit, static_argnums=0)
def _score_batch(
    task: Task,
    scenes: ScenarioBatch,
    poses: Array,
    valid: Array,
    params: PlannerParams,
    temperature: Array,
) -> SoftScores:
    """Smooth scores `[B, P]` of `[B, P, T, 3]`."""

    def one(given: tuple[Scenario, Array, Array]) -> SoftScores:
        scene, mine, counts = given
        ego = jax.tree.map(lambda leaf: leaf[scene.num_history], scene.ego)
        states = poses_only(*jnp.moveaxis(place(mine, ego, task), -1, 0))
        if not task.tracks:
            states = differentiated(states, ego)
        return soft_score_scene(
            scene, states, params, task.config, temperature, tracker=task.tracks, valid=counts
        )

    # On a CPU loops over polygons and contacts run as long as each scene needs them.
    each: Callable[..., Any] = (
        partial(jax.lax.map, one) if jax.default_backend() == "cpu" else jax.vmap(one)
    )
    return each((scenes, poses, valid))
