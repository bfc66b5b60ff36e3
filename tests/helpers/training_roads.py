"""Straight roads to learn from, and tasks so small that they compile fast."""

from dataclasses import replace

import numpy as np

from small_road import EGO_X, LANE_WIDTH, PADDING, Thing, road
from spdm_jax import api
from spdm_jax.io.raw import RawScenario
from spdm_models.dipp import DIPPConfig
from spdm_models.dipp_features import DIPPFeatureConfig
from spdm_models.dtpp import DTPPConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.train_data import SampleMaker, TrainSample
from spdm_models.train_tasks import (
    Task,
    TaskName,
    dipp_task,
    dtpp_task,
    gameformer_task,
    refined_task,
)

ENCODER = EncoderConfig(width=32, heads=4, layers=1)
NEIGHBORS = 3
"""One more than a road has."""
GAMEFORMER = GameFormerConfig(encoder=ENCODER, levels=1, modes=3, neighbors=NEIGHBORS)
BATCH = 8


def raw_roads(number: int = 8) -> list[RawScenario]:
    """The ego at 3, 3.5, ... m/s behind a car, with another one to its left."""
    own, left = -LANE_WIDTH, 0.0
    return [
        road(
            speed=3.0 + 0.5 * i,
            things=[
                Thing(EGO_X + 15 + 2 * i, own, speed=3.5 + 0.5 * i, id="ahead"),
                Thing(EGO_X - 8 + 3 * i, left, speed=6.0 - 0.5 * i, id="beside"),
            ],
            token=f"road-{i}",
        )
        for i in range(number)
    ]


def small_task(name: TaskName) -> Task:
    """A task with tiny widths."""
    if name == "dtpp":
        return dtpp_task(DTPPConfig(encoder=ENCODER, neighbors=NEIGHBORS))
    if name == "dipp":
        task = dipp_task(DIPPConfig(width=32))
        seen = DIPPFeatureConfig(neighbors=NEIGHBORS, lanes=2, crosswalks=1, points=20)
        return replace(task, sample=replace(task.sample, count=NEIGHBORS, dipp=seen))
    if name == "gameformer-dipp":
        return refined_task(GAMEFORMER)
    if name == "gameformer-0":
        return gameformer_task(replace(GAMEFORMER, levels=0))
    return gameformer_task(GAMEFORMER)


def road_samples(task: Task, stride: int = 20) -> tuple[TrainSample, np.ndarray]:
    """Samples of the roads, one of each at the default stride, and the road of each."""
    scenes = api.from_raw(raw_roads(), padding=PADDING)
    return SampleMaker(task.sample, stride)(scenes.batch)
