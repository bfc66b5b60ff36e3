"""Point queries on a map that is simple enough to know the answers."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.io.map_query import MapLayer, MapQuery
from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock


def lane(id_: str, axis: list[tuple[float, float]], block: str, connector: bool = False) -> RawLane:
    line = shapely.LineString(axis)
    xy = np.array(axis, float)
    return RawLane(
        id=id_,
        is_connector=connector,
        roadblock=block,
        centerline=np.column_stack([xy, np.zeros(len(xy))]),
        left_boundary=xy,
        right_boundary=xy,
        polygon=shapely.get_coordinates(line.buffer(2.0, cap_style="flat").exterior),
    )


def block(
    id_: str, box: tuple[float, float, float, float], after: list[str], connector: bool
) -> RawRoadblock:
    return RawRoadblock(id_, connector, shapely.box(*box), successors=after)


ARC = [(20 * np.sin(a), 20 - 20 * np.cos(a)) for a in np.linspace(0, np.pi / 2, 2000)]
QUERY = MapQuery(
    RawMap(
        name="test",
        lanes={
            lane_.id: lane_
            for lane_ in (
                lane("east", [(0, 0), (10, 0), (40, 0)], "a"),
                lane("north", [(20, -20), (20, 20)], "b"),
                lane("turn", ARC, "ab", connector=True),
            )
        },
        roadblocks={
            "a": block("a", (0, -2, 40, 2), ["ab", "ac"], False),
            "ab": block("ab", (40, -2, 60, 2), ["b"], True),
            "ac": block("ac", (40, -2, 60, 4), ["c"], True),
            "b": block("b", (60, -2, 80, 2), [], False),
            "c": block("c", (60, 2, 80, 6), [], False),
        },
        drivable=[
            RawArea("1", shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 6, 6))),
            RawArea("1", shapely.box(20, 0, 30, 10), 3),
        ],
        crosswalks=[RawArea("bow", shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]))],
    )
)


def test_containing_keeps_the_order_of_points_and_map():
    found = QUERY.containing(MapLayer.LANE, np.array([[20, 0], [5, 0], [5, 9], [20, 9]]))
    assert found == [["east", "north"], ["east"], [], ["north"]]
    assert QUERY.containing(MapLayer.LANE_CONNECTOR, np.array([[14.0, 6.0]])) == [["turn"]]
    assert QUERY.containing(MapLayer.STOP_LINE, np.array([[0.0, 0.0]])) == [[]]


def test_a_self_touching_polygon_is_accepted():
    assert QUERY.containing(MapLayer.CROSSWALK, np.array([[1.0, 2.0], [3.5, 2.0]])) == [
        ["bow"],
        ["bow"],
    ]


def test_drivable_respects_holes():
    points = np.array([[1.0, 1.0], [5.0, 5.0], [25.0, 5.0], [15.0, 5.0]])
    assert QUERY.is_drivable(points).tolist() == [True, False, True, False]
    assert QUERY.is_drivable(np.zeros((0, 2))).shape == (0,)


def test_near_is_a_square_and_takes_connectors_by_their_line():
    # 9 m off in both axes is 12.7 m away, yet within the square of half side 10.
    assert QUERY.near(MapLayer.LANE, np.array([49.0, 11.0]), 10.0) == ["east"]
    assert QUERY.near(MapLayer.LANE, np.array([50.5, 11.0]), 10.0) == []
    # The area of the turn reaches 2 m outside its line.
    assert QUERY.near(MapLayer.LANE_CONNECTOR, np.array([0.0, -3.0]), 2.0) == []
    assert QUERY.near(MapLayer.LANE_CONNECTOR, np.array([0.0, -1.5]), 2.0) == ["turn"]


def test_nearest():
    assert QUERY.nearest(MapLayer.LANE, np.array([25.0, 10.0])) == ("north", 3.0)
    assert QUERY.nearest(MapLayer.LANE, np.array([5.0, 1.0])) == ("east", 0.0)
    with pytest.raises(ValueError, match="walkway"):
        QUERY.nearest(MapLayer.WALKWAY, np.array([0.0, 0.0]))


def test_projection():
    found = QUERY.project("east", np.array([12.0, 5.0]))
    assert found.arc_length == 12.0
    assert found.pose.tolist() == [12.0, 0.0, 0.0]
    # Beyond the end the heading is that of the last half metre.
    end = QUERY.project("north", np.array([21.0, 50.0]))
    np.testing.assert_allclose([end.arc_length, *end.pose], [40.0, 20.0, 20.0, np.pi / 2])


@given(st.floats(0.0, 20 * np.pi / 2 - 0.01))
def test_curvature_of_an_arc(arc_length: float):
    assert QUERY.curvature("turn", arc_length) == pytest.approx(1 / 20, rel=1e-3)
    assert QUERY.curvature("east", min(arc_length, 40.0)) == 0.0


def test_curvature_is_signed_and_bounded_by_the_line():
    right = MapQuery(
        RawMap("mirrored", {"r": lane("r", [(x, -y) for x, y in ARC[:100]], "a")}, roadblocks={})
    )
    # Shorter than 4 m: the circle goes through start, middle and end.
    assert right.curvature("r", 0.0) == pytest.approx(-1 / 20, rel=1e-3)
    with pytest.raises(ValueError, match="arc_length is 41"):
        QUERY.curvature("east", 41.0)


def test_route_of_a_drive():
    x = np.linspace(1, 79, 200)
    straight = np.column_stack([x, np.zeros(200)])
    # Both connectors contain the drive until it enters b, which settles it without them.
    assert QUERY.roadblocks_along(straight) == ["a", "b"]
    upper = np.column_stack([x, np.where(x > 45, 3.0, 0.0)])
    assert QUERY.roadblocks_along(upper) == ["a", "ac", "c"]
    assert QUERY.roadblocks_along(np.array([[0.0, 50.0]])) == []
    assert QUERY.roadblocks_along(np.zeros((0, 2))) == []
