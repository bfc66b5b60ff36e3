"""Frames made of our own scenarios: what stands for NAVSIM's arrays, and our reference."""

import itertools

import jax
import numpy as np
import pytest
import shapely

import small_road as roads
import spdm_jax
from navsim_stand_in import straight
from spdm_jax.api import _of_frames, fit_config
from spdm_jax.config import PlannerConfig
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.frames import NavsimInfo, NavsimSet
from spdm_jax.navsim.from_scenario import (
    Way,
    _without_holes,
    from_scenarios,
    reference_difference,
    scenario_arrays,
)
from spdm_jax.results import ScenarioSet
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2
from spdm_jax.synthetic import make_scene
from spdm_jax.types import Scenario

WAY = Way(np.eye(3), np.array(3), np.zeros((41, 3)), np.array(False))
FRAMES = 5 * np.arange(11)


@pytest.fixture(scope="module")
def scenarios() -> ScenarioSet:
    return spdm_jax.from_raw([make_scene("parked_car"), make_scene("red_light")])


def one(scenes: ScenarioSet, row: int) -> Scenario:
    return jax.tree.map(lambda leaf: leaf[row], scenes.batch)


@pytest.fixture(scope="module")
def arrays(scenarios: ScenarioSet) -> dict[str, np.ndarray]:
    """Of the red light."""
    found, profiles = scenario_arrays(one(scenarios, 1), scenarios.infos[1], WAY)
    assert profiles == ("navsim1", "navsim2", "navsim2_unfiltered")
    return found


def test_record_stands_for_the_log(scenarios: ScenarioSet, arrays: dict[str, np.ndarray]):
    scene = one(scenarios, 1)
    now, tracks = int(scene.num_history), scene.tracks
    seen = np.flatnonzero(tracks.valid[:, now + FRAMES].any(axis=1))
    np.testing.assert_array_equal(arrays["log_valid"], tracks.valid[seen][:, now + FRAMES].T)
    x = np.where(arrays["log_valid"], tracks.x[seen][:, now + FRAMES].T + scene.origin[0], 0)
    np.testing.assert_array_equal(arrays["log_pose"][..., 0], x)
    assert len(arrays["obj_type"]) == len(seen) and (arrays["obj_size"] > 0).all()


def test_ego_has_what_the_logs_of_navsim_have(
    scenarios: ScenarioSet, arrays: dict[str, np.ndarray]
):
    scene, info = one(scenarios, 1), scenarios.infos[1]
    now = int(scene.num_history)
    assert np.any(scene.ego.yaw_rate[now - 15 : now + 1] != 0) or np.any(scene.ego.steering != 0)
    for states in (arrays["ego_past"], arrays["ego_state"][None]):
        assert not states[:, 7:].any()
    np.testing.assert_array_equal(arrays["ego_past"][:, 3], scene.ego.vx[now + FRAMES[:4] - 15])
    np.testing.assert_array_equal(arrays["ego_past"][-1], arrays["ego_state"])
    assert arrays["ego_past_us"].tolist() == [
        info.iteration0_time_us - age for age in (1_500_000, 1_000_000, 500_000, 0)
    ]
    heading = arrays["ego_state"][2]
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    ahead = arrays["human_poses"][:, :2] @ turn.T + arrays["ego_state"][:2] - scene.origin
    recorded = np.stack([scene.ego.x, scene.ego.y], axis=-1)[now + FRAMES[1:9]]
    np.testing.assert_allclose(ahead, recorded, rtol=0, atol=1e-9)


def test_blocks_lanes_and_intersections_by_kind(
    scenarios: ScenarioSet, arrays: dict[str, np.ndarray]
):
    world = one(scenarios, 1).map
    kind, owner = arrays["map_kind"], arrays["map_ring_object"]
    connector = world.roadblocks.is_connector[world.lanes.roadblock]
    assert set(kind.tolist()) == {0, 1, 2, 3}
    assert (kind == 0).sum() <= (world.roadblocks.valid & ~world.roadblocks.is_connector).sum()
    assert (kind == 2).sum() <= (world.lanes.valid & connector).sum()
    assert set(kind[arrays["map_on_route"]].tolist()) == {1, 2}
    # Every block and intersection touches the square around the ego's centre.
    x, y, heading = arrays["ego_state"][:3]
    center = np.array([x + 1.461 * np.cos(heading), y + 1.461 * np.sin(heading)])
    square = shapely.box(*(center - 100), *(center + 100))
    points = arrays["map_ring_xy"]
    rings = [
        shapely.Polygon(points[a:b]) for a, b in itertools.pairwise(arrays["map_ring_offsets"])
    ]
    for row in np.flatnonzero((kind == 0) | (kind == 3)):
        own = [ring for ring, of in zip(rings, owner, strict=True) if of == row]
        assert shapely.intersects(own, square).any()


