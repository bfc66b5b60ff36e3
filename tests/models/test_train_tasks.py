"""Every task learns: the same few scenes again and again, until it knows them by heart."""

import dataclasses
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_models.train_data import take
from spdm_models.train_loop import FitConfig, fit, validate
from spdm_models.train_tasks import TaskName, cost_weights, make_task
from spdm_models.weights import load_weights, save_weights
from training_roads import BATCH, road_samples, small_task

SMOKE = FitConfig(steps=40, batch=BATCH, rate=3e-3, every=40)
LONG = dataclasses.replace(SMOKE, rate=1e-3, steps=3000, every=3000, dropout=False)
# By heart: mean and last error of plan and predictions, m.
NEAR = {"minADE": 0.3, "minFDE": 0.6, "planADE": 0.3, "planFDE": 0.6}
# DIPP's costs want the speed limit, which these roads' ego does not drive at: the plan is learnt as
# the start from which two steps of the solve come close.
REFINED = {**NEAR, "planADE": 0.6, "refinedADE": 1.0, "refinedFDE": 2.0}


def learn(name, config, folder):
    task = small_task(name)
    samples, rows = road_samples(task)
    np.testing.assert_array_equal(rows, np.arange(8))
    fitted = fit(task, samples, None, config, folder, {})
    return task, samples, fitted


def test_a_short_training_learns(tmp_path):
    task, _, fitted = learn("gameformer", SMOKE, tmp_path)
    losses = fitted.log.losses[:, 0]
    assert losses[-5:].mean() < 0.3 * losses[:5].mean()
    path = tmp_path / "weights.safetensors"
    save_weights(path, task.model, task.config, task.network(fitted.params), {"steps": 40})
    config, params = load_weights(path, task.model)
    assert config == task.config
    jax.tree.map(np.testing.assert_array_equal, params, fitted.params)


@pytest.mark.slow
@pytest.mark.parametrize("name", get_args(TaskName))
def test_eight_scenes_are_learnt_by_heart(name, tmp_path):
    task, samples, fitted = learn(name, LONG, tmp_path)
    losses = fitted.log.losses[:, 0]
    assert losses[-10:].mean() < 0.1 * abs(losses[:10].mean())
    found = validate(jax.jit(task.metrics), fitted.params, samples, BATCH)
    print(name, found, fitted.log.losses[-1])
    limits = REFINED if name == "gameformer-dipp" else NEAR
    if name == "dtpp":
        # It chooses: the branch that ends nearest is known by heart, its way there is the tree's.
        missed = np.linalg.norm(samples.second[:, 0, :, :2] - samples.ego[..., :2], axis=-1)
        limits = {**NEAR, "planADE": missed.mean() + 1e-3, "planFDE": missed[:, -1].mean() + 1e-3}
    for metric, limit in limits.items():
        assert found[metric] < limit, (metric, found)


def test_recipes_are_the_published_ones():
    facts = {name: make_task(name, "full").recipe for name in get_args(TaskName)}
    assert facts["gameformer"].epochs == 20 and facts["gameformer"].batch == 32
    assert facts["dtpp"].epochs == 30 and facts["dtpp"].batch == 16
    assert facts["dipp"].planner_from(400) == 100
    assert facts["gameformer"].planner_from(400) == 400
    rates = [
        float(np.asarray(facts["gameformer"].schedule(200)(step))) for step in (0, 99, 100, 199)
    ]
    np.testing.assert_allclose(rates, [1e-4, 1e-4, 5e-5, 1e-4 / 2**5], rtol=1e-5)


def test_sizes_are_those_of_the_names():
    sizes = {name: make_task(name, "full").config for name in get_args(TaskName)}
    assert sizes["gameformer-0"] == dataclasses.replace(sizes["gameformer"], levels=0)
    assert sizes["gameformer-dipp"] == sizes["gameformer"]
    small = make_task("gameformer", "small", modes=15).config
    assert dataclasses.asdict(small)["encoder"]["width"] == 48
    assert dataclasses.asdict(small)["modes"] == 15
    with pytest.raises(
        ValueError, match="model 'transformer' is unknown; choose one of gameformer"
    ):
        make_task("transformer")  # pyright: ignore[reportArgumentType]


def test_costs_start_equal():
    weights = np.asarray(cost_weights(jnp.zeros(9, jnp.float32)))
    np.testing.assert_allclose(weights, [*[1 / 9] * 5, 10 / 9, 100 / 9, 10, 10], rtol=1e-6)


def test_some_samples_are_taken():
    samples, _ = road_samples(small_task("gameformer"))
    np.testing.assert_array_equal(take(samples, np.array([2, 0])).ego, samples.ego[[2, 0]])
