"""Synthetic scenes, and hand-made plans for them: pictures are tested without planning."""

from collections.abc import Callable

import numpy as np
import pytest

import spdm_jax
from spdm_jax.config import NUM_FORECAST, NUM_STATES, NUM_TRAJECTORY_STATES
from spdm_jax.planner import PlanResult
from spdm_jax.results import PlanSet, ScenarioSet
from spdm_jax.synthetic import make_scene, scene_names
from spdm_jax.types import (
    AgentForecast,
    CollisionKind,
    EgoState,
    ObjectType,
    ProposalSet,
    SubScores,
)

COLLIDES, TOO_CLOSE, OFF_ROAD = 3, 4, 5
"""Proposals that break a rule, whatever the number of proposals."""
PADDED = (1, 2)
"""Rows of padding: in between, as where a path had no room."""
BEST = 6
STEP = 11
"""When rules are broken (odd: between two forecast samples)."""


@pytest.fixture(scope="session")
def scenes() -> ScenarioSet:
    """One scene of every kind."""
    return spdm_jax.from_raw([make_scene(name) for name in scene_names()])


@pytest.fixture(scope="session")
def make_plans() -> Callable[..., PlanSet]:
    return _make_plans


@pytest.fixture(scope="session")
def plans(scenes: ScenarioSet) -> PlanSet:
    return _make_plans(scenes)


def _make_plans(scenes: ScenarioSet, num: int = 10, name: str = "Arcs") -> PlanSet:
    """Plans `[B, num]`: arcs of growing length, scores written by hand, two rows of padding."""
    size, batch = len(scenes), scenes.batch
    at = (np.arange(size), np.asarray(batch.num_history))
    ego = {n: np.asarray(getattr(batch.ego, n))[at] for n in EgoState.__dataclass_fields__}
    speed = 4.0 + np.arange(num)
    turn = np.linspace(-0.02, 0.02, num)
    way = speed[:, None] * 0.1 * np.arange(NUM_STATES)
    heading = ego["heading"][:, None, None] + turn[:, None] * way
    step = 0.1 * speed[:, None] * np.ones(NUM_STATES)
    step[:, 0] = 0
    zeros = np.zeros_like(heading)
    states = {n: zeros for n in ego}
    states["x"] = ego["x"][:, None, None] + np.cumsum(step * np.cos(heading), -1)
    states["y"] = ego["y"][:, None, None] + np.cumsum(step * np.sin(heading), -1)
    states["heading"] = heading
    states["vx"] = zeros + speed[:, None]
    tracked = EgoState(**states)
    forecast = _forecast(scenes)
    valid = np.ones((size, num), bool)
    valid[:, PADDED] = False
    scores = _scores(valid, forecast)
    integers = np.broadcast_to(np.arange(num, dtype=np.int32), (size, num))
    best = np.full(size, BEST, np.int32)
    trajectory = EgoState(**{n: np.zeros((size, NUM_TRAJECTORY_STATES)) for n in ego})
    result = PlanResult(
        trajectory=trajectory,
        best=best,
        emergency_brake=np.zeros(size, bool),
        proposals=ProposalSet(
            x=tracked.x,
            y=tracked.y,
            heading=tracked.heading,
            valid=valid,
            path=integers // 5,
            policy=integers % 5,
            stage=1 + integers // 5,
            lane=np.where(integers < 5, -1, 0),
        ),
        tracked=tracked,
        scores=scores,
        progress_centerline=scores.progress_raw,
        progress_goal=scores.progress_raw,
        forecast=forecast,
        target_speed=np.tile(np.arange(1.0, 6.0), (size, 1)),
        starting_lane=np.zeros(size, np.int32),
        overflow=np.zeros(size, bool),
    )
    return PlanSet(
        scores=scores,
        tracked=tracked,
        forecast=forecast,
        infos=scenes.infos,
        overflow=np.zeros(size, bool),
        plans=result,
        name=name,
    )


def _forecast(scenes: ScenarioSet) -> AgentForecast:
    """Constant velocity for the objects of iteration 0, in reverse order of the tracks.

    The last row of the tracks is left out where it is observed: seen by nobody.
    """
    batch = scenes.batch
    tracks, size = batch.tracks, len(scenes)
    at = np.asarray(batch.num_history)[:, None, None]
    now = lambda values: np.take_along_axis(np.asarray(values), at, axis=2)[:, ::-1, 0]
    time = 0.2 * np.arange(NUM_FORECAST)
    move = lambda start, speed: now(start)[..., None] + now(speed)[..., None] * time
    x, y = move(tracks.x, tracks.vx), move(tracks.y, tracks.vy)
    valid = now(tracks.valid).astype(bool)
    rows = np.arange(valid.shape[1], dtype=np.int32)[::-1]
    return AgentForecast(
        x=x,
        y=y,
        heading=np.broadcast_to(now(tracks.heading)[..., None], x.shape),
        sample_valid=np.broadcast_to(valid[..., None], x.shape),
        length=now(tracks.length),
        width=now(tracks.width),
        type=np.asarray(tracks.type)[:, ::-1],
        is_agent=np.asarray(tracks.type)[:, ::-1] <= ObjectType.BICYCLE,
        speed=np.hypot(now(tracks.vx), now(tracks.vy)),
        current_heading=now(tracks.heading),
        track=np.tile(rows, (size, 1)),
        valid=valid,
        ignored=np.zeros_like(valid),
    )


def _scores(valid: np.ndarray, forecast: AgentForecast) -> SubScores:
    size, num = valid.shape
    ones, flags = np.where(valid, 1.0, 0.0), np.zeros((size, num, NUM_STATES), bool)
    values = {name: ones.copy() for name in ("collision", "area", "ttc")}
    values["collision"][:, COLLIDES] = 0
    values["ttc"][:, TOO_CLOSE] = 0
    values["area"][:, OFF_ROAD] = 0
    off_road = flags.copy()
    off_road[:, OFF_ROAD, STEP:] = True
    # The objects' rows stand in reverse order, so the first real one differs from its track.
    has, first = forecast.valid.any(axis=1), np.argmax(forecast.valid, axis=1)
    progress = ones * np.linspace(0.5, 0.95, num)
    total = ones * progress * (0.6 + 0.4 * values["ttc"]) * values["collision"] * values["area"]
    total[:, BEST] = 1.0
    total[~has, COLLIDES] = total[~has, TOO_CLOSE] = 0.3
    never = np.full((size, num), np.inf)
    nobody = np.full((size, num), -1, np.int32)
    collision_time, collision_object, kind = never.copy(), nobody.copy(), nobody.copy()
    ttc_time, ttc_object = never.copy(), nobody.copy()
    collision_time[has, COLLIDES] = ttc_time[has, TOO_CLOSE] = 0.1 * STEP
    collision_object[has, COLLIDES] = ttc_object[has, TOO_CLOSE] = first[has]
    kind[has, COLLIDES] = CollisionKind.ACTIVE_FRONT
    values["collision"][~has, COLLIDES] = values["ttc"][~has, TOO_CLOSE] = 1
    return SubScores(
        total=total,
        no_at_fault_collision=values["collision"],
        drivable_area=values["area"],
        driving_direction=ones,
        progress=progress,
        time_to_collision=values["ttc"],
        comfort=ones,
        progress_raw=30 * progress,
        comfort_flags=np.ones((size, num, 6), bool),
        collision_time=collision_time,
        collision_object=collision_object,
        collision_kind=kind,
        ttc_time=ttc_time,
        ttc_object=ttc_object,
        multiple_lanes=flags,
        non_drivable=off_road,
        oncoming=flags,
        valid=valid,
    )
