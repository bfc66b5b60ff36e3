"""The reader on real logs, where they are at hand."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.optimize import linear_sum_assignment
from shapely.geometry import Polygon

from spdm_jax.io.av2 import AV2Reader
from spdm_jax.types import ObjectType

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
LOGS = SHARED / "data" / "av2_sensor"
GOLDEN = SHARED / "golden" / "pdm"

pytestmark = pytest.mark.skipif(not LOGS.is_dir(), reason="no Argoverse 2 logs at hand")


@pytest.fixture(scope="module")
def scenarios():
    reader = AV2Reader(LOGS)
    return {token: reader.read(token) for token in reader.tokens()}


def test_every_log_gives_twenty_scenarios(scenarios):
    logs = [s.log_name for s in scenarios.values()]
    assert len(set(logs)) == 3 and all(logs.count(name) == 20 for name in logs)
    for scenario in scenarios.values():
        steps = len(scenario.time_us)
        assert scenario.num_history + scenario.num_iterations <= steps
        assert scenario.num_iterations >= 60
        assert scenario.ego.shape == (steps, 11) and np.isfinite(scenario.ego).all()
        assert scenario.tracks.valid.any(1).all() and len(scenario.tracks.ids) > 50


def test_ego_is_on_its_route_and_on_drivable_ground(scenarios):
    for token, s in scenarios.items():
        window = s.ego[s.num_history :, :2]
        route = [lane for block in s.route_roadblocks for lane in s.map.roadblocks[block].lanes]
        lanes = shapely.union_all([Polygon(s.map.lanes[lane].polygon) for lane in route])
        ground = shapely.union_all([area.polygon for area in s.map.drivable])
        on_lanes = shapely.dwithin(lanes, shapely.points(window), 0.3)
        assert on_lanes.all(), token
        assert shapely.contains_xy(ground, *s.ego[:, :2].T).all(), token
        links = itertools.pairwise(s.route_roadblocks)
        assert all(b in s.map.roadblocks[a].successors for a, b in links), token
        assert s.mission_goal is not None
        assert np.hypot(*(s.mission_goal[:2] - s.ego[-1, :2])) > 60.0, token


def longest(scenarios):
    return [s for token, s in scenarios.items() if token.endswith("_000")]


def test_ego_velocity_matches_finite_differences(scenarios):
    for s in longest(scenarios):
        x, y, heading, vx, vy, ax, ay = s.ego[:, :7].T
        dx, dy = (x[2:] - x[:-2]) / 0.2, (y[2:] - y[:-2]) / 0.2
        c, sn = np.cos(heading[1:-1]), np.sin(heading[1:-1])
        moving = np.hypot(vx, vy)[1:-1] > 0
        np.testing.assert_allclose(vx[1:-1][moving], (c * dx + sn * dy)[moving], atol=0.15)
        np.testing.assert_allclose(vy[1:-1][moving], (-sn * dx + c * dy)[moving], atol=0.15)
        assert np.hypot(dx, dy)[~moving].max(initial=0) < 0.1
        # The rear axle of a car slides little; what it feels sideways comes from turning.
        assert np.abs(vy).max() < 0.3
        assert np.abs(ax).max() < 4.0
        assert np.abs(ay - vx * s.ego[:, 9]).max() < 1.0


def test_track_velocity_matches_finite_differences(scenarios):
    for s in longest(scenarios):
        tracks = s.tracks
        both = tracks.valid[:, 2:] & tracks.valid[:, 1:-1] & tracks.valid[:, :-2]
        both &= (tracks.type <= ObjectType.BICYCLE)[:, None]
        rough = (tracks.pose[:, 2:, :2] - tracks.pose[:, :-2, :2]) / 0.2
        error = np.linalg.norm(tracks.velocity[:, 1:-1] - rough, axis=2)[both]
        assert np.percentile(error, 50) < 0.15 and np.percentile(error, 99) < 0.6
        speed = np.linalg.norm(tracks.velocity, axis=2)
        assert speed.max() < 30 and (speed[speed > 0] >= 0.25).all()
        assert (speed[tracks.type > ObjectType.BICYCLE] == 0).all()


def test_tracks_keep_their_identity_between_scenarios(scenarios):
    tokens = list(scenarios)
    for a, b in itertools.pairwise(tokens):
        first, second = scenarios[a], scenarios[b]
        if first.log_name != second.log_name:
            continue
        time = np.intersect1d(first.time_us, second.time_us)
        i = np.searchsorted(first.time_us, time)
        j = np.searchsorted(second.time_us, time)
        common = sorted(set(first.tracks.ids) & set(second.tracks.ids))
        assert len(common) > 50
        rows = [first.tracks.ids.index(k) for k in common]
        others = [second.tracks.ids.index(k) for k in common]
        np.testing.assert_array_equal(
            first.tracks.pose[rows][:, i], second.tracks.pose[others][:, j]
        )
        np.testing.assert_array_equal(first.tracks.type[rows], second.tracks.type[others])


SCENES = [
    (log, city, index)
    for log, city, first in (
        ("7fab2350", 47896, 15),
        ("adcf7d18", 57819, 10),
        ("3bffdcff", 71109, 15),
    )
    for index in (first, 60)
]


@pytest.mark.parametrize(("log", "city", "index"), SCENES)
def test_agrees_with_independent_scenes(scenarios, log, city, index):
    """The scenes come from the same sweeps by other hands: another fit, smoothed positions."""
    path = GOLDEN / f"scene_av2_pit{city}_{index}.npz"
    if not path.is_file():
        pytest.skip("no reference scenes at hand")
    scene = np.load(path)
    s = scenarios[f"{log}_000"]
    shift = np.round((s.ego[index, :2] - scene["ego_state"][:2]) / 100) * 100
    seen = s.tracks.valid[:, index]
    center = s.tracks.pose[seen, index, :2] - shift
    assert len(center) == len(scene["raw_box"])
    distance = np.linalg.norm(center[None] - scene["raw_box"][:, None, :2], axis=2)
    match = linear_sum_assignment(distance)[1]
    assert np.linalg.norm(center[match] - scene["raw_box"][:, :2], axis=1).max() < 0.25
    np.testing.assert_allclose(s.ego[index, :3] - [*shift, 0], scene["ego_state"][:3], atol=0.02)
    assert s.ego[index, 3] == pytest.approx(scene["ego_state"][3], abs=0.1)
    assert s.ego[index, 9] == pytest.approx(scene["ego_state"][9], abs=0.02)
    assert s.ego[index, 7] == pytest.approx(scene["ego_state"][7], abs=0.02)
    error = np.linalg.norm(s.tracks.velocity[seen, index][match] - scene["raw_velocity"], axis=1)
    assert np.percentile(error, 90) < 0.1 and error.max() < 0.3
    size = s.tracks.size[seen, index][match]
    np.testing.assert_allclose(size, scene["raw_box"][:, 3:], atol=1e-6)
    # Motorcycles count as bicycles here (nuPlan's definition), as vehicles there.
    kind = s.tracks.type[seen][match]
    differs = kind != scene["raw_type"]
    assert set(kind[differs]) <= {ObjectType.BICYCLE} and differs.sum() <= 3
