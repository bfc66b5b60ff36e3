import json

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Polygon

from spdm_jax.io.av2_map import centerline, read_map
from spdm_jax.io.raw import ScenarioError
from spdm_jax.types import DrivableKind


def points(xy):
    return [{"x": float(x), "y": float(y), "z": 0.0} for x, y in xy]


def segment(key, left, right, **fields):
    return {
        "id": key,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": points(left),
        "right_lane_boundary": points(right),
        "successors": [],
        "predecessors": [],
        "left_neighbor_id": None,
        "right_neighbor_id": None,
        **fields,
    }


def straight(key, x0, x1, top, bottom, **fields):
    """A lane along x between y = bottom and y = top; towards -x where x1 < x0."""
    left, right = (top, bottom) if x1 > x0 else (bottom, top)
    return segment(key, [(x0, left), (x1, left)], [(x0, right), (x1, right)], **fields)


def crossroads():
    """Two lanes east, one lane west beside them, a bike lane, and an intersection behind."""
    rows = [
        straight(11, 0, 60, 4, 0, left_neighbor_id=31, right_neighbor_id=12),
        straight(
            12, 0, 60, 0, -4, left_neighbor_id=11, right_neighbor_id=41, successors=[22, 23, 999]
        ),
        straight(31, 60, 0, 8, 4, left_neighbor_id=11, predecessors=[998]),
        straight(41, 0, 60, -4, -6, left_neighbor_id=12, lane_type="BIKE", successors=[22]),
        # The link 11 -> 21 is declared by its far end only, 12 -> 22 by its near end only.
        straight(21, 60, 80, 4, 0, predecessors=[11], successors=[13], right_neighbor_id=22),
        straight(22, 60, 80, 0, -4, successors=[14], left_neighbor_id=21),
        segment(
            23,
            [(60, 0), (72, -4), (74, -14)],
            [(60, -4), (68, -6), (70, -14)],
            successors=[24],
            lane_type="BUS",
        ),
        straight(13, 80, 140, 4, 0, right_neighbor_id=14),
        straight(14, 80, 140, 0, -4, left_neighbor_id=13),
        segment(24, [(74, -14), (74, -60)], [(70, -14), (70, -60)]),
    ]
    for row in rows:
        row["is_intersection"] = row["id"] in (21, 22, 23)
    return rows


def archive(rows):
    area = [(-5, -70), (150, -70), (150, 10), (-5, 10)]
    return {
        "lane_segments": {str(row["id"]): row for row in rows},
        "drivable_areas": {"1": {"id": 1, "area_boundary": points(area)}},
        "pedestrian_crossings": {
            "2": {
                "id": 2,
                "edge1": points([(50, -6), (50, 8)]),
                "edge2": points([(53, -6), (53, 8)]),
            },
            # Edges of opposite direction.
            "3": {
                "id": 3,
                "edge1": points([(90, -6), (90, 8)]),
                "edge2": points([(93, 8), (93, -6)]),
            },
        },
    }


def write(folder, content):
    path = folder / "log_map_archive_abc____PIT_city_1.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.fixture
def road_map(tmp_path):
    return read_map(write(tmp_path, archive(crossroads())))


def test_lanes_keep_links_of_either_end_and_drop_absent_ones(road_map):
    lanes = road_map.lanes
    assert road_map.name == "PIT_city_1"
    assert set(lanes) == {"11", "12", "13", "14", "21", "22", "23", "24", "31"}  # no bike lane
    assert lanes["11"].successors == ["21"] and lanes["21"].predecessors == ["11"]
    assert lanes["12"].successors == ["22", "23"] and lanes["22"].predecessors == ["12"]
    assert lanes["31"].predecessors == []
    assert {k for k, lane in lanes.items() if lane.is_connector} == {"21", "22", "23"}
    assert all(lane.speed_limit is None and not lane.has_traffic_light for lane in lanes.values())


def test_neighbours_are_of_one_direction_and_one_roadblock(road_map):
    lanes = road_map.lanes
    assert lanes["11"].left_neighbor is None and lanes["31"].left_neighbor is None  # oncoming
    assert (lanes["11"].right_neighbor, lanes["12"].left_neighbor) == ("12", "11")
    assert lanes["12"].right_neighbor is None  # bike lane
    assert lanes["21"].right_neighbor == "22"  # both lead from one roadblock to one roadblock


def test_neighbour_that_leads_elsewhere_is_dropped(tmp_path):
    rows = crossroads()
    rows[5]["right_neighbor_id"], rows[6]["left_neighbor_id"] = 23, 22
    road_map = read_map(write(tmp_path, archive(rows)))
    assert road_map.lanes["22"].right_neighbor is None
    assert road_map.lanes["23"].left_neighbor is None


def test_neighbour_of_other_heading_is_dropped(tmp_path):
    rows = crossroads()
    rows[8]["right_neighbor_id"], rows[9]["left_neighbor_id"] = 24, 14
    road_map = read_map(write(tmp_path, archive(rows)))
    assert road_map.lanes["14"].right_neighbor is None
    assert road_map.lanes["24"].roadblock == "rb_24"


def test_roadblocks_are_rows_and_connectors_share_both_ends(road_map):
    blocks = road_map.roadblocks
    rows = {key: list(block.lanes) for key, block in blocks.items()}
    assert rows == {
        "rb_11": ["11", "12"],
        "rb_13": ["13", "14"],
        "rb_24": ["24"],
        "rb_31": ["31"],
        "rc_21": ["21", "22"],
        "rc_23": ["23"],
    }
    assert [k for k, b in blocks.items() if b.is_connector] == ["rc_21", "rc_23"]
    assert list(blocks["rb_11"].successors) == ["rc_21", "rc_23"]
    assert list(blocks["rb_13"].predecessors) == ["rc_21"]
    assert blocks["rb_11"].polygon.area == pytest.approx(60 * 8)
    for key, lane in road_map.lanes.items():
        assert key in blocks[lane.roadblock].lanes


