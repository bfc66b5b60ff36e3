"""interPlan's metrics on made-up runs."""

import jax
import numpy as np
import pytest

from small_road import road
from spdm_jax.interplan.config import ObstacleKind, Policy
from spdm_jax.interplan.extras import InterplanExtras
from spdm_jax.interplan.score import (
    UNKNOWN_START,
    beside,
    expert_route,
    judge,
    lane_changes_between,
    lane_changes_to_goal,
    required_progress,
    weighted_score,
)
from spdm_jax.io.build import build_scenario
from spdm_jax.metrics import SCORED
from straight_run import STEPS, Y, drive, evaluate, expert_of, history_of, straight_map

SCENE, INFO = build_scenario(road(blocks=((0, 1, 2), (0, 1, 2)), cuts=(200.0, 460.0)))
LANES = SCENE.map.lanes


def row(name: str) -> int:
    return INFO.lane_ids.index(name)


def route_of(*names: str) -> np.ndarray:
    """Lists of lanes `[T, L]`: names of one sample are joined by `+`, "" is off all lanes."""
    route = np.zeros((len(names), len(INFO.lane_ids)), bool)
    for members, name in zip(route, names, strict=True):
        members[[row(lane) for lane in name.split("+") if lane]] = True
    return route


@pytest.mark.parametrize("block", ["b0", "c0", "b1"])
def test_neighbours(block: str):
    lanes = [row(f"{block}/{k}") for k in range(3)]
    assert beside(LANES, lanes[0]) == [lanes[1]]
    assert beside(LANES, lanes[1]) == [lanes[0], lanes[2]]
    assert [lane_changes_between(LANES, lanes[2], goal) for goal in lanes] == [2, 1, 0]


def test_neighbours_that_the_map_does_not_name():
    nobody = np.full_like(np.asarray(LANES.left_neighbor), -1)
    unnamed = LANES.replace(left_neighbor=nobody, right_neighbor=nobody)
    # A lane without named neighbours is alone, unless its predecessors lead to others.
    assert lane_changes_between(unnamed, row("c0/2"), row("c0/0")) is None
    # Here two connectors leave one lane.
    after = np.pad(np.asarray(LANES.successors), ((0, 0), (0, 1)), constant_values=-1)
    before = np.pad(np.asarray(LANES.predecessors), ((0, 0), (0, 1)), constant_values=-1)
    after[row("b0/1"), -1], before[row("c0/0"), -1] = row("c0/0"), row("b0/1")
    forked = unnamed.replace(successors=after, predecessors=before)
    assert lane_changes_between(forked, row("c0/1"), row("c0/0")) == 1


def test_no_way_between_roadblocks():
    assert lane_changes_between(LANES, row("b0/1"), row("b1/1")) is None


@pytest.mark.parametrize(
    "ego, expert, expected",
    [
        # The expert changes lanes with its second sample.
        (["b0/1", "c0/1", "b1/1"], ["b0/1", "b0/0", "b1/0"], (1, 1, 0.0)),
        (["b0/1", "b0/0", "b1/0"], ["b0/1", "b0/0", "b1/0"], (1, 0, 1.0)),
        (["b0/2", "b0/1", "b1/1"], ["b0/2", "b0/0", "b1/0"], (2, 1, 0.5)),
        # The second sample is in the next roadblock: the first one counts.
        (["b0/1", "b1/1"], ["b0/0", "b1/0"], (1, 1, 0.0)),
        # None needed.
        (["b0/1", "c0/1", "b1/1"], ["b0/1", "c0/1", "b1/1"], (0, 0, 1.0)),
        (["b0/1", "b1/1", "b1/0"], ["b0/1", "b0/1", "b1/1"], (0, 1, 0.5)),
        # The ego stays behind: compared in the last roadblock that both saw.
        (["b0/1", "b0/1", "b0/0"], ["b0/1", "b0/0", "b1/0"], (1, 0, 1.0)),
        # The expert never leaves its lane: nothing was needed.
        (["b0/1", "b0/0"], ["b0/1", "b0/1"], (0, 1, 0.5)),
        # The ego starts elsewhere: the changes at the start cannot be counted.
        (["b1/1", "b1/1"], ["b0/1", "b1/1"], (None, 0, UNKNOWN_START)),
        # Overlapping connectors count where the expert took one of them too.
        (["b0/1", "c0/1+c0/0"], ["b0/1", "c0/0"], (0, 0, 1.0)),
        (["b0/1", "c0/1+c0/2", ""], ["b0/1", "c0/0", "c0/0"], (0, 0, 1.0)),
    ],
)
def test_lane_changes_to_goal(ego: list[str], expert: list[str], expected: tuple):
    found = lane_changes_to_goal(LANES, route_of(*ego), route_of(*expert))
    assert (found.at_start, found.at_end, found.score) == expected


@pytest.mark.parametrize("ego, expert", [("", "b0/1"), ("b0/1", "")])
def test_run_off_all_lanes_has_no_score(ego: str, expert: str):
    found = lane_changes_to_goal(LANES, route_of(ego, "b0/1"), route_of(expert, "b0/1"))
    assert found.at_end is None and np.isnan(found.score)


def test_required_progress():
    way = np.array([[0, 0], [0, 0], [50, 0], [100, 0]], float)
    assert required_progress(way, [(20, 3), (80, -5)]) == 0.8
    assert required_progress(way, [(-20, 3)]) == 0.0
    assert required_progress(way[:2], [(20, 3)]) == 0.0
    with pytest.raises(ValueError, match="no obstacles"):
        required_progress(way, [])


