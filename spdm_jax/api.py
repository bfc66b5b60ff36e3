"""The public functions: load scenarios, plan in them, score trajectories in them.

Everything here works on the host: NumPy in and out, checks before any device work. The pure
functions underneath are in `spdm_jax.functional`.
"""

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax import planner as planning
from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.config import (
    NUM_FORECAST,
    PlannerConfig,
    PlannerParams,
    PlannerSpec,
    Tracker,
    spdm,
)
from spdm_jax.decision import cast_params
from spdm_jax.geometry import ego_box
from spdm_jax.io.build import build_scenario, start_at
from spdm_jax.io.crop import MapIndex
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.padding import PaddingConfig, batch, bucket, to_device
from spdm_jax.proposals.lanes import area_masks, drivable_lanes
from spdm_jax.results import Failure, PlanSet, ScenarioSet, ScoreSet
from spdm_jax.scoring.score import World, score_trajectories
from spdm_jax.tracking.lqr import track
from spdm_jax.trajectories import (
    STATE_COLUMNS,
    Frame,
    as_array,
    check_trajectories,
    resample,
    to_ego,
    to_local,
    untracked_states,
)
from spdm_jax.types import EgoState, Scenario, ScenarioInfo

Precision = Literal["f32", "f64"]
_PATH_BUCKETS = (256, 512, 1024, 2048, 4096)


def load(
    source: str | Path | Iterable[str | Path],
    *,
    limit: int | None = None,
    tokens: Sequence[str] | None = None,
    iteration: int = 0,
    padding: PaddingConfig | None = None,
) -> ScenarioSet:
    """Loads packed scenarios (`.npz` files written by `spdm pack`).

    Args:
      source: a folder of scenario files, one file, or several files.
      limit: at most that many, in the order of file names.
      tokens: only these.
      iteration: start at a later iteration (the route is corrected anew there).
      padding: bucket sizes.

    Returns:
      `ScenarioSet`; files that cannot be read are listed in its `failures`.

    Raises:
      ScenarioError: nothing could be loaded.
    """
    files = _files(source)
    if tokens is not None:
        by_token = {path.stem: path for path in files}
        missing = [token for token in tokens if token not in by_token]
        if missing:
            raise ScenarioError(f"{source}: no scenario file for token {missing[0]!r}")
        files = [by_token[token] for token in tokens]
    pairs, failures = [], []
    for path in files[:limit]:
        try:
            scenario, info = read_scenario(path)
            pairs.append((start_at(scenario, info, iteration) if iteration else scenario, info))
        except (ScenarioError, OSError) as error:
            failures.append(Failure(path.stem, str(error)))
    return _collect(pairs, failures, padding, str(source))


def from_raw(
    scenarios: Iterable[RawScenario], *, padding: PaddingConfig | None = None
) -> ScenarioSet:
    """Builds a set straight from a reader or the scene generator, without files.

    Raises:
      ScenarioError: nothing could be built.
    """
    pairs, failures = [], []
    index: MapIndex | None = None
    for raw in scenarios:
        try:
            # Scenarios of one log share its map: what is known of it is kept from one to the next.
            if index is None or index.map is not raw.map:
                index = MapIndex(raw.map)
            pairs.append(build_scenario(raw, index=index))
        except ScenarioError as error:
            failures.append(Failure(raw.token, str(error)))
    return _collect(pairs, failures, padding, "the given scenarios")


def _files(source) -> list[Path]:
    if isinstance(source, str | Path):
        path = Path(source)
        if path.is_dir():
            files = sorted(path.glob("*.npz"))
            if not files:
                raise ScenarioError(
                    f"{path}: no .npz scenario files; write them with `spdm pack SRC {path}`"
                )
            return files
        if not path.exists():
            raise ScenarioError(f"{path}: no such file or folder")
        return [path]
    return [Path(path) for path in source]


def _collect(
    pairs: list[tuple[Scenario, ScenarioInfo]],
    failures: list[Failure],
    padding: PaddingConfig | None,
    source: str,
) -> ScenarioSet:
    """Stacks what fits the buckets; the rest becomes failures."""
    fitting = []
    for scenario, info in pairs:
        try:
            batch([scenario], padding, tokens=[info.token])
            fitting.append((scenario, info))
        except ValueError as error:
            failures.append(Failure(info.token, str(error)))
    if not fitting:
        reason = f": {failures[0].token}: {failures[0].reason}" if failures else ""
        raise ScenarioError(f"{source}: no usable scenario{reason}")
    seen: set[str] = set()
    for _, info in fitting:
        if info.token in seen:
            raise ScenarioError(f"{source}: token {info.token!r} occurs twice; tokens must differ")
        seen.add(info.token)
    infos = [info for _, info in fitting]
    stacked = batch([s for s, _ in fitting], padding, tokens=[i.token for i in infos])
    return ScenarioSet(stacked, infos, failures)


