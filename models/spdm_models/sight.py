"""What a network sees at one step of a drive, and drivers that remember it."""

from collections.abc import Callable
from typing import NamedTuple

import jax

from spdm_jax.agents.forecast import React
from spdm_jax.planner import StepInput
from spdm_jax.simulation.drivers import Driven, Driver
from spdm_jax.types import Scenario

from .plan_frame import plan_in_scene
from .scene_encoder import SceneFeatures
from .scene_features import (
    FeatureConfig,
    History,
    Neighbors,
    next_history,
    pick_neighbors,
    recorded_history,
    scene_features,
)

Planned = tuple[jax.Array, History, jax.Array]
"""Poses `[M, 3]` from 0.1 s on in the ego's frame, the history for the next step, `[]` overflow."""


class Sight(NamedTuple):
    """One step.

    Attributes:
      history: of the last 2 s, this step included.
      neighbors: whom the network sees.
      features: its inputs.
    """

    history: History
    neighbors: Neighbors
    features: SceneFeatures


def look(scene: Scenario, given: StepInput, before: History, config: FeatureConfig) -> Sight:
    """Appends a step to a history and builds the network's inputs.

    Args:
      scene: one scenario.
      given: ego and objects of this step.
      before: history up to the step before, 0.1 s ago.
      config: how much is seen.
    """
    seen = given.observation
    history = next_history(before, given.ego, seen)
    neighbors = pick_neighbors(history, config)
    features = scene_features(scene.map, scene.route, seen.lights, history, neighbors, config)
    return Sight(history, neighbors, features)


def seeing_driver(
    name: str,
    think: Callable[[Scenario, StepInput, History, React | None], Planned],
    *,
    reacting: bool,
) -> Driver:
    """A driver whose state is what was seen in the last 2 s: it must be asked at every step.

    Args:
      name: for tables.
      think: from scenario, input, history up to the step before and how traffic would react.
      reacting: whether it asks how traffic would react.
    """

    def step(
        scene: Scenario,
        given: StepInput,
        time: jax.Array,
        state: History,
        react: React | None = None,
    ) -> Driven:
        poses, history, overflow = think(scene, given, state, react)
        return Driven(plan_in_scene(poses, given.ego, time), history, overflow)

    init = lambda scene: recorded_history(scene, -1)
    return Driver(name, init, step, step if reacting else None)