def scores(**changed: float) -> dict[str, float]:
    return dict.fromkeys(SCORED, 1.0) | {"lane_changes_to_goal": 1.0} | changed


@pytest.mark.parametrize(
    "scenario_type, changed, expected",
    [
        ("high_traffic_density", {}, 1.0),
        ("high_traffic_density", {"lane_changes_to_goal": 0.5}, 18 / 20),
        ("high_traffic_density", {"ego_progress_along_expert_route": 0.0}, 15 / 20),
        ("high_traffic_density", {"driving_direction_compliance": 0.5}, 0.5),
        ("low_traffic_density", {"no_ego_at_fault_collisions": 0.5}, 0.5),
        ("jaywalking_pedestrian", {"driving_direction_compliance": 0.5}, 0.5),
        ("jaywalking_pedestrian", {"ego_sorts_jaywalking_pedestrian": 0.0}, 0.0),
        ("avoid_crashed_cars", {"driving_direction_compliance": 0.5}, 20.5 / 21),
        ("avoid_crashed_cars", {"lane_changes_to_goal": 0.0}, 17 / 21),
        ("avoid_crashed_cars", {"ego_sorts_stopped_vehicle": 0.0}, 0.0),
        ("approaching_construction_zone", {"ego_sorts_construction_zone": 0.0}, 0.0),
        ("approaching_construction_zone", {"ego_is_making_progress": 0.0}, 0.0),
    ],
)
def test_weighted_score(scenario_type: str, changed: dict[str, float], expected: float):
    own = {
        "jaywalking_pedestrian": {"ego_sorts_jaywalking_pedestrian": 1.0},
        "avoid_crashed_cars": {"ego_sorts_stopped_vehicle": 1.0},
        "approaching_construction_zone": {"ego_sorts_construction_zone": 1.0},
    }.get(scenario_type, {})
    assert np.isclose(weighted_score(scores(**own) | changed, scenario_type), expected)


def test_unknown_metric_makes_the_score_unknown():
    for name in ("ego_is_comfortable", "drivable_area_compliance"):
        assert np.isnan(weighted_score(scores(**{name: np.nan}), "low_traffic_density"))


def test_lane_changes_that_cannot_be_counted_do_not_enter():
    changed = {"lane_changes_to_goal": np.nan, "ego_progress_along_expert_route": 0.0}
    assert np.isclose(weighted_score(scores(**changed), "low_traffic_density"), 11 / 16)


def extras(kind: ObstacleKind | None, scenario_type: str, *obstacles) -> InterplanExtras:
    return InterplanExtras(
        name="x-s0",
        base_token="x",
        scenario_type=scenario_type,
        policy=Policy.ASSERTIVE,
        stopped=(),
        cautious=(),
        pedestrians=(),
        obstacle_kind=kind,
        obstacles=obstacles,
        goal=(0.0, 0.0, 0.0),
        course=(),
        end=0.0,
    )


@pytest.mark.slow
def test_whole_run():
    """The ego stays in its lane at 8 m/s, the expert has moved left at once and drives 10 m/s."""
    scene_map = straight_map()
    left = np.where(np.arange(STEPS + 1) > 0, 0.0, Y)
    expert = expert_of(drive(10.0, y=left, steps=STEPS + 1))
    history = history_of(drive(8.0))
    metrics = jax.tree.map(np.asarray, evaluate(history, scene_map, expert))
    lanes = np.asarray(jax.jit(expert_route)(scene_map, expert, history.valid))
    origin = np.array([1000.0, 2000.0])
    give = lambda record: judge(metrics, lanes, expert, scene_map.lanes, origin, record)

    plain = give(extras(None, "high_traffic_density"))
    assert (plain.lane_changes.at_start, plain.lane_changes.at_end) == (1, 1)
    progress = plain.scores["ego_progress_along_expert_route"]
    assert np.isclose(progress, 8 * 4.9 / 50, atol=0.02)
    assert np.isclose(plain.final, (5 * progress + 5 + 0 + 4 + 2) / 20)
    assert plain.required_progress is None

    # The expert's centre covers 50 m from 61.461 m on.
    for x, passed in ((95.0, 1.0), (105.0, 0.0)):
        place = (1000.0 + x, 2000.0 + Y)
        record = extras(ObstacleKind.STOPPED_VEHICLES, "overtake_parked_vehicle", place)
        verdict = give(record)
        assert verdict.required_progress is not None
        assert np.isclose(verdict.required_progress, (x - 61.461) / 50, atol=0.1)
        assert verdict.scores["ego_sorts_stopped_vehicle"] == passed
        assert np.isclose(verdict.final, passed * (5 * progress + 5 + 4 + 2 + 1) / 21)


def test_run_without_samples():
    scene_map = straight_map()
    expert = expert_of(drive(10.0, steps=STEPS + 1))
    history = history_of(drive(8.0))
    history = history.replace(valid=np.zeros_like(history.valid))
    metrics = jax.tree.map(np.asarray, evaluate(history, scene_map, expert))
    lanes = np.asarray(jax.jit(expert_route)(scene_map, expert, history.valid))
    record = extras(ObstacleKind.STOPPED_VEHICLES, "overtake_parked_vehicle", (100.0, 0.0))
    verdict = judge(metrics, lanes, expert, scene_map.lanes, np.zeros(2), record)
    assert np.isnan(verdict.final) and np.isnan(verdict.scores["ego_sorts_stopped_vehicle"])
