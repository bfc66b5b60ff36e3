import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon

from spdm_jax.io.av2_map import centerline
from spdm_jax.io.av2_route import snap_route
from spdm_jax.io.raw import RawLane, RawMap, RawRoadblock, ScenarioError

WIDTH = 4.0


def lane(key, *path, block=None, **fields):
    """A lane 4 m wide along a polyline."""
    path = np.array(path, float)
    line = shapely.LineString(path)
    left, right = (
        np.asarray(line.offset_curve(side, join_style="mitre").coords)
        for side in (WIDTH / 2, -WIDTH / 2)
    )
    return RawLane(
        id=key,
        is_connector=False,
        roadblock=block or f"rb_{key}",
        centerline=centerline(left, right),
        left_boundary=left,
        right_boundary=right,
        polygon=np.concatenate([left, right[::-1]]),
        **fields,
    )


def road(*lanes):
    blocks = {}
    for one in lanes:
        blocks.setdefault(one.roadblock, []).append(one.id)
    return RawMap(
        name="test",
        lanes={one.id: one for one in lanes},
        roadblocks={k: RawRoadblock(k, False, Polygon(), lanes=v) for k, v in blocks.items()},
    )


def drive(*path, step=0.8):
    """Poses along a polyline, equally spaced."""
    line = shapely.LineString(path)
    at = np.arange(0, line.length - step, step)
    xy = shapely.get_coordinates(line.interpolate(at))
    ahead = shapely.get_coordinates(line.interpolate(at + step))
    return np.column_stack([xy, np.arctan2(*(ahead - xy).T[::-1])])


@pytest.fixture
def fork():
    """a -> b (straight) or c (turns left, through the same area), b -> d or e; x is oncoming."""
    return road(
        lane("a", (0, 0), (50, 0), successors=["c", "b"]),
        lane("b", (50, 0), (70, 0), successors=["e", "d"]),
        lane("c", (50, 0), (60, 0), (70, 20), successors=["f"]),
        lane("d", (70, 0), (120, 2), successors=["g"]),
        lane("e", (70, 0), (110, -30)),
        lane("f", (70, 20), (70, 60)),
        lane("g", (120, 2), (200, 5)),
        lane("x", (70, 0.5), (0, 0.5), successors=["y"]),
        lane("y", (0, 0.5), (-50, 0.5)),
    )


def test_follows_links_and_extends_straight(fork):
    poses = drive((10.1, 0.3), (62, 0.3))
    route = snap_route(fork, poses)
    assert route.lanes == ("a", "b", "d", "g")
    assert route.notes == ()
    np.testing.assert_array_equal(route.position, poses[:, 0] >= 50)
    assert not route.off_lanes.any()
    assert route.roadblocks(fork, 0) == ["rb_a", "rb_b", "rb_d", "rb_g"]
    assert route.roadblocks(fork, len(poses) - 1) == ["rb_b", "rb_d", "rb_g"]
    np.testing.assert_allclose(route.goal(fork)[:2], [200, 5], atol=1e-9)
    assert route.goal(fork)[2] == pytest.approx(np.arctan2(3, 80), abs=0.02)


def test_recorded_turn_is_kept_and_short_end_is_noted(fork):
    route = snap_route(fork, drive((30, 0), (60, 0), (69, 18)))
    assert route.lanes == ("a", "c", "f")
    assert route.notes == ("route: ends 40 m beyond the last recorded lane, where the map does",)


def test_oncoming_lane_is_no_candidate(fork):
    route = snap_route(fork, drive((60, 0.5), (10, 0.5)))
    assert route.lanes[:2] == ("x", "y")


def test_steps_off_the_lanes_keep_their_place(fork):
    poses = drive((10, 0.3), (62, 0.3))
    poses[5:10, 1] = 30.0
    poses[0, 1] = 30.0
    route = snap_route(fork, poses)
    assert route.lanes == ("a", "b", "d", "g")
    assert np.flatnonzero(route.off_lanes).tolist() == [0, 5, 6, 7, 8, 9]
    assert (route.position[:10] == 0).all()


def test_lane_skipped_between_two_steps_is_filled_in():
    tiny = road(
        lane("a", (0, 0), (50, 0), successors=["b"]),
        lane("b", (50, 0), (50.5, 0), successors=["c"]),
        lane("c", (50.5, 0), (200, 0)),
    )
    poses = drive((40, 0), (80, 0), step=3.0)
    poses = poses[np.abs(poses[:, 0] - 50.25) > 1.0]
    assert snap_route(tiny, poses).lanes == ("a", "b", "c")


def test_lane_change_stays_in_one_roadblock():
    two = road(
        lane("l", (0, 4), (60, 4), block="rb", successors=["m"], right_neighbor="r"),
        lane("r", (0, 0), (60, 0), block="rb", successors=["s"], left_neighbor="l"),
        lane("m", (60, 4), (200, 4), block="next", right_neighbor="s"),
        lane("s", (60, 0), (200, 0), block="next", left_neighbor="m"),
    )
    early = snap_route(two, drive((0, 0), (20, 0), (45, 4), (80, 4)))
    assert early.lanes == ("r", "l", "m")
    assert early.roadblocks(two, 0) == ["rb", "next"]
    # Changing at the very border of two lanes passes through the lane that follows.
    border = drive((0, 0), (80, 0))
    border[border[:, 0] > 60, 1] = 4.0
    assert snap_route(two, border).lanes == ("r", "s", "m")


def test_broken_link_is_noted():
    gap = road(lane("a", (0, 0), (50, 0)), lane("b", (50, 0), (100, 0)))
    route = snap_route(gap, drive((10, 0), (80, 0)))
    assert route.lanes == ("a", "b")
    assert route.notes[0].startswith("route: no lane link leads from a to b")


def test_ego_on_no_lane_is_refused(fork):
    with pytest.raises(ScenarioError, match=r"map test: no lane contains the ego .* 10\.0, 500\.0"):
        snap_route(fork, drive((10, 500), (60, 500)))
