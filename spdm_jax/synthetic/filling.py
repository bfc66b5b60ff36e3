"""Fills a corridor: the ego's place, traffic on its lanes, and what stands beside it."""

import numpy as np

from spdm_jax.synthetic.paths import Path
from spdm_jax.synthetic.roads import LANE_WIDTH, MARGIN, MapBuilder
from spdm_jax.synthetic.stage import EGO_STATION, Stage, add_roadside, queue
from spdm_jax.synthetic.traffic import EGO, Follower

BEHIND, BESIDE, AHEAD = -50.0, 11.0, 160.0
"""Where traffic is placed around the ego, m: rearmost, kept clear on its lane, foremost."""


def start_on(builder: MapBuilder, lane: int, speed: float, speed_limit: float) -> Stage:
    """Returns a stage with the ego on lane `lane` of the corridor."""
    route = builder.follow(f"road:0/{lane}")
    return Stage(builder, route, Follower(builder.path(route), EGO_STATION, speed, speed_limit))


def fill_lanes(
    rng: np.random.Generator,
    stage: Stage,
    lanes: int,
    oncoming: int,
    spacing: float,
    speed: float,
    *,
    desired_speed: float | None = None,
    clear_ahead: float = BESIDE,
) -> None:
    """Puts traffic on all lanes of a corridor, and keeps the ego's place clear.

    Args:
      rng: source of variety.
      stage: receives the vehicles.
      lanes: lanes in the ego's direction.
      oncoming: lanes in the other one.
      spacing: mean distance between vehicles of a lane, m.
      speed: of all at iteration 0, m/s.
      desired_speed: mean of what the vehicles in the ego's direction would like to drive, m/s;
        nine tenths of what the ego would like if None.
      clear_ahead: stretch of the ego's lane before its centre without a vehicle's centre, m.
    """
    own = int(stage.route[0].rpartition("/")[2])
    center = EGO_STATION + float(EGO.rear_axle_to_center)
    for k in range(lanes):
        clear = (center - BESIDE, center + clear_ahead) if k == own else None
        stage.followers += queue(
            rng,
            stage.builder.path(stage.builder.follow(f"road:0/{k}")),
            EGO_STATION + BEHIND,
            EGO_STATION + AHEAD,
            spacing,
            speed=speed,
            desired_speed=desired_speed or 0.9 * stage.ego.desired_speed,
            keep_clear=clear,
        )
    fill_oncoming(rng, stage, oncoming, spacing, speed)


def fill_oncoming(
    rng: np.random.Generator,
    stage: Stage,
    lanes: int,
    spacing: float,
    speed: float,
    keep_clear: tuple[float, float] | None = None,
) -> None:
    """Puts traffic on the oncoming lanes; `keep_clear` is in stations of these lanes."""
    for k in range(lanes):
        path = stage.builder.path(stage.builder.follow(f"road~:0/{k}"))
        stage.followers += queue(
            rng,
            path,
            path.length - EGO_STATION - 300.0,
            path.length - EGO_STATION + 40.0,
            spacing,
            speed=speed,
            desired_speed=0.9 * stage.ego.desired_speed,
            keep_clear=keep_clear,
        )


def roadside(rng: np.random.Generator, stage: Stage, path: Path, lanes: int, oncoming: int) -> None:
    """Adds pavements, a car park and the people beside a corridor."""
    right, left = -lanes * LANE_WIDTH - MARGIN, oncoming * LANE_WIDTH + MARGIN
    stage.scripted += add_roadside(rng, stage.builder, path, right=right, left=left)
