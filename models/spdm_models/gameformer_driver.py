"""GameFormer, alone and with a refinement, in the closed loop."""

import jax
import jax.numpy as jnp

from spdm_jax.agents.forecast import React
from spdm_jax.planner import StepInput
from spdm_jax.simulation.drivers import Driver
from spdm_jax.types import ProposalSet, Scenario

from .gameformer_planner import GameFormerPlannerConfig, ego_modes, finish, predict
from .params import Params
from .plan_frame import proposals_in_scene
from .scene_features import History
from .sight import Planned, look, seeing_driver


def gameformer_driver(
    name: str, params: Params, cost_weights: jax.Array, config: GameFormerPlannerConfig
) -> Driver:
    """GameFormer; the state is what was seen in the last 2 s, so it must be asked at every step.

    Args:
      name: for tables.
      params: weights of the network; make the driver inside `jit`, so that they are no constants
        of the program.
      cost_weights: `[9]` of DIPP's problem; not read by the other refinements.
      config: static settings.
    """

    def think(scene: Scenario, given: StepInput, state: History, react: React | None) -> Planned:
        sight = look(scene, given, state, config.features)
        predicted = predict(params, scene, given, sight, config, react)
        first = predicted.output.plan
        done = finish(first, predicted, cost_weights, scene, given, sight, config)
        return done.poses, sight.history, done.overflow

    return seeing_driver(name, think, reacting=config.prediction == "perfect")


def gameformer_proposals(
    params: Params,
    cost_weights: jax.Array,
    scene: Scenario,
    given: StepInput,
    history: History,
    config: GameFormerPlannerConfig,
    react: React | None = None,
) -> tuple[ProposalSet, History, jax.Array]:
    """The ego's M modes as proposals for the PDM scorer, each refined as the config asks.

    Args:
      params: weights of the network.
      cost_weights: `[9]` of DIPP's problem.
      scene: one scenario.
      given: ego and objects of this step.
      history: up to the step before.
      config: static settings.
      react: how traffic would react, in traffic that does.

    Returns:
      Proposals `[M, 41]` in the scene's frame, the history for the next step, and whether a fixed
      buffer was too small, `[]` bool.
    """
    sight = look(scene, given, history, config.features)
    predicted = predict(params, scene, given, sight, config, react)
    refined = lambda mode: finish(mode, predicted, cost_weights, scene, given, sight, config)
    done = jax.vmap(refined)(ego_modes(predicted))
    return proposals_in_scene(done.poses, given.ego), sight.history, jnp.any(done.overflow)
