"""SPDM: its candidate set, their order, and what it does that PDM-Closed cannot."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from spdm_jax import api
from spdm_jax.config import pdm_closed, spdm
from spdm_jax.io.raw import RawScenario
from spdm_jax.proposals.spline import RouteLanePaths, route_lane_paths
from spdm_jax.types import ProposalSet

PDM, SPDM = roads.PDM, roads.SPDM

_paths = jax.jit(route_lane_paths, static_argnames=("num_paths", "max_points"))


def paths_of(raw: RawScenario, num_paths: int = 12) -> tuple[RouteLanePaths, list[str]]:
    """Stage-2 paths at iteration 0 and the lane ids of the valid ones."""
    scene = roads.scene_of(raw)
    state = roads.init(scene, PDM.params, config=PDM.config)
    lanes = scene.map.lanes
    lane = scene.route.start_lane[state.slot]
    found = _paths(
        lanes,
        scene.route,
        state.slot,
        lanes.roadblock[lane],
        jax.tree.map(lambda v: v[0], state.paths),
        state.goal,
        roads.observe(scene, 0).ego,
        PDM.params.spline,
        num_paths=num_paths,
        max_points=PDM.config.max_path_points,
    )
    names = api.from_raw([raw], padding=roads.PADDING).infos[0].lane_ids
    valid = np.asarray(found.valid)
    return found, [names[i] for i in np.asarray(found.lane)[valid]]


def merge_distances(found: RouteLanePaths) -> np.ndarray:
    """Where each valid path has reached its lane: length of the connecting curve along x."""
    out = []
    for row in np.flatnonzero(found.valid):
        x, y = np.asarray(found.path.x)[row], np.asarray(found.path.y)[row]
        on_lane = np.abs(y - y[-1]) < 1e-9
        out.append(x[np.flatnonzero(on_lane)[0]] - x[0])
    return np.array(out)


def test_without_route_paths_it_is_pdm_closed():
    one, other = spdm(15), pdm_closed(15)
    assert one.config == other.config and hash(one.config) == hash(other.config)
    assert jax.tree.structure(one.params) == jax.tree.structure(other.params)
    for a, b in zip(jax.tree.leaves(one.params), jax.tree.leaves(other.params), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("gap", [None, 25.0])
def test_stage_1_is_pdm_closed_bit_for_bit(gap: float | None):
    raw = roads.road(things=[] if gap is None else [roads.parked(gap)])
    one, other = roads.plan(raw, PDM), roads.plan(raw, SPDM)
    for part in ("proposals", "tracked"):
        a, b = getattr(one, part), getattr(other, part)
        for name in a.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[:15], err_msg=name)
    for name in ("no_at_fault_collision", "time_to_collision", "comfort_flags", "drivable_area"):
        a, b = getattr(one.scores, name), getattr(other.scores, name)
        np.testing.assert_array_equal(a, b[:15])
    np.testing.assert_array_equal(one.progress_centerline, other.progress_centerline[:15])


@pytest.mark.parametrize("lanes, ego_lane", [((0, 1), 1), ((0, 1, 2), 1)])
def test_path_sets_nest(lanes: tuple[int, ...], ego_lane: int):
    raw = roads.road(blocks=(lanes, lanes), ego_lane=ego_lane)
    whole, _ = paths_of(raw)
    for num in (1, 6):
        part, _ = paths_of(raw, num)
        for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(whole), strict=True):
            np.testing.assert_array_equal(a, b[:num] if np.ndim(b) else b)


def test_order_of_paths():
    """Other lanes before the own one; 4 s, 2 s, 6 s outermost; left before right at a tie."""
    raw = roads.road(blocks=((0, 1, 2), (0, 1, 2)), ego_lane=1, speed=10.0)
    found, lanes = paths_of(raw)
    assert lanes == ["b0/0", "b0/2"] * 3 + ["b0/1"] * 3
    np.testing.assert_allclose(merge_distances(found)[:6], np.repeat([40, 20, 60], 2), atol=1e-6)
    np.testing.assert_array_equal(found.valid, np.arange(12) < 9)
    np.testing.assert_array_equal(np.asarray(found.lane)[9:], -1)


def test_goal_side_comes_first():
    """Only the right lane goes on: it comes before the left one, which is as near."""
    raw = roads.road(blocks=((0, 1, 2), (2,)), ego_lane=1, cuts=(250.0, 600.0))
    _, lanes = paths_of(raw)
    assert lanes == ["b0/2", "b0/0"] * 3 + ["b0/1"] * 3


def test_nearer_lanes_come_first():
    raw = roads.road(blocks=((0, 1, 2), (0, 1, 2)), ego_lane=0)
    _, lanes = paths_of(raw)
    assert lanes == ["b0/1", "b0/2"] * 3 + ["b0/0"] * 3


@pytest.mark.parametrize(
    "speed, expected",
    [(0.0, [20, 10, 30]), (5.0, [20, 10, 30]), (13.0, [52, 26, 78]), (18.0, [72, 36, 80])],
)
def test_merge_distances_are_clipped(speed: float, expected: list[float]):
    found, _ = paths_of(roads.road(speed=speed))
    np.testing.assert_allclose(merge_distances(found)[:3], expected, atol=1e-6)


def test_paths_start_at_the_ego_and_follow_their_lane():
    raw = roads.road(ego_y=-3.2, ego_heading=0.05)
    found, _ = paths_of(raw)
    x, y, heading = (np.asarray(getattr(found.path, n))[:6] for n in ("x", "y", "heading"))
    ego = roads.observe(roads.scene_of(raw), 0).ego
    np.testing.assert_allclose(x[:, 0], ego.x, atol=1e-9)
    np.testing.assert_allclose(y[:, 0], ego.y, atol=1e-9)
    np.testing.assert_allclose(heading[:, 0], 0.05, atol=1e-9)
    lateral = y[:, -1] - float(ego.y) - 3.2  # in the road's frame
    np.testing.assert_allclose(lateral, [0, 0, 0, -3.5, -3.5, -3.5], atol=1e-9)
    progress = np.asarray(found.path.progress)
    for row, count in enumerate(np.asarray(found.path.count)[:6]):
        assert np.all(np.diff(progress[row, :count]) >= 0)


def test_missing_paths_are_masked_and_never_chosen():
    result = roads.plan(roads.road(), SPDM)
    valid = result.proposals.valid
    # Two lanes times three merge distances are all there is.
    np.testing.assert_array_equal(valid, np.arange(60) < 45)
    np.testing.assert_array_equal(result.scores.total[~valid], 0)
    np.testing.assert_array_equal(result.scores.valid, valid)
    assert valid[int(result.best)]
    # Speeds that run past the end of the road are not offered either.
    short = roads.plan(roads.road(cuts=(100.0, 145.0)), SPDM)
    second = short.proposals.stage == 2
    assert 0 < (short.proposals.valid & second).sum() < 30
    assert short.proposals.valid[int(short.best)]
    np.testing.assert_array_equal(short.scores.total[~short.proposals.valid], 0)


def test_rows_say_where_they_come_from():
    proposals: ProposalSet = roads.plan(roads.road(), SPDM).proposals
    np.testing.assert_array_equal(proposals.stage, np.repeat([1, 2], [15, 45]))
    np.testing.assert_array_equal(proposals.path, np.repeat(np.arange(12), 5))
    np.testing.assert_array_equal(proposals.policy, np.tile(np.arange(5), 12))
    assert len(set(proposals.lane[15:30])) == 1 and len(set(proposals.lane[30:45])) == 1
    np.testing.assert_array_equal(proposals.lane[45:], -1)


def test_progress_is_measured_along_the_configured_reference():
    raw = roads.lane_end()
    one, other = roads.plan(raw, PDM), roads.plan(raw, SPDM)
    np.testing.assert_array_equal(one.scores.progress_raw, one.progress_centerline)
    np.testing.assert_array_equal(other.scores.progress_raw, other.progress_goal)
    np.testing.assert_allclose(other.progress_goal[:15], one.progress_goal, atol=1e-9)


@pytest.mark.parametrize("gap, speed", [(25.0, 10.0), (40.0, 10.0), (15.0, 5.0), (25.0, 5.0)])
def test_parked_car_is_passed_on_the_free_lane(gap: float, speed: float):
    raw = roads.road(speed=speed, things=[roads.parked(gap)])
    pdm, ours = roads.plan(raw, PDM), roads.plan(raw, SPDM)
    best = int(ours.best)
    assert ours.proposals.stage[best] == 2
    assert ours.trajectory.y[-1] - ours.trajectory.y[0] == pytest.approx(3.5, abs=1e-3)
    assert ours.scores.no_at_fault_collision[best] == 1
    for reference in ("progress_goal", "progress_centerline"):
        mine, theirs = getattr(ours, reference)[best], getattr(pdm, reference)[int(pdm.best)]
        assert mine > theirs + 3.0
    np.testing.assert_allclose(pdm.trajectory.y, pdm.trajectory.y[0], atol=1.1)


def test_lane_change_saves_the_ego_from_a_lane_that_ends():
    poses, results = roads.drive(roads.lane_end(length=90.0), SPDM, 150)
    end = roads.EGO_X + 90.0
    beyond = np.flatnonzero(poses[:, 0] > end + 20.0)
    assert len(beyond) and beyond[0] < 120
    assert np.abs(poses[beyond, 1]).max() < 0.5  # on the goal lane
    chosen = [int(r.best) for r in results]
    scores = [jax.tree.map(np.asarray, r.scores) for r in results]
    for best, score in zip(chosen, scores, strict=True):
        assert score.no_at_fault_collision[best] == 1 and score.drivable_area[best] == 1
    assert not any(bool(r.overflow) for r in results)


def test_paths_are_rebuilt_once_the_lane_change_is_complete():
    raw = roads.road()  # the ego's centreline is lane 1
    scene = roads.scene_of(raw)
    state = roads.init(scene, SPDM.params, config=SPDM.config)
    step = partial(roads.advance, config=SPDM.config)
    names = {}
    for label, (ego_y, ego_heading) in {
        "on the way": (-0.6, 0.0),
        "askew": (-0.2, 0.2),
        "complete": (-0.4, 0.0),
    }.items():
        moved = roads.road(ego_y=ego_y, ego_heading=ego_heading)
        other = roads.observe(roads.scene_of(moved), 0)
        # Same frame: the rounded origin of that scene differs from this one's.
        shift = np.round(ego_y) - np.round(-3.5)
        ego = other.ego.replace(y=other.ego.y + shift)
        _, following, _ = step(scene, roads.observe(scene, 0).replace(ego=ego), state, SPDM.params)
        names[label] = following
    assert int(names["on the way"].slot) == int(state.slot)
    assert int(names["askew"].slot) == int(state.slot)
    done = names["complete"]
    assert int(done.slot) != int(state.slot)
    centre = np.asarray(done.paths.y)[0] - np.asarray(state.paths.y)[0]
    np.testing.assert_allclose(centre, 3.5, atol=1e-9)
    np.testing.assert_array_equal(names["askew"].paths.y, state.paths.y)
    assert jnp.isfinite(done.paths.x).all()
