"""The training loop: falling loss, order, checkpoints, a training that goes on, bad losses."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toy_training
from spdm_models.checkpoint import read_checkpoint
from spdm_models.train_data import rows_of_step
from spdm_models.train_loop import STATE_FILE, Diverged, FitConfig, validate
from toy_training import RECIPE, TASK, samples, train

CONFIG = FitConfig(steps=30, batch=6, every=4)


def state_of(folder: Path) -> dict[str, np.ndarray]:
    return read_checkpoint(folder / STATE_FILE)


def child(folder: Path, *arguments: str, **environment: str) -> int:
    run = subprocess.run(
        [sys.executable, toy_training.__file__, str(folder), *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert run.returncode in (0, -signal.SIGKILL), run.stderr[-2000:]
    return run.returncode


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, train(folder, CONFIG)


def test_the_loss_falls(whole):
    _, fitted = whole
    assert fitted.step == CONFIG.steps and fitted.log.losses.shape == (30, 3)
    assert fitted.log.columns == ("loss", "extra", "gradient")
    losses = fitted.log.losses[:, 0]
    assert losses[-5:].mean() < 0.9 * losses[:5].mean()
    # The planner's part begins after a quarter of the steps, as the recipe says.
    extra = fitted.log.losses[:, 1]
    begin = RECIPE.planner_from(CONFIG.steps)
    assert begin == 8
    assert not extra[:begin].any() and extra[begin:].all()
    # 32 samples are 5 steps of 6.
    assert fitted.log.metrics == ("step", "ADE", "some")
    np.testing.assert_array_equal(fitted.log.validation[:, 0], np.arange(5, 31, 5))
    assert np.all(np.diff(fitted.log.validation[:, 1]) < 0)


def test_the_rate_is_halved_where_the_recipe_says():
    rates = [np.asarray(RECIPE.schedule(40)(jnp.asarray(step))) for step in (0, 19, 20, 39)]
    np.testing.assert_allclose(rates, [0.05, 0.05, 0.025, 0.025], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(RECIPE.schedule(40, 1.0)(jnp.asarray(0))), 1)


@pytest.mark.parametrize("stopped_at", [4, 7, 29])
def test_a_stopped_training_goes_on_to_the_same_bytes(whole, tmp_path, stopped_at):
    calls = iter(range(1, 100))
    first = train(tmp_path, CONFIG, stop=lambda: next(calls) == stopped_at)
    assert first.step == stopped_at
    second = train(tmp_path, CONFIG)
    assert (tmp_path / STATE_FILE).read_bytes() == (whole[0] / STATE_FILE).read_bytes()
    np.testing.assert_array_equal(second.log.losses, whole[1].log.losses)
    third = train(tmp_path, CONFIG)
    assert third.step == CONFIG.steps
    jax.tree.map(np.testing.assert_array_equal, third.params, second.params)


@pytest.fixture(scope="module")
def whole_process(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert child(folder, "30") == 0
    return folder


def test_a_killed_training_goes_on_to_the_same_bytes(whole_process, tmp_path):
    assert child(tmp_path, "30", "14") == -signal.SIGKILL
    assert int(state_of(tmp_path)["step"]) == 12
    assert not (tmp_path / "weights.npy").exists()
    assert child(tmp_path, "30") == 0
    for name in ("weights.npy", STATE_FILE):
        assert (tmp_path / name).read_bytes() == (whole_process / name).read_bytes(), name


def test_two_devices_train_as_one_does(whole_process, tmp_path):
    child(tmp_path, "30", XLA_FLAGS="--xla_force_host_platform_device_count=2")
    ours, theirs = state_of(tmp_path), state_of(whole_process)
    for name in ("params.layer.weight", "log.losses", "log.validation"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-4, atol=1e-5)


def test_a_batch_must_fit_the_devices(tmp_path):
    with pytest.raises(ValueError, match="devices is 3, but there are 1"):
        train(tmp_path, dataclasses.replace(CONFIG, devices=3))


def test_a_checkpoint_of_another_training_is_refused(whole, tmp_path):
    path = tmp_path / STATE_FILE
    path.write_bytes((whole[0] / STATE_FILE).read_bytes())
    with pytest.raises(ValueError, match=r"with what = a toy, this one has something else"):
        toy_training.fit(TASK, samples(), None, CONFIG, tmp_path, {"what": "something else"})
    wider = dataclasses.replace(TASK, init=lambda key: {"layer": {"weight": jnp.zeros((9, 3))}})
    with pytest.raises(ValueError, match=r"weight has \(4, 3\), expected shape \(9, 3\)"):
        train(tmp_path, CONFIG, wider)
    other = read_checkpoint(path)
    del other["key"]
    header = json.dumps({"format": 0})
    from safetensors.numpy import save_file

    save_file(other, path, {"spdm": header})
    with pytest.raises(ValueError, match="no checkpoint of a training"):
        train(tmp_path, CONFIG)


def test_a_loss_that_is_no_number_ends_the_training(tmp_path):
    def loss(params, batch, key, planner):
        total, parts = TASK.loss(params, batch, key, planner)
        # The weights tell how long the training lasts: they move away from their start.
        gone = jnp.abs(params["layer"]["weight"][0, 0] - start) > 0.45
        return jnp.where(gone, jnp.nan, total), parts

    start = 5.0
    task = dataclasses.replace(
        TASK, loss=loss, init=lambda key: {"layer": {"weight": jnp.full((4, 3), start)}}
    )
    with pytest.raises(Diverged, match=r"step 12: the loss is no number .* is the last good state"):
        train(tmp_path, CONFIG, task)
    state = state_of(tmp_path)
    assert int(state["step"]) == 8
    assert all(np.all(np.isfinite(value)) for value in state.values())


def test_every_epoch_is_an_order_of_all_samples():
    rows = [rows_of_step(7, step, 20, 5) for step in range(8)]
    for epoch in (rows[:4], rows[4:]):
        np.testing.assert_array_equal(np.sort(np.concatenate(epoch)), np.arange(20))
    assert not np.array_equal(rows[0], rows[4])
    # Nothing but seed and step counts; what does not fill a batch is left out.
    np.testing.assert_array_equal(rows[6], rows_of_step(7, 6, 20, 5))
    assert not np.array_equal(rows[0], rows_of_step(8, 0, 20, 5))
    assert len({*rows_of_step(0, 0, 7, 3), *rows_of_step(0, 1, 7, 3)}) == 6


def test_validation_counts_every_sample_once():
    params, held_out = TASK.init(jax.random.key(0)), samples(10, 1)
    at_once = validate(TASK.metrics, params, held_out, 10)
    assert at_once == pytest.approx(validate(TASK.metrics, params, held_out, 4))
    missed = np.asarray(TASK.metrics(params, held_out)["some"])
    assert at_once["some"] == pytest.approx(np.nanmean(missed))
    nobody = dataclasses.replace(TASK, metrics=lambda p, b: {"none": b.features[:, 0] * jnp.nan})
    assert np.isnan(validate(nobody.metrics, params, held_out, 4)["none"])


@pytest.mark.parametrize("name", ["steps", "batch", "every"])
def test_bad_settings_are_named(name):
    with pytest.raises(ValueError, match=f"{name} is 0"):
        dataclasses.replace(CONFIG, **{name: 0})