def _precision(precision: Precision):
    """dtype, and the context in which JAX may use it."""
    if precision == "f64":
        return jnp.float64, jax.enable_x64(True)
    if precision == "f32":
        return jnp.float32, nullcontext()
    raise ValueError(f"precision is {precision!r}; it must be 'f32' or 'f64'")


def fit_config(scenes: ScenarioSet, config: PlannerConfig) -> PlannerConfig:
    """Gives paths just the room that the longest lane sequence of the set needs."""
    route, count = scenes.batch.route, np.asarray(scenes.batch.map.lanes.centerline.count)
    needed = 2
    for sequences in (route.centerline_lanes, route.goal_lanes, route.branch_lanes):
        sequences = np.asarray(sequences)
        points = np.where(
            sequences >= 0,
            np.take_along_axis(count[:, None, :], np.maximum(sequences, 0), axis=2),
            0,
        )
        needed = max(needed, int(points.sum(-1).max()))
    return replace(config, max_path_points=bucket(needed, _PATH_BUCKETS))


def _forecast_poses(forecast, scenes: ScenarioSet, dtype) -> ForecastPoses | None:
    if forecast is None:
        return None
    values = np.asarray(forecast, np.float64)
    tracks = scenes.batch.tracks.valid.shape[1]
    expected = (len(scenes), tracks, NUM_FORECAST, 3)
    if values.shape != expected:
        raise ValueError(
            f"forecast has shape {values.shape}, expected {expected}: x, y, heading (local frame) "
            "of every track of the batch at 0, 0.2, ... 8.0 s; NaN where it does not exist"
        )
    valid = np.all(np.isfinite(values), axis=-1)
    clean = np.where(valid[..., None], values, 0.0)
    return ForecastPoses(
        *(jnp.asarray(clean[..., i], dtype) for i in range(3)), valid=jnp.asarray(valid)
    )


@partial(jax.jit, static_argnames=("config",))
def _plan_batch(batch, params, forecast, config):
    # One scene after the other: on a CPU a plain vmap over scenes is slower, and the results do
    # not depend on the neighbours.
    def one(args):
        return planning.plan(args[0], params, config, args[1])

    return jax.lax.map(one, (batch, forecast))


def _to_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def plan(
    scenes: ScenarioSet,
    planner: PlannerSpec | None = None,
    *,
    precision: Precision = "f32",
    forecast=None,
) -> PlanSet:
    """Plans once in every scene, at iteration 0.

    Args:
      scenes: from `load` or `from_raw`.
      planner: `spdm(...)` or `pdm_closed(...)`; SPDM with 60 proposals if None.
      precision: "f32", or "f64" for comparisons with a reference.
      forecast: `[B, A, 41, 3]` supplied forecast instead of the planner's own.

    Returns:
      `PlanSet` with NumPy leaves.
    """
    planner = planner or spdm()
    dtype, context = _precision(precision)
    config = fit_config(scenes, planner.config)
    with context:
        device = to_device(scenes.batch, dtype).replace(origin=jnp.zeros((len(scenes), 2), dtype))
        params = cast_params(planner.params, dtype)
        poses = _forecast_poses(forecast, scenes, dtype)
        result = _to_numpy(_plan_batch(device, params, poses, config=config))
    return PlanSet(
        scores=result.scores,
        tracked=result.tracked,
        forecast=result.forecast,
        infos=scenes.infos,
        failures=scenes.failures,
        overflow=result.overflow,
        plans=result,
        name=planner.name,
    )


