"""Learned planners in the closed loop, on straight roads and with small untrained networks."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import EGO_X, LANE_WIDTH, Thing, observe, road, scene_of
from spdm_jax import functional
from spdm_jax.config import NUM_STATES, PlannerParams
from spdm_jax.planner import StepInput
from spdm_jax.simulation.loop import Run, SimulationConfig, SimulationParams, simulate
from spdm_jax.types import Scenario
from spdm_models import dipp, dtpp, gameformer
from spdm_models.checkpoint import read_checkpoint, read_metadata, write_checkpoint
from spdm_models.dipp import DIPPConfig
from spdm_models.dipp_driver import DIPPDriverConfig, dipp_proposals
from spdm_models.dipp_on_gameformer import DIPPRefinerConfig, even_weights
from spdm_models.dipp_planner import DIPPPlannerConfig
from spdm_models.drivers import (
    LearnedName,
    LearnedPlanner,
    Weights,
    learned_planner,
    make_driver,
    read_weights,
)
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_driver import DTPPDriverConfig, dtpp_proposals
from spdm_models.dtpp_planner import DTPPPlannerConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.gameformer_driver import gameformer_proposals
from spdm_models.gameformer_planner import GameFormerPlannerConfig
from spdm_models.gauss_newton import GaussNewtonConfig
from spdm_models.predictions import Prediction
from spdm_models.route_lines import RouteLineConfig
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.scene_features import History, recorded_history
from spdm_models.weights import save_weights

ENCODER = EncoderConfig(width=16, heads=8, layers=1)
SAMPLES = 3
SETTINGS = SimulationConfig(num_samples=SAMPLES, record_plans=True)
LEAD = Thing(EGO_X + 22, -LANE_WIDTH, speed=3.0)
WORLDS: dict[str, dict[str, Any]] = {
    "lead": {"things": [LEAD]},
    "nobody": {},
    "at rest": {"speed": 0.0},
    "off the route": {"ego_y": 15.0, "things": [LEAD]},
}


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scenario]:
    return {name: scene_of(road(**world), jnp.float32) for name, world in WORLDS.items()}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("weights")
    network = GameFormerConfig(ENCODER, levels=1, modes=2, neighbors=3)
    no_levels = dataclasses.replace(network, levels=0)
    key = jax.random.key(0)
    paths = {
        name: folder / f"{name}.safetensors" for name in ("gameformer", "zero", "dtpp", "dipp")
    }
    save_weights(paths["gameformer"], "gameformer", network, gameformer.init(network, key))
    save_weights(paths["zero"], "gameformer", no_levels, gameformer.init(no_levels, key))
    tree, own = DTPPConfig(ENCODER), DIPPConfig(width=16)
    save_weights(paths["dtpp"], "dtpp", tree, dtpp.init(tree, key))
    save_weights(paths["dipp"], "dipp", own, dipp.init(own, key))
    return paths


TRACED: list[LearnedPlanner] = []
"""Grows by one for each program."""


@partial(jax.jit, static_argnums=(2, 3))
def drive(scene: Scenario, arrays: Any, planner: LearnedPlanner, settings: SimulationConfig) -> Run:
    TRACED.append(planner)
    return simulate(scene, make_driver(planner, arrays), SimulationParams(), settings)


Drive = Callable[..., Run]


def driver_of(
    file: Path, name: LearnedName, prediction: Prediction = "learned"
) -> tuple[Weights, Drive]:
    weights = read_weights(file, name)
    planner = dataclasses.replace(learned_planner(name, weights, prediction), max_path_points=512)

    def run(scene, arrays=weights.arrays, settings=SETTINGS) -> Run:
        return jax.tree.map(np.asarray, drive(scene, arrays, planner, settings))

    return weights, run


def check(run: Run) -> None:
    """A plan of 8 s from where the ego is, finite throughout."""
    assert not run.failed and not run.overflow
    plans = run.plans
    assert plans is not None and plans.x.shape == (SAMPLES, 81)
    for values in (plans.x, plans.y, plans.heading):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(plans.x[:, 0], run.history.ego.x[:SAMPLES], atol=1e-4)
    np.testing.assert_allclose(plans.heading[:, 0], run.history.ego.heading[:SAMPLES], atol=1e-4)


def ends(run: Run) -> np.ndarray:
    """How far each plan goes along the road, m."""
    assert run.plans is not None
    return np.asarray(run.plans.x[:, -1] - run.plans.x[:, 0])


def test_gameformer_drives_wherever_it_is(scenes, files):
    _, run = driver_of(files["gameformer"], "gameformer")
    before_all = len(TRACED)
    for scene in scenes.values():
        check(run(scene))
    assert len(TRACED) == before_all + 1
    # Other weights are other arguments of the same program.
    weights, _ = driver_of(files["gameformer"], "gameformer")
    other = jax.tree.map(lambda v: 1.5 * v, weights.arrays)
    before, after = run(scenes["lead"]), run(scenes["lead"], other)
    assert np.abs(ends(before) - ends(after)).max() > 0.01
    assert len(TRACED) == before_all + 1
    broken = jax.tree.map(lambda v: v * np.float32(np.nan), weights.arrays)
    failed = run(scenes["lead"], broken)
    assert failed.failed and not failed.history.valid.any()


@pytest.mark.slow
def test_predictions_reach_the_plan_only_through_levels(scenes, files):
    plans: dict[tuple[str, str], np.ndarray] = {}
    kinds: tuple[Prediction, ...] = ("learned", "perfect", "none")
    for name in ("gameformer", "zero"):
        for kind in kinds:
            run = driver_of(files[name], "gameformer", kind)[1](scenes["lead"])
            check(run)
            plans[name, kind] = ends(run)
    for a, b in (("learned", "perfect"), ("learned", "none"), ("perfect", "none")):
        assert np.abs(plans["gameformer", a] - plans["gameformer", b]).max() > 1e-4
        np.testing.assert_allclose(plans["zero", a], plans["zero", b], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, name",
    [("gameformer", "gameformer-path"), ("gameformer", "gameformer-dipp")],
)
def test_refining_planners_drive_wherever_they_are(scenes, files, file, name):
    _, run = driver_of(files[file], name)
    for scene in scenes.values():
        check(run(scene))


@pytest.mark.slow
@pytest.mark.parametrize("file", ["zero", "dipp"])
def test_dipp_keeps_its_distance_to_what_it_is_told_of(scenes, files, file):
    _, perfect = driver_of(files[file], "dipp", "perfect")
    _, none = driver_of(files[file], "dipp", "none")
    for scene in scenes.values():
        check(none(scene))
    held, free = perfect(scenes["lead"]), none(scenes["lead"])
    check(held)
    # The car ahead drives 3 m/s: 24 m in 8 s, from 22 m ahead.
    assert np.all(ends(held) < ends(free) - 5)
    # The plan keeps to the lane, whatever the network's first one does.
    assert free.plans is not None
    assert np.abs(free.plans.y - free.history.ego.y[0]).max() < 0.6


@pytest.mark.slow
def test_dtpp_scores_branches_beside_what_it_is_told(scenes, files):
    _, perfect = driver_of(files["dtpp"], "dtpp", "perfect")
    _, none = driver_of(files["dtpp"], "dtpp", "none")
    for scene in scenes.values():
        check(none(scene))
    check(perfect(scenes["lead"]))
    # All zeros put the car at the ego's start: to get away fast is best.
    assert np.all(ends(none(scenes["lead"])) > ends(perfect(scenes["lead"])) + 5)


@pytest.mark.slow
@pytest.mark.parametrize("file, name", [("gameformer", "gameformer-dipp"), ("dtpp", "dtpp")])
def test_perfect_predictions_in_reactive_traffic(scenes, files, file, name):
    settings = dataclasses.replace(SETTINGS, traffic="reactive")
    _, run = driver_of(files[file], name, "perfect")
    check(run(scenes["lead"], settings=settings))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gameformer", "dipp", "dtpp"])
def test_candidates_are_proposals_that_the_scorer_takes(scenes, files, name):
    weights = read_weights(files[name], name)
    solver = GaussNewtonConfig(iterations=3, step_size=0.4, result="best")
    lines = RouteLineConfig(max_path_points=512)

    def candidates(arrays: Any, scene: Scenario, given: StepInput, history: History):
        step = (scene, given, history)
        params, network = arrays["network"], weights.network
        if isinstance(network, GameFormerConfig):
            refiner = DIPPRefinerConfig(solver=solver, max_path_points=512)
            config = GameFormerPlannerConfig(network=network, refinement="dipp", dipp=refiner)
            return gameformer_proposals(params, arrays["cost_weights"], *step, config)
        if isinstance(network, DIPPConfig):
            refiner = DIPPRefinerConfig(DIPPPlannerConfig(), solver, max_path_points=512)
            return dipp_proposals(params, *step, DIPPDriverConfig(network, refiner=refiner))
        assert isinstance(network, DTPPConfig)
        planner = DTPPPlannerConfig(network, lines=lines)
        return dtpp_proposals(params, *step, DTPPDriverConfig(planner))

    @jax.jit
    def propose(scene: Scenario, arrays: Any):
        given, history = observe(scene, 0), recorded_history(scene, -1)
        found, _, overflow = candidates(arrays, scene, given, history)
        params = PlannerParams()
        poses = found.x, found.y, found.heading
        tracked, _ = functional.track(*poses, given.ego, params.vehicle, params.tracker)
        return found, overflow, tracked

    found, overflow, tracked = propose(scenes["lead"], weights.arrays)
    count = {"gameformer": 2, "dipp": 3, "dtpp": 30}[name]
    assert not overflow and found.x.shape == (count, NUM_STATES)
    assert np.all(found.valid) if name != "dtpp" else 5 <= np.sum(found.valid)
    np.testing.assert_allclose(found.x[:, 0], float(observe(scenes["lead"], 0).ego.x), rtol=1e-6)
    assert np.isfinite(tracked.x).all()


# --- files of weights


def test_weights_know_what_they_are(files, tmp_path):
    weights = read_weights(files["dtpp"], "dtpp")
    assert weights.network == DTPPConfig(ENCODER) and weights.training == {}
    np.testing.assert_allclose(weights.arrays["cost_weights"], even_weights())
    assert read_weights(files["zero"], "dipp").model == "gameformer"
    assert read_weights(files["dipp"], "dipp").model == "dipp"
    digests = {read_weights(files[n], "dipp").digest for n in ("zero", "dipp", "gameformer")}
    assert len(digests) == 3


@pytest.mark.parametrize(
    "name, file, said",
    [
        ("gameformer", "dtpp", "holds weights of dtpp; gameformer takes those of gameformer"),
        ("dipp", "dtpp", "holds weights of dtpp; dipp takes those of dipp or gameformer"),
        ("dtpp", "nowhere", "no such file of weights for dtpp"),
    ],
)
def test_wrong_files_are_named(files, tmp_path, name, file, said):
    path = files.get(file, tmp_path / "nowhere.safetensors")
    with pytest.raises(ValueError, match=said) as error:
        read_weights(path, name)
    assert str(path) in str(error.value)


def test_broken_files_are_named(files, tmp_path):
    path = tmp_path / "weights.safetensors"
    path.write_bytes(files["dtpp"].read_bytes()[:-100])
    with pytest.raises(ValueError, match=str(path)):
        read_weights(path, "dtpp")
    path.write_bytes(b"no weights")
    with pytest.raises(ValueError, match=str(path)):
        read_weights(path, "dtpp")
    state, about = read_checkpoint(files["zero"]), read_metadata(files["zero"])
    write_checkpoint(path, state, {**about, "training": {"cost_weights": [1.0]}})
    with pytest.raises(ValueError, match="cost_weights"):
        read_weights(path, "dipp")
    learnt = [float(i) for i in range(9)]
    write_checkpoint(path, state, {**about, "training": {"cost_weights": learnt, "steps": 7}})
    weights = read_weights(path, "dipp")
    np.testing.assert_array_equal(weights.arrays["cost_weights"], learnt)
    assert weights.training["steps"] == 7
