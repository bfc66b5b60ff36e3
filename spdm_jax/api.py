"""The public functions: load scenarios, plan in them, score trajectories in them.

Everything here works on the host: NumPy in and out, checks before any device work. The pure
functions underneath are in `spdm_jax.functional`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, overload

import jax
import numpy as np

from spdm_jax import planner as planning
from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.batching import BatchConfig, Precision, SceneRunner
from spdm_jax.config import (
    NUM_FORECAST,
    PlannerConfig,
    PlannerParams,
    PlannerSpec,
    Tracker,
    spdm,
)
from spdm_jax.io.build import build_scenario, start_at
from spdm_jax.io.crop import MapIndex
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.navsim.evaluate import score_frames
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.navsim.from_scenario import from_scenarios
from spdm_jax.navsim.results import NavsimScoreSet
from spdm_jax.padding import PATH_ROOM, PaddingConfig, batch, bucket, check_buckets, sizes_of
from spdm_jax.results import Failure, PlanSet, ScenarioSet, ScoreSet
from spdm_jax.scene_score import score_block, score_in_blocks
from spdm_jax.scoring.profile import profile_named
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
from spdm_jax.types import Scenario, ScenarioInfo


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
            check_buckets(sizes_of(scenario), padding or PaddingConfig(), info.token)
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
    return replace(config, max_path_points=bucket(needed, PATH_ROOM))


def _forecast_poses(forecast, scenes: ScenarioSet) -> ForecastPoses | None:
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
    return ForecastPoses(*(clean[..., i] for i in range(3)), valid=valid)


def _plan_one(scene, forecast, params, config):
    return planning.plan(scene, params, config, forecast)


def plan(
    scenes: ScenarioSet,
    planner: PlannerSpec | None = None,
    *,
    precision: Precision = "f32",
    forecast=None,
    batching: BatchConfig | None = None,
) -> PlanSet:
    """Plans once in every scene, at iteration 0.

    Args:
      scenes: from `load` or `from_raw`.
      planner: `spdm(...)` or `pdm_closed(...)`; SPDM with 60 proposals if None.
      precision: "f32", or "f64" for comparisons with a reference.
      forecast: `[B, A, 41, 3]` supplied forecast instead of the planner's own.
      batching: how scenes are spread over cores and devices.

    Returns:
      `PlanSet` with NumPy leaves.
    """
    planner = planner or spdm()
    config = fit_config(scenes, planner.config)
    run = SceneRunner(_plan_one, config, precision=precision, config=batching)
    result = run(scenes.batch, _forecast_poses(forecast, scenes), planner.params)
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


def to_navsim(
    scenes: ScenarioSet | NavsimSet,
    *,
    precision: Precision = "f32",
    batching: BatchConfig | None = None,
) -> NavsimSet:
    """Makes NAVSIM's frames of scenarios: iteration 0 of each, once for a set and a precision.

    Args:
      scenes: from `load` or `from_raw`; frames are returned as they are.
      precision: of PDM-Closed, which plans the reference trajectory.
      batching: how scenes are spread over cores and devices.

    Raises:
      ValueError: no scenario records enough.
    """
    if isinstance(scenes, NavsimSet):
        return scenes
    made = vars(scenes).setdefault("_as_navsim", {})
    if precision not in made:
        config = fit_config(scenes, PlannerConfig())
        made[precision] = from_scenarios(scenes, config, precision=precision, batching=batching)
    return made[precision]


def scenarios_only(scenes: ScenarioSet | NavsimSet) -> ScenarioSet:
    """Returns scenarios.

    Raises:
      ValueError: they are NAVSIM's frames, which the "tuplan" profile cannot score.
    """
    if isinstance(scenes, NavsimSet):
        raise ValueError(
            "profile is 'tuplan', but the scenes are NAVSIM's frames; pass profile='navsim1' or "
            "'navsim2', or scenarios"
        )
    return scenes


def refuse_foreign(**options: Any) -> None:
    """Refuses options that NAVSIM's profiles would silently ignore.

    Raises:
      ValueError: names the first one that was given.
    """
    for name, value in options.items():
        if value is not None and not (name == "tracker" and value == "reference"):
            raise ValueError(
                f"{name} does not apply to NAVSIM's profiles: they replay the log and track with "
                f"the reference's tracker. Leave {name} out"
            )


def _of_frames(values: Any, axes: int, scenes: ScenarioSet | NavsimSet, frames: NavsimSet) -> Any:
    """Leaves out what belongs to scenarios that no frame could be made of.

    Args:
      values: one entry per scenario if it has at least `axes` axes.
      axes: see above.
      scenes: as given.
      frames: made of them.
    """
    if len(frames) == len(scenes) or np.ndim(values) < axes:
        return values
    kept = set(frames.tokens)
    return as_array(values)[[info.token in kept for info in scenes.infos]]


NavsimProfile = Literal["navsim1", "navsim2", "navsim2_unfiltered"]


@overload
def score(
    scenes: ScenarioSet | NavsimSet,
    trajectories,
    *,
    dt: float | None = None,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    forecast=None,
    batching: BatchConfig | None = None,
    profile: Literal["tuplan"] = "tuplan",
) -> ScoreSet: ...


@overload
def score(
    scenes: ScenarioSet | NavsimSet,
    trajectories,
    *,
    profile: NavsimProfile,
    dt: float | None = None,
    frame: Frame = "ego",
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    batching: BatchConfig | None = None,
    previous=None,
) -> NavsimScoreSet: ...


def score(
    scenes: ScenarioSet | NavsimSet,
    trajectories,
    *,
    dt: float | None = None,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    forecast=None,
    batching: BatchConfig | None = None,
    profile: str = "tuplan",
    previous=None,
) -> ScoreSet | NavsimScoreSet:
    """Scores any trajectories with the PDM score.

    Args:
      scenes: from `load` or `from_raw`; for NAVSIM's profiles also from `load_navsim`.
      trajectories: `[B, P, T, 3]` rear-axle poses (x, y, heading), or `[P, T, 3]` for the same ones
        in every scene (a vocabulary), or full `[..., 11]` states, which are scored as they are.
        NumPy or JAX.
      dt: their interval, s (0.1 if None); resampled to 41 states at 0.1 s. Without the current
        pose (8 poses at 0.5 s) it is put in front. NAVSIM's profiles take 0.5 for 8 poses if None,
        and look at the poses at 0.5, 1.0, ... 4.0 s.
      frame: "ego" (x forward from the current rear axle), "local" (the scene's own) or "global"
        (map coordinates, float64).
      tracker: "reference" or "corrected" tracks poses with the LQR and the bicycle first, as PDM
        does; "none" differentiates them.
      config: forecast mode, progress reference and caps.
      params: weights, thresholds, vehicle.
      precision: "f32" or "f64".
      forecast: `[B, A, 41, 3]` supplied forecast instead of the configured one.
      batching: how scenes are spread over cores and devices.
      profile: whose rules: "tuplan", "navsim1" (PDMS), "navsim2" (EPDMS) or "navsim2_unfiltered"
        (without the human filter). NAVSIM's replay the log and track by the reference: `tracker`,
        `config` and `forecast` do not apply.
      previous: for "navsim2", plans of the frame before; see `navsim.evaluate.score_frames`.

    Returns:
      `ScoreSet` (or, for NAVSIM's profiles, `NavsimScoreSet`) with NumPy leaves `[B, P]`.

    Raises:
      ValueError: shapes, steps or interval do not fit, a value is not finite, or an option does not
        apply to the profile.
    """
    if profile != "tuplan":
        refuse_foreign(tracker=tracker, config=config, forecast=forecast)
        rules = profile_named(profile)
        frames = to_navsim(scenes, precision=precision, batching=batching)
        return score_frames(
            frames,
            _of_frames(trajectories, 4, scenes, frames),
            rules,
            dt=dt,
            frame=frame,
            previous=_of_frames(previous, 3, scenes, frames),
            params=None if params is None else params.scoring,
            precision=precision,
            batching=batching,
        )
    if previous is not None:
        raise ValueError("previous is for profile='navsim2'; the tuplan score does not look at it")
    scenes = scenarios_only(scenes)
    dt = 0.1 if dt is None else dt
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
    if tracker == "none" and not full:
        local = untracked_states(local, current)
    columns = {STATE_COLUMNS[i]: local[..., i] for i in range(local.shape[-1])}
    tracks = not full and tracker != "none"
    run = SceneRunner(score_block, (config, tracks), precision=precision, config=batching)
    scores, tracked, seen, overflow = score_in_blocks(
        scenes, columns, _forecast_poses(forecast, scenes), params or PlannerParams(), run
    )
    return ScoreSet(
        scores=scores,
        tracked=tracked,
        forecast=seen,
        infos=scenes.infos,
        failures=scenes.failures,
        overflow=overflow,
    )