def test_red_connectors_of_the_route(scenarios: ScenarioSet, arrays: dict[str, np.ndarray]):
    scene = one(scenarios, 1)
    now, lanes = int(scene.num_history), scene.map.lanes
    given = np.isin(lanes.roadblock, scene.route.given_roadblocks) & lanes.valid
    red = (scene.lights[now + FRAMES] == 3) & given
    assert arrays["log_red"].shape == (red.any(axis=0).sum(), 11) and arrays["log_red"].any()
    np.testing.assert_array_equal(arrays["log_red"], red[:, red.any(axis=0)].T)
    assert len(arrays["red_offsets"]) == len(arrays["log_red"]) + 1


def test_record_that_is_too_short():
    scenes = spdm_jax.from_raw([roads.road()], padding=roads.PADDING)
    scene, info = one(scenes, 0), scenes.infos[0]
    found, profiles = scenario_arrays(scene, info, WAY)
    assert profiles == ("navsim1",) and "ego_past" not in found
    now = int(scene.num_history)
    short = scene.replace(ego_valid=scene.ego_valid & (np.arange(128) < now + 41))
    found, profiles = scenario_arrays(short, info, WAY)
    assert profiles == () and not found["log_valid"][9:].any()
    with pytest.raises(ValueError, match=r"records 3\.5 s after iteration 0; 4 s are needed"):
        scenario_arrays(scene.replace(ego_valid=np.arange(128) < now + 40), info, WAY)


def test_polygon_with_holes_is_cut_through_them():
    holes = [shapely.box(x, 2, x + 1, 3).exterior for x in (2, 5)]
    shape = shapely.MultiPolygon(
        [shapely.Polygon(shapely.box(0, 0, 10, 5).exterior, holes), shapely.box(20, 0, 21, 1)]
    )
    parts = list(_without_holes(shape))
    assert not any(part.interiors for part in parts)
    assert sum(part.area for part in parts) == pytest.approx(shape.area)
    assert shapely.union_all(parts).equals(shape)


@pytest.mark.slow
def test_reference_is_what_pdm_closed_drives(scenarios: ScenarioSet):
    frames = from_scenarios(scenarios, fit_config(scenarios, PlannerConfig()), precision="f64")
    frames.require(NAVSIM1)
    frames.require(NAVSIM2)
    assert isinstance(frames, NavsimSet) and frames.tokens == ["parked_car-0", "red_light-0"]
    for frame in frames.frames:
        reference, center = frame.reference, frame.centerline
        line = shapely.LineString(np.stack([center.x, center.y], -1)[: int(center.count)])
        off = shapely.distance(line, shapely.points(reference[:, :2]))
        assert off.max() < 1.0 + 1e-6  # one of the three lateral offsets
        start = np.hypot(*(reference[0, :2] - [frame.ego.x, frame.ego.y]))
        assert start < 1.5
        assert np.hypot(*np.diff(reference[:, :2], axis=0).T).max() < 20.0 * 0.1
        assert reference_difference(frame, frame).max() == 0
        moved = frame.replace(reference=reference + np.array([0.3, 0.4, 0]))
        np.testing.assert_allclose(reference_difference(moved, frame), 0.5, rtol=0, atol=1e-9)
        later = frame.replace(start_time_us=frame.start_time_us + 5_000_000)
        with pytest.raises(ValueError, match=r"5\.0 s apart; compare frames of one token"):
            reference_difference(frame, later)


def test_reference_difference_does_not_depend_on_the_origin(
    scenarios: ScenarioSet, arrays: dict[str, np.ndarray]
):
    frame = from_arrays(arrays)
    moved = {**arrays, "ego_state": arrays["ego_state"] + np.eye(11)[0] * 0.8}
    moved = {name: v for name, v in moved.items() if not name.startswith(("prev", "ego_past"))}
    other = from_arrays(moved)
    assert (other.origin != frame.origin).any()
    np.testing.assert_allclose(reference_difference(frame, other), 0.0, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_scenarios_are_scored_by_every_profile(scenarios: ScenarioSet):
    drives = straight(22.0, 0.0)
    one = spdm_jax.score(scenarios, drives, profile="navsim1", precision="f64")
    two = spdm_jax.score(scenarios, drives, profile="navsim2", precision="f64")
    assert one.total.shape == two.total.shape == (2, 2)
    assert two.traffic_light[1].tolist() == [0, 1] and one.traffic_light.all()
    assert spdm_jax.to_navsim(scenarios, precision="f64") is spdm_jax.to_navsim(
        scenarios, precision="f64"
    )


def test_trajectories_of_scenarios_without_a_frame_are_left_out(scenarios: ScenarioSet):
    kept = NavsimSet([], [NavsimInfo("red_light-0", "", "synthetic", ())])
    sets = np.arange(2.0)[:, None, None, None] * np.ones((2, 3, 8, 3))
    np.testing.assert_array_equal(_of_frames(sets, 4, scenarios, kept), sets[1:])
    assert _of_frames(sets[0], 4, scenarios, kept) is not None
    assert _of_frames(None, 3, scenarios, kept) is None
