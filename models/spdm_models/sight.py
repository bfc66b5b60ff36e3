"""What a network sees at one step of a drive."""

from typing import NamedTuple

from spdm_jax.planner import StepInput
from spdm_jax.types import Scenario

from .scene_encoder import SceneFeatures
from .scene_features import (
    FeatureConfig,
    History,
    Neighbors,
    next_history,
    pick_neighbors,
    scene_features,
)


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
