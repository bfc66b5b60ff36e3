"""Static settings are hashable, and new values never compile again."""

import dataclasses
import logging
import subprocess
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
import spdm_jax
from spdm_jax.config import (
    IDMParams,
    PlannerConfig,
    PlannerSpec,
    ScoringParams,
    SplineParams,
    VehicleParams,
    pdm_closed,
    spdm,
)
from spdm_jax.padding import PaddingConfig

# Two scenes of other content, with the shapes of every set of two in these tests.
FIRST = [roads.road(things=[roads.parked(25.0)]), roads.road(token="free")]
SECOND = [
    roads.road(speed=4.0, things=[roads.Thing(90.0, 0.0, speed=3.0)], red=(1,), limit=None),
    roads.moved(roads.lane_end(), 1.0, (5e5, 4e6)),
]


@pytest.fixture
def compiled(caplog: pytest.LogCaptureFixture) -> Callable[[Callable[[], object]], list[str]]:
    """Names what a call traces or compiles."""

    def run(call: Callable[[], object]) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.WARNING), jax.log_compiles():
            call()
        texts = [record.getMessage() for record in caplog.records]
        return [t[:80] for t in texts if t.startswith(("Finished tracing", "Compiling"))]

    return run


def changed(planner: PlannerSpec) -> PlannerSpec:
    """Other values of every kind, none of the counts."""
    params = planner.params.replace(
        speed_fractions=np.asarray(planner.params.speed_fractions) * 0.9,
        lateral_offsets=np.asarray(planner.params.lateral_offsets) * 1.1,
        map_radius=45.0,
        vehicle=VehicleParams(width=2.0, length=4.8),
        idm=IDMParams(min_gap=2.0, headway_time=1.2, accel_max=1.1, decel_max=2.5),
        spline=SplineParams(merge_times=np.array([3.0, 2.5, 5.0]), horizon=6.0),
        scoring=ScoringParams(progress_weight=4.0, ttc_weight=6.0, lon_jerk_max=3.0),
    )
    return PlannerSpec(planner.name, planner.config, params)


def test_the_counter_counts(compiled):
    fresh = jax.jit(lambda x: 3 * x + 1)
    one, other = jnp.zeros(17), jnp.ones(17)
    assert compiled(lambda: fresh(one))
    assert not compiled(lambda: fresh(other))


def test_planning_compiles_once_per_shape(compiled):
    planner = spdm(20)
    scenes = [spdm_jax.from_raw(raws, padding=roads.PADDING) for raws in (FIRST, SECOND)]
    first = spdm_jax.plan(scenes[0], planner)
    assert not compiled(lambda: spdm_jax.plan(scenes[1], planner))
    results = []
    assert not compiled(lambda: results.append(spdm_jax.plan(scenes[0], changed(planner))))
    # The new values did reach the planner.
    assert not np.allclose(results[0].scores.total, first.scores.total)
    np.testing.assert_allclose(
        results[0].plans.target_speed, 0.9 * first.plans.target_speed, rtol=1e-6
    )


def test_scoring_compiles_once_per_shape(compiled):
    scenes = [spdm_jax.from_raw(raws, padding=roads.PADDING) for raws in (FIRST, SECOND)]
    rows = np.zeros((8, 41, 3))
    rows[..., 0] = np.linspace(0, 12, 8)[:, None] * 0.1 * np.arange(41)
    score = lambda scene, **more: spdm_jax.score(scene, rows, precision="f64", **more)
    first = score(scenes[0])
    other = pdm_closed(15).params
    assert not compiled(lambda: score(scenes[1]))
    results = []
    values = changed(PlannerSpec("", PlannerConfig(), other)).params
    assert not compiled(lambda: results.append(score(scenes[0], params=values)))
    assert not np.allclose(results[0].scores.total, first.scores.total)
    # What differs only on the host does not matter either: interval, frame.
    half = rows[:, ::5]
    assert not compiled(lambda: spdm_jax.score(scenes[0], half, dt=0.5, precision="f64"))
    assert not compiled(lambda: score(scenes[0], frame="local"))


def test_closed_loop_steps_share_one_program(compiled):
    roads.drive(FIRST[0], roads.PDM, 1)
    assert not compiled(lambda: roads.drive(SECOND[0], roads.PDM, 4))


@pytest.mark.parametrize(
    "config", [PlannerConfig(), PlannerConfig(num_route_paths=9, forecast="none"), PaddingConfig()]
)
def test_configs_are_hashable_and_equal_by_value(config):
    copy = dataclasses.replace(config)
    assert copy == config and copy is not config and hash(copy) == hash(config)
    assert {config: 1}[copy] == 1


def test_config_hash_tells_settings_apart():
    configs = [
        PlannerConfig(),
        PlannerConfig(num_route_paths=1),
        PlannerConfig(tracker="corrected"),
        PlannerConfig(forecast="perfect"),
        PlannerConfig(progress_reference="goal"),
        PlannerConfig(max_vehicles=10),
    ]
    assert len(set(configs)) == len(configs)
    assert len({hash(config) for config in configs}) == len(configs)


def test_config_hash_is_the_same_in_every_process():
    code = (
        "from spdm_jax.config import PlannerConfig\n"
        "print(hash(PlannerConfig(num_route_paths=3, max_vehicles=7)))"
    )
    values = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={"PYTHONHASHSEED": "7", "JAX_PLATFORMS": "cpu"},
        ).stdout
        for _ in range(2)
    }
    assert len(values) == 1


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"num_route_paths": -1}, "num_route_paths is -1; it must be >= 0"),
        ({"tracker": "exact"}, "tracker is 'exact'"),
        ({"forecast": "oracle"}, "forecast is 'oracle'"),
        ({"progress_reference": "x"}, "progress_reference is 'x'"),
    ],
)
def test_wrong_settings_are_refused(changes: dict, text: str):
    with pytest.raises(ValueError, match=text):
        PlannerConfig(**changes)


@pytest.mark.parametrize("num", [1, 3, 6, 15, 30, 60])
def test_grids_of_pdm_closed(num: int):
    planner = pdm_closed(num)
    fractions = np.asarray(planner.params.speed_fractions)
    offsets = np.asarray(planner.params.lateral_offsets)
    assert len(fractions) * len(offsets) == num
    assert fractions[-1] == 1.0 and offsets[0] == 0.0
    np.testing.assert_allclose(np.diff(fractions), fractions[0])
    assert planner.config.num_route_paths == 0


@pytest.mark.parametrize("num, paths", [(15, 0), (20, 1), (25, 2), (30, 3), (45, 6), (60, 9)])
def test_sizes_of_spdm(num: int, paths: int):
    assert spdm(num).config.num_route_paths == paths


@pytest.mark.parametrize(
    "make, text",
    [
        (lambda: pdm_closed(7), r"num_proposals is 7; PDM-Closed has grids for \[1, 3, 6"),
        (lambda: pdm_closed(speed_fractions=(), lateral_offsets=(0.0,)), "needs positive numbers"),
        (lambda: pdm_closed(speed_fractions=(1.0,), lateral_offsets=(1.0, 0.0)), "first must be 0"),
        (lambda: spdm(17), r"num_proposals is 17; it must be 15 \+ K x 5"),
        (lambda: spdm(10), "num_proposals is 10"),
    ],
)
def test_impossible_sizes_are_refused(make: Callable[[], object], text: str):
    with pytest.raises(ValueError, match=text):
        make()
