"""Reading a scored set at a smaller N_p: as if it had been scored alone."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_experiments import cli
from spdm_experiments.sweep_work import SweepEngine
from spdm_jax import PlannerConfig, PlannerParams, load, pdm_closed, plan, spdm
from spdm_jax.decision import cast_params
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.nested import progress_by_goal, read_nested
from spdm_jax.planner import PlanResult
from spdm_jax.scoring.aggregate import aggregate
from spdm_jax.synthetic import make_scene
from spdm_jax.types import EgoState, Scenario, SubScores

NUM = 9
SPEEDS = ("0.5,1", (0.5, 1.0))


def a_result(seed: int) -> tuple[PlanResult, Any]:
    """A plan of `NUM` proposals with drawn sub-scores; what a reading ignores is None."""
    draw = np.random.default_rng(seed)
    level = lambda *values: jnp.asarray(draw.choice(values, NUM).astype(np.float32))
    real = lambda: jnp.asarray(draw.uniform(-1, 20, NUM).astype(np.float32))
    fields: dict[str, Any] = dict.fromkeys(SubScores.__dataclass_fields__)
    fields |= {
        "no_at_fault_collision": level(0, 0.5, 1, 1),
        "drivable_area": level(0, 1, 1),
        "driving_direction": level(0, 0.5, 1, 1),
        "time_to_collision": level(0, 1),
        "comfort": level(0, 1),
        "collision_time": level(0.5, 3, np.inf),
        "valid": jnp.asarray(draw.random(NUM) < 0.8),
        "total": jnp.zeros(NUM, jnp.float32),
    }
    plans: dict[str, Any] = dict.fromkeys(PlanResult.__dataclass_fields__)
    plans |= {
        "scores": SubScores(**fields),
        "progress_centerline": real(),
        "progress_goal": real(),
    }
    return PlanResult(**plans), draw


@jax.jit
def read(plans: PlanResult, count: jax.Array, by_goal: jax.Array, speed: jax.Array):
    zero = jnp.zeros_like(speed)
    ego = EgoState(**{**dict.fromkeys(EgoState.__dataclass_fields__, zero), "vx": speed})
    return read_nested(plans, count, by_goal, ego, cast_params(PlannerParams(), jnp.float32))


@given(seed=st.integers(0, 10_000), count=st.sampled_from((1, 4, NUM)), by_goal=st.booleans())
def test_reading_is_the_score_of_the_first_rows_alone(seed: int, count: int, by_goal: bool):
    plans, draw = a_result(seed)
    speed = np.float32(draw.choice([0.0, 4.9, 5.1]))
    found = read(plans, np.int32(count), np.bool_(by_goal), speed)
    first = jax.tree.map(lambda v: v[:count], plans.scores)
    raw = (plans.progress_goal if by_goal else plans.progress_centerline)[:count]
    multiplier = first.no_at_fault_collision * first.drivable_area * first.driving_direction
    alone = aggregate(
        multiplier,
        raw,
        first.time_to_collision,
        first.comfort,
        first.valid,
        PlannerParams().scoring,
    )
    best = int(np.argmax(alone.total))
    assert int(found.best) == best
    np.testing.assert_allclose(found.scores.total[:count], alone.total, rtol=1e-6)
    np.testing.assert_allclose(found.scores.progress[:count], alone.progress, rtol=1e-6)
    np.testing.assert_array_equal(found.scores.progress_raw[:count], raw)
    np.testing.assert_array_equal(found.scores.valid, np.r_[first.valid, np.zeros(NUM - count)])
    np.testing.assert_array_equal(found.scores.total[count:], 0)
    assert bool(found.emergency_brake) == bool(first.collision_time[best] <= 2 and speed <= 5)


def test_rows_beyond_never_win_where_all_score_nothing():
    plans, _ = a_result(0)
    zero = jnp.zeros(NUM, jnp.float32)
    plans = plans.replace(scores=plans.scores.replace(no_at_fault_collision=zero))
    assert int(read(plans, np.int32(3), np.bool_(True), np.float32(0)).best) == 0


@pytest.mark.parametrize(
    "reference, count, expected",
    [
        ("auto", 15, False),
        ("auto", 20, True),
        ("goal", 15, True),
        ("centerline", 60, False),
    ],
)
def test_progress_reference_goes_by_the_number(reference: Any, count: int, expected: bool):
    assert progress_by_goal(reference, count, 15) == expected


def on_two_lanes() -> tuple[Scenario, Any]:
    """A scene whose ego stands on two lanes at once, each of which goes on elsewhere."""
    scenario, info = build_scenario(make_scene("parked_car", 1))
    lanes, now = scenario.map.lanes, int(scenario.num_history)
    ego = np.array([scenario.ego.x[now], scenario.ego.y[now]])

    def rows(table: Any, lane: int) -> slice:
        return slice(table.start[lane], table.start[lane] + table.count[lane])

    def gap(lane: int) -> float:
        return float(
            np.min(np.hypot(*(lanes.centerline.points[rows(lanes.centerline, lane), :2] - ego).T))
        )

    mine, other = (0, 1) if gap(0) < gap(1) else (1, 0)
    points = lanes.centerline.points.copy()
    points[rows(lanes.centerline, other)] = points[rows(lanes.centerline, mine)]
    xy, next_xy = lanes.polygon.xy.copy(), lanes.polygon.next_xy.copy()
    for edges in (xy, next_xy):
        edges[rows(lanes.polygon, other)] = edges[rows(lanes.polygon, mine)]
    lanes = lanes.replace(
        centerline=lanes.centerline.replace(points=points),
        polygon=lanes.polygon.replace(xy=xy, next_xy=next_xy),
    )
    info = dataclasses.replace(info, token="two-lanes")
    return scenario.replace(map=scenario.map.replace(lanes=lanes)), info


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert (
        cli.main(["pack", "lane_ends,parked_car,jaywalker", str(folder), "--seeds", "0", "1"]) == 0
    )
    scenario, info = on_two_lanes()
    write_scenario(folder / f"{info.token}.npz", scenario, info)
    return folder


EXACT = (
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "collision_time",
    "ttc_time",
)
ROUNDED = {"total": 1e-6, "progress": 1e-6, "progress_raw": 5e-5}


def check(rows: polars.DataFrame, pack: Path, planner: Any) -> None:
    """Compares the rows of one point with a run of its planner alone."""
    plans = plan(load(pack), planner)
    rows = rows.sort("token")
    assert rows["token"].to_list() == [info.token for info in plans.infos]
    best, scene = plans.best, np.arange(len(plans))
    np.testing.assert_array_equal(rows["best"], best)
    np.testing.assert_array_equal(rows["num_valid"], plans.num_proposals)
    np.testing.assert_array_equal(rows["stage"], plans.plans.proposals.stage[scene, best])
    np.testing.assert_array_equal(rows["path"], plans.plans.proposals.path[scene, best])
    np.testing.assert_array_equal(rows["emergency_brake"], plans.plans.emergency_brake)
    for name in EXACT:
        np.testing.assert_array_equal(rows[name], getattr(plans.scores, name)[scene, best])
    for name, close in ROUNDED.items():
        np.testing.assert_allclose(
            rows[name], getattr(plans.scores, name)[scene, best], rtol=0, atol=close
        )
    for i, row in enumerate(rows.iter_rows(named=True)):
        told = plans.explain(i, int(best[i]))
        agent = row["collision_agent"] or row["ttc_agent"]
        if told.rule in ("no_at_fault_collision", "time_to_collision"):
            assert told.agent == (
                row["collision_agent"] if told.rule == "no_at_fault_collision" else agent
            )
        valid = plans.scores.valid[i]
        assert row["mean_total"] == pytest.approx(plans.scores.total[i][valid].mean(), abs=1e-6)


@pytest.mark.slow
def test_sweep_reads_every_number_as_separate_runs_would(
    pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    text, speeds = SPEEDS
    call, seen = SweepEngine._call, []

    def spy(self: Any, config: PlannerConfig, *given: Any) -> Any:
        seen.append((config.num_route_paths, len(given[-2].num_history)))
        return call(self, config, *given)

    monkeypatch.setattr(SweepEngine, "_call", spy)
    out = tmp_path / "run"
    command = ["sweep", str(pack), "--out", str(out), "--planner", "spdm", "--speeds", text]
    counts = (2, 4, 8)
    assert cli.main([*command, "--offsets", "0", "--num-proposals", *map(str, counts)]) == 0
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    assert table["status"].to_list() == ["ok"] * 7 * len(counts)
    # On two lanes at once stage 2 goes on elsewhere: there stage 1 is computed alone.
    assert (0, 1) in seen and {3, 0} == {paths for paths, _ in seen}
    for point, count in enumerate(counts):
        planner = spdm(count, speed_fractions=speeds, lateral_offsets=(0.0,))
        check(table.filter(point=point), pack, planner)
    assert set(table.filter(polars.col("num_proposals") > 2)["stage"]) == {1, 2}


@pytest.mark.slow
def test_sweep_runs_each_grid_of_pdm_closed_alone(pack: Path, tmp_path: Path):
    out = tmp_path / "run"
    command = ["sweep", str(pack), "--out", str(out), "--planner", "pdm-closed"]
    values = ["--num-proposals", "3", "6", "--set", "idm.headway_time=1,2.5"]
    assert cli.main([*command, *values]) == 0
    table = polars.read_parquet(out / "rows" / "part-*.parquet")
    groups = table["run_ms"].n_unique() // 4
    for (count, headway), rows in table.group_by("num_proposals", "idm.headway_time"):
        planner = pdm_closed(int(count))
        idm = planner.params.idm.replace(headway_time=headway)
        params = planner.params.replace(idm=idm)
        check(rows, pack, dataclasses.replace(planner, params=params))
    # Two values of a parameter share a program: one for each count and shape.
    progress = polars.read_json(out / "progress-all.json")["sessions"].list.first()
    assert 2 <= progress.struct.field("programs").item() <= 2 * groups