def test_links_of_a_connector_chain_are_not_parallel_lanes(tmp_path):
    rows = [
        straight(1, 0, 10, 0, -4, successors=[2]),
        straight(2, 10, 20, 0, -4, successors=[3], is_intersection=True),
        straight(3, 20, 30, 0, -4, successors=[4], is_intersection=True),
        straight(4, 30, 40, 0, -4),
        straight(5, 20, 30, 4, 0, successors=[4], is_intersection=True),  # comes from nowhere
    ]
    blocks = read_map(write(tmp_path, archive(rows))).roadblocks
    assert set(blocks) == {"rb_1", "rc_2", "rc_3", "rc_5", "rb_4"}
    assert list(blocks["rc_2"].successors) == ["rc_3"]


def test_areas(road_map):
    (intersection,) = road_map.intersections
    for key in ("21", "22", "23"):
        lane = road_map.lanes[key]
        assert lane.intersection == intersection.id
        assert intersection.polygon.covers(Polygon(lane.polygon))
    covered = shapely.union_all([Polygon(road_map.lanes[k].polygon) for k in ("21", "22", "23")])
    assert intersection.polygon.area < 1.3 * covered.area
    assert road_map.lanes["11"].intersection is None
    assert [a.kind for a in road_map.drivable] == [DrivableKind.GENERIC]
    assert [a.polygon.area for a in road_map.crosswalks] == pytest.approx([42.0, 42.0])


def test_separate_crossings_are_separate_intersections(tmp_path):
    rows = [
        straight(1, 0, 10, 0, -4, is_intersection=True),
        straight(2, 30, 40, 0, -4, is_intersection=True),
        straight(3, 0, 10, 4, 0, is_intersection=True),  # shares an edge with the first one
    ]
    road_map = read_map(write(tmp_path, archive(rows)))
    assert len(road_map.intersections) == 2
    assert road_map.lanes["1"].intersection == road_map.lanes["3"].intersection


def test_crossed_boundaries_give_a_valid_polygon(tmp_path):
    rows = [segment(1, [(0, 0), (30, 0)], [(0, -4), (20, -1), (30, 1)])]
    road_map = read_map(write(tmp_path, archive(rows)))
    polygon = Polygon(road_map.lanes["1"].polygon)
    assert polygon.is_valid and polygon.area > 50


def test_centerline_of_unevenly_digitised_arc():
    angle = np.linspace(0, np.pi / 2, 200)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    path = centerline(12 * circle[::37], 8 * circle)
    np.testing.assert_allclose(np.hypot(*path[:, :2].T), 10, atol=0.2)
    # Each heading points at the next point; the last repeats.
    step = np.diff(path[:, :2], axis=0)
    np.testing.assert_allclose(path[:-1, 2], np.arctan2(step[:, 1], step[:, 0]))
    assert path[-1, 2] == path[-2, 2]
    assert np.hypot(*step.T).max() <= 1.0


@given(
    angle=st.floats(-3, 3), length=st.floats(0.5, 200), width=st.floats(1, 6), n=st.integers(2, 9)
)
def test_centerline_of_straight_lane_at_any_pose(angle, length, width, n):
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    x = np.linspace(0, length, n)
    left = np.column_stack([x, np.full(n, width / 2)]) @ turn + [5000, -300]
    right = np.array([[0, -width / 2], [length, -width / 2]]) @ turn + [5000, -300]
    path = centerline(left, right)
    ends = np.array([[0, 0], [length, 0]]) @ turn + [5000, -300]
    np.testing.assert_allclose(path[[0, -1], :2], ends)
    np.testing.assert_allclose(path[:, 2], angle, atol=1e-6)


def without(rows, index, field):
    content = archive(rows)
    del rows[index][field]
    return content


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not a JSON file"),
        ("[]", "layer lane_segments is missing"),
        ({**archive([]), "drivable_areas": None}, "layer drivable_areas is missing"),
        (archive([]), "no lane of type VEHICLE or BUS"),
        (archive([straight(7, 0, 9, 2, 0, lane_type="BIKE")]), "no lane of type VEHICLE or BUS"),
        (without(crossroads(), 0, "successors"), "element 11 has no field successors"),
        (without(crossroads(), 1, "left_neighbor_id"), "element 12 has no field left_neighbor_id"),
        (without(crossroads(), 2, "id"), "has no field id"),
        (archive([segment(7, [(0, 0)], [(0, 1), (5, 1)])]), "element 7, field left_lane_boundary"),
        (archive([segment(7, [(0, 0), (1, np.nan)], [(0, 1), (5, 1)])]), "finite x and y"),
        (archive([segment(7, [(0, 0), (0, 0)], [(0, 1), (0, 1)])]), "lane segment 7"),
        (archive([segment(7, [(0, 0), (5, 0)], [(0, 0), (5, 0)])]), "enclose no area"),
        (
            archive(
                [
                    straight(1, 0, 9, 2, 0, left_neighbor_id=2, right_neighbor_id=2),
                    straight(2, 0, 9, 4, 2, left_neighbor_id=1, right_neighbor_id=1),
                ]
            ),
            "left neighbour of itself",
        ),
    ],
)
def test_malformed_archive_is_refused_by_name(tmp_path, content, words):
    path = write(tmp_path, content)
    with pytest.raises(ScenarioError) as error:
        read_map(path)
    assert words in str(error.value) and str(path) in str(error.value)


def test_missing_archive(tmp_path):
    with pytest.raises(ScenarioError, match="no such file"):
        read_map(tmp_path / "none.json")