def score_scene(
    scene: Scenario,
    states: EgoState,
    params: PlannerParams,
    config: PlannerConfig,
    *,
    tracker: bool,
    forecast: ForecastPoses | None = None,
):
    """Scores trajectories `[P, 41]` in one scene at iteration 0 (pure).

    Args:
      scene: one scenario on the device.
      states: reference poses (tracked first) or full states (scored as they are).
      params: traced settings.
      config: static settings; `config.tracker` picks the tracker's fit.
      tracker: whether to track the poses with the LQR.
      forecast: supplied forecast for all tracks, or None.

    Returns:
      `SubScores`, the driven `EgoState` `[P, 41]`, the `AgentForecast` and the overflow flag.
    """
    params = cast_params(params, scene.ego.x.dtype)
    state = planning.init(scene, params, config)
    given = planning.observe(scene, 0).replace(forecast=forecast)
    seen = planning.see(scene, given, state, params, config)
    box = ego_box(given.ego, params.vehicle)
    lanes, parks = drivable_lanes(scene.map, box.x, box.y, params.map_radius)
    masks = area_masks(scene.map, scene.route.lane_on_route, lanes, parks)
    path = jax.tree.map(lambda v: v[0], state.paths)
    if config.progress_reference == "goal":
        path = state.goal
    if tracker:
        pose = (states.x, states.y, states.heading)
        states, _ = track(*pose, given.ego, params.vehicle, params.tracker, config.tracker)
    world = World(scene.map.grid, masks, seen.forecast, path)
    valid = jnp.ones(states.x.shape[0], bool)
    scores = score_trajectories(states, valid, world, params.vehicle, params.scoring)
    return scores, states, seen.forecast, state.overflow | seen.red.overflow


@partial(jax.jit, static_argnames=("config", "tracker"))
def _score_batch(batch, states, params, forecast, config, tracker):
    def one(args):
        scene, mine, poses = args
        return score_scene(scene, mine, params, config, tracker=tracker, forecast=poses)

    return jax.lax.map(one, (batch, states, forecast))


def score(
    scenes: ScenarioSet,
    trajectories,
    *,
    dt: float = 0.1,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    forecast=None,
) -> ScoreSet:
    """Scores any trajectories with the PDM score.

    Args:
      scenes: from `load` or `from_raw`.
      trajectories: `[B, P, T, 3]` rear-axle poses (x, y, heading), or `[P, T, 3]` for the same ones
        in every scene (a vocabulary), or full `[..., 11]` states, which are scored as they are.
        NumPy or JAX.
      dt: their interval, s; resampled to 41 states at 0.1 s. Without the current pose (8 poses at
        0.5 s) it is put in front.
      frame: "ego" (x forward from the current rear axle), "local" (the scene's own) or "global"
        (map coordinates, float64).
      tracker: "reference" or "corrected" tracks poses with the LQR and the bicycle first, as PDM
        does; "none" differentiates them.
      config: forecast mode, progress reference and caps.
      params: weights, thresholds, vehicle.
      precision: "f32" or "f64".
      forecast: `[B, A, 41, 3]` supplied forecast instead of the configured one.

    Returns:
      `ScoreSet` with NumPy leaves `[B, P]`.

    Raises:
      ValueError: shapes, steps or interval do not fit, or a value is not finite.
    """
    config = config or PlannerConfig()
    if tracker not in ("reference", "corrected", "none"):
        raise ValueError(f"tracker is {tracker!r}; it must be 'reference', 'corrected' or 'none'")
    if tracker != "none":
        config = replace(config, tracker=tracker)
    config = fit_config(scenes, config)
    values = check_trajectories(as_array(trajectories), dt, len(scenes))
    now = np.asarray(scenes.batch.num_history)
    row = np.arange(len(scenes))
    current = jax.tree.map(lambda v: np.asarray(v)[row, now], scenes.batch.ego)
    ego_pose = np.stack([current.x, current.y, current.heading], -1)
    origin = np.asarray(scenes.batch.origin)
    local = to_local(resample(to_ego(values, frame, ego_pose, origin), dt), "ego", ego_pose, origin)
    full = values.shape[-1] == len(STATE_COLUMNS)
    if not full:
        local = (
            untracked_states(local, current)
            if tracker == "none"
            else np.concatenate([local, np.zeros((*local.shape[:-1], 8))], axis=-1)
        )
    dtype, context = _precision(precision)
    with context:
        device = to_device(scenes.batch, dtype).replace(origin=jnp.zeros((len(scenes), 2), dtype))
        states = EgoState(
            **{name: jnp.asarray(local[..., i], dtype) for i, name in enumerate(STATE_COLUMNS)}
        )
        result = _score_batch(
            device,
            states,
            cast_params(params or PlannerParams(), dtype),
            _forecast_poses(forecast, scenes, dtype),
            config=config,
            tracker=not full and tracker != "none",
        )
    scores, tracked, seen, overflow = _to_numpy(result)
    return ScoreSet(
        scores=scores,
        tracked=tracked,
        forecast=seen,
        infos=scenes.infos,
        failures=scenes.failures,
        overflow=overflow,
    )
