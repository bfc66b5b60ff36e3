"""What pictures are drawn from: map, objects, proposals, and the moment a rule is broken."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from spdm_jax.config import VehicleParams
from spdm_jax.results import PlanSet, ScenarioSet, ScoreSet
from spdm_jax.viz.plan_data import check_plans, object_poses, read_plan, telling_proposal
from spdm_jax.viz.scene_data import (
    box_corners,
    ego_center,
    ego_pose,
    read_map,
    read_objects,
    take_scene,
)

VEHICLE = VehicleParams()
NUM, PADDED, BEST, STEP = 10, (1, 2), 6, 11  # as in conftest.py
COLLIDES, TOO_CLOSE, OFF_ROAD = 3, 4, 5


def row_of(scenes: ScenarioSet, kind: str) -> int:
    return [info.scenario_type for info in scenes.infos].index(kind)


def view_of(scenes: ScenarioSet, plans: ScoreSet, index: int):
    scene = take_scene(scenes, index)
    objects = read_objects(scene, scenes.infos[index].track_ids)
    return scene, objects, read_plan(plans, index, objects, VEHICLE)


def with_scores(plans: PlanSet, **changes) -> PlanSet:
    return replace(plans, scores=plans.scores.replace(**changes))


def test_corners_start_front_left():
    corners = box_corners(np.array([1.0, 2.0, np.pi / 2]), 4.0, 2.0)
    np.testing.assert_allclose(corners, [[0, 4], [0, 0], [2, 0], [2, 4]], atol=1e-12)


def test_ego_center_lies_ahead_of_the_rear_axle():
    center = ego_center(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, np.pi]]), VEHICLE)
    np.testing.assert_allclose(center[:, 0], [2.461, -0.461], atol=1e-12)
    np.testing.assert_allclose(center[:, 1], 2.0, atol=1e-12)


@pytest.mark.parametrize("reach", [30.0, 90.0])
def test_map_stays_in_the_window_and_the_route_on_the_road(scenes: ScenarioSet, reach: float):
    for index in range(len(scenes)):
        scene = take_scene(scenes, index)
        center = ego_pose(scene, 0, VEHICLE)[:2]
        world = read_map(scene, center, reach)
        rings = [
            r for group in (world.road, world.route, world.crosswalks) for a in group for r in a
        ]
        lines = [*world.lane_edges, *world.centerlines, *world.red, *world.stop_bars]
        points = np.concatenate([*rings, *lines])
        assert np.abs(points - center).max() <= reach + 0.1
        road = shapely.union_all([shapely.Polygon(a[0], a[1:]) for a in world.road])
        route = shapely.union_all([shapely.Polygon(a[0], a[1:]) for a in world.route])
        assert road.contains(shapely.Point(center))
        assert route.area > 100
        assert route.difference(road.buffer(0.2)).area < 1e-6 * route.area


def test_holes_of_the_road_stay_open(scenes: ScenarioSet):
    scene = take_scene(scenes, row_of(scenes, "roundabout"))
    world = read_map(scene, np.zeros(2), 250.0)
    holes = [ring for area in world.road for ring in area[1:]]
    assert holes, "the island of the roundabout is not drivable"
    for area in world.road:
        assert shapely.is_ccw(shapely.LinearRing(area[0]))
        assert not any(shapely.is_ccw(shapely.LinearRing(ring)) for ring in area[1:])


def test_red_connectors_follow_the_lights_of_the_step(scenes: ScenarioSet):
    for index, info in enumerate(scenes.infos):
        scene = take_scene(scenes, index)
        now = int(scene.num_history)
        for step in (0, 60):
            count = int(np.sum(np.asarray(scene.lights[now + step]) == 3))
            world = read_map(scene, np.zeros(2), 500.0, step)
            assert len(world.red) == len(world.stop_bars) == count, info.token
    red = take_scene(scenes, row_of(scenes, "red_light"))
    assert np.any(np.asarray(red.lights[int(red.num_history)]) == 3)


def test_objects_are_those_observed_at_the_step(scenes: ScenarioSet):
    index = row_of(scenes, "platoon")
    scene = take_scene(scenes, index)
    for step in (0, 30):
        objects = read_objects(scene, scenes.infos[index].track_ids, step)
        at = int(scene.num_history) + step
        assert len(objects.ids) == int(np.sum(scene.tracks.valid[:, at])) > 0
        for i, name in enumerate(objects.ids):
            track = scenes.infos[index].track_ids.index(name)
            tracks = scene.tracks
            pose = [tracks.x[track, at], tracks.y[track, at], tracks.heading[track, at]]
            np.testing.assert_array_equal(objects.pose[i], pose)


def test_padding_is_gone(scenes: ScenarioSet, plans: PlanSet):
    _, _, view = view_of(scenes, plans, 0)
    real = [i for i in range(NUM) if i not in PADDED]
    assert view.row.tolist() == real
    assert view.row[view.best] == BEST
    np.testing.assert_array_equal(view.states[:, :, 0], plans.tracked.x[0, real])
    np.testing.assert_array_equal(view.states[:, 0, 3], 4.0 + np.array(real))
    assert view.stage.tolist() == [1 + r // 5 for r in real]
    assert view.target_speed.tolist() == [1.0 + r % 5 for r in real]
    assert [told.proposal for told in view.explanations] == real


def test_a_scene_without_proposals_is_refused(scenes: ScenarioSet, plans: PlanSet):
    empty = with_scores(plans, valid=np.zeros_like(plans.scores.valid))
    with pytest.raises(ValueError, match=f"{scenes.infos[1].token}: no real proposal"):
        view_of(scenes, empty, 1)


def test_scores_of_given_trajectories_can_be_read(scenes: ScenarioSet, plans: PlanSet):
    given = ScoreSet(plans.scores, plans.tracked, plans.forecast, plans.infos)
    _, _, view = view_of(scenes, given, 0)
    assert view.row[view.best] == BEST
    assert (view.stage == -1).all() and np.isnan(view.target_speed).all()


def test_forecast_follows_the_objects_order(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "platoon")
    _, objects, view = view_of(scenes, plans, index)
    np.testing.assert_allclose(view.forecast[:, 0], objects.pose)
    moved = np.abs(view.forecast[:, -1, :2] - view.forecast[:, 0, :2]).max()
    assert moved > 10


def test_objects_without_forecast_are_known_at_the_start_only(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "platoon")
    valid = np.array(plans.forecast.valid)
    valid[index, np.argmax(valid[index])] = False
    _, objects, view = view_of(
        scenes, replace(plans, forecast=plans.forecast.replace(valid=valid)), index
    )
    assert np.isnan(view.forecast).all(axis=(1, 2)).sum() == 1
    np.testing.assert_array_equal(object_poses(objects, view.forecast, 0), objects.pose)
    assert np.isnan(object_poses(objects, view.forecast, 2)).all(axis=1).sum() == 1


def test_ignored_objects_are_told_apart(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "platoon")
    ignored = np.zeros_like(plans.forecast.valid)
    row = int(np.argmax(plans.forecast.valid[index]))
    ignored[index, row] = True
    _, objects, view = view_of(
        scenes, replace(plans, forecast=plans.forecast.replace(ignored=ignored)), index
    )
    assert objects.track[view.ignored].tolist() == [plans.forecast.track[index, row]]


def test_objects_stand_halfway_between_samples(scenes: ScenarioSet, plans: PlanSet):
    _, objects, view = view_of(scenes, plans, row_of(scenes, "platoon"))
    forecast = view.forecast.copy()
    forecast[:, 5, 2], forecast[:, 6, 2] = np.pi - 0.1, -np.pi + 0.3
    poses = object_poses(objects, forecast, 11)
    np.testing.assert_allclose(poses[:, :2], forecast[:, 5:7, :2].mean(axis=1))
    np.testing.assert_allclose(np.cos(poses[:, 2]), np.cos(np.pi + 0.1))
    np.testing.assert_array_equal(object_poses(objects, forecast, 40), forecast[:, 20])


def test_moment_of_a_collision(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "straight")
    _, objects, view = view_of(scenes, plans, index)
    at = view.row.tolist().index(COLLIDES)
    moment = view.moments[at]
    assert moment is not None and moment.rule == "no_at_fault_collision"
    assert moment.step == STEP and "t = 1.1 s" in moment.label
    assert view.explanations[at].agent == objects.ids[moment.object]
    np.testing.assert_allclose(moment.ego, ego_center(view.states[at, STEP, :3], VEHICLE))
    assert moment.object_pose is not None
    # As scored: the sample of 1.0 s holds until 1.2 s.
    np.testing.assert_array_equal(moment.object_pose, view.forecast[moment.object, 5])


def test_moment_of_a_short_time_to_collision(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "straight")
    at = [r for r in range(NUM) if r not in PADDED].index(TOO_CLOSE)
    forecast = plans.forecast
    row = int(plans.scores.ttc_object[index, TOO_CLOSE])
    # Put the object where the ego comes after 0.6 s at its speed, not before.
    ego = ego_center(view_of(scenes, plans, index)[2].states[at, STEP, :3], VEHICLE)
    way = 0.6 * 8.0 + 0.5 * VEHICLE.length + 0.5 * forecast.length[index, row] - 0.2
    x, y, heading = (np.array(v) for v in (forecast.x, forecast.y, forecast.heading))
    x[index, row], y[index, row] = ego[0] + way * np.cos(ego[2]), ego[1] + way * np.sin(ego[2])
    heading[index, row] = ego[2]
    placed = replace(plans, forecast=forecast.replace(x=x, y=y, heading=heading))
    _, _, view = view_of(scenes, placed, index)
    moment = view.moments[at]
    assert moment is not None and moment.rule == "time_to_collision" and moment.step == STEP
    assert moment.ahead is not None
    gone = np.hypot(*(moment.ahead - moment.ego)[:2])
    assert gone == pytest.approx(0.6 * 8.0)


def test_moment_off_the_road_blames_nobody(scenes: ScenarioSet, plans: PlanSet):
    _, _, view = view_of(scenes, plans, 0)
    moment = view.moments[view.row.tolist().index(OFF_ROAD)]
    assert moment is not None and moment.rule == "drivable_area" and moment.step == STEP
    assert moment.object == -1 and moment.object_pose is None


def test_the_best_failing_proposal_is_told_unless_the_chosen_one_fails(
    scenes: ScenarioSet, plans: PlanSet
):
    index = row_of(scenes, "straight")
    _, _, view = view_of(scenes, plans, index)
    telling = telling_proposal(view)
    assert telling is not None and view.row[telling] == TOO_CLOSE  # it keeps 60 % of its score
    lost = np.array(plans.scores.drivable_area)
    lost[:, BEST] = 0
    _, _, view = view_of(scenes, with_scores(plans, drivable_area=lost), index)
    assert telling_proposal(view) == view.best
    fine = with_scores(
        plans,
        no_at_fault_collision=np.ones_like(lost),
        drivable_area=np.ones_like(lost),
        time_to_collision=np.ones_like(lost),
    )
    assert telling_proposal(view_of(scenes, fine, index)[2]) is None


def test_of_equally_bad_proposals_one_with_an_object_is_told(scenes: ScenarioSet, plans: PlanSet):
    index = row_of(scenes, "straight")
    total = np.array(plans.scores.total)
    total[:, [COLLIDES, TOO_CLOSE, OFF_ROAD]] = 0
    fine = np.ones_like(total)
    equal = with_scores(plans, total=total, time_to_collision=fine)
    _, _, view = view_of(scenes, equal, index)
    telling = telling_proposal(view)
    assert telling is not None and view.row[telling] == COLLIDES


def test_plans_of_other_scenes_are_refused(scenes: ScenarioSet, plans: PlanSet):
    first, second = scenes.infos[:2]
    swapped = replace(plans, infos=[second, first, *scenes.infos[2:]])
    with pytest.raises(ValueError, match=rf"infos\[0\] is '{second.token}'.*'{first.token}'"):
        check_plans(scenes, swapped)
    with pytest.raises(ValueError, match=r"infos\[3\] is missing"):
        check_plans(scenes, replace(plans, infos=scenes.infos[:3]))


@pytest.mark.parametrize("index", [-1, 12])
def test_unknown_rows_are_refused(scenes: ScenarioSet, index: int):
    with pytest.raises(ValueError, match=f"index is {index}; the set has 12"):
        take_scene(scenes, index)
