"""Route correction and start lane: broken routes on small maps, nuPlan files, stored runs."""

import importlib
import importlib.util
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import shapely

import nuplan_fixture as fixture
from spdm_jax.io.raw import RawMap, ScenarioError
from spdm_jax.io.route import correct_route, route_tables, starting_lane

Road = fixture.Road


@pytest.fixture
def nuplan() -> ModuleType:
    """The nuPlan reader's module; skips the test where its dependencies are missing."""
    pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
    return importlib.import_module("spdm_jax.io.nuplan")


def chain(count: int, lanes: int = 1) -> tuple[RawMap, list[str]]:
    """`count` roads eastwards, 40 m each with 10 m between; the map and the complete route."""
    names = [f"R{i:02d}" for i in range(count)]
    roads = {n: Road((50.0 * i, 0.0), (50.0 * i + 40.0, 0.0), lanes) for i, n in enumerate(names)}
    pairs = [(i, i) for i in range(lanes)]
    raw_map = fixture.road_map(roads, [(a, b, pairs) for a, b in pairwise(names)])
    return raw_map, with_connectors(names)


def with_connectors(names: Sequence[str]) -> list[str]:
    """The route over these roads, complete with the connector blocks between them."""
    between = [block for a, b in pairwise(names) for block in (f"{a}-{b}", b)]
    return [names[0], *between]


def merge() -> RawMap:
    """A-B-C-D eastwards; the side roads X, Y, Z join at B, C and D."""
    roads = {n: Road((60.0 * i, 0.0), (60.0 * i + 40.0, 0.0)) for i, n in enumerate("ABCD")}
    roads |= {n: Road((60.0 * i, -40.0), (60.0 * i + 40.0, -40.0)) for i, n in enumerate("XYZ")}
    links = [(a, b, [(0, 0)]) for a, b in ("AB", "BC", "CD", "XB", "YC", "ZD")]
    return fixture.road_map(roads, links)


ROUTE_ABCD = with_connectors("ABCD")


def loop(width: float) -> tuple[RawMap, list[str]]:
    """East, then three left turns and south over the first connector."""
    roads = {
        "A": Road((0, 0), (40, 0)),
        "B": Road((60, 0), (100, 0)),
        "C": Road((115, 15), (115, 45)),
        "D": Road((100, 60), (65, 60)),
        "E": Road((50, 45), (50, 15)),
        "F": Road((50, -15), (50, -45)),
        "G": Road((50, -60), (50, -90)),
    }
    links = [(a, b, [(0, 0)]) for a, b in pairwise("ABCDEFG")]
    return fixture.road_map(roads, links, width), with_connectors("ABCDEFG")


def box(pose: tuple[float, float, float]) -> tuple[np.ndarray, shapely.Polygon]:
    """Centre and footprint of the ego with the rear axle at `pose`."""
    along = np.array([np.cos(pose[2]), np.sin(pose[2])])
    left = np.array([-along[1], along[0]])
    center = np.array(pose[:2]) + 1.461 * along
    corners = [(2.588, 1.1485), (-2.588, 1.1485), (-2.588, -1.1485), (2.588, -1.1485)]
    return center, shapely.Polygon([center + a * along + b * left for a, b in corners])


# --- correction: the start ---------------------------------------------------------------------


def test_a_right_route_stays() -> None:
    raw_map, route = chain(5)
    assert correct_route(raw_map, route, (10.0, 0.0, 0.0)) == route


def test_blocks_behind_the_ego_stay() -> None:
    raw_map, route = chain(5)
    assert correct_route(raw_map, route, (110.0, 0.0, 0.0)) == route


def test_ego_behind_the_route_is_led_to_it() -> None:
    raw_map, route = chain(6)
    assert correct_route(raw_map, route[6:], (10.0, 0.0, 0.0)) == route


def test_ego_in_a_connector_behind_the_route_is_led_to_it() -> None:
    raw_map, route = chain(6)
    assert correct_route(raw_map, route[6:], (45.0, 0.0, 0.0)) == route[1:]


@pytest.mark.parametrize(("start", "joined"), [("X", "B"), ("Y", "C")])
def test_ego_beside_the_route_joins_it_ahead(start: str, joined: str) -> None:
    raw_map = merge()
    x, y = raw_map.lanes[f"{start}.0"].centerline[5, :2]
    given = ROUTE_ABCD if start == "X" else ROUTE_ABCD[2:]
    rest = given[given.index(joined) :]
    assert correct_route(raw_map, given, (x, y, 0.0)) == [start, f"{start}-{joined}", *rest]


def test_route_is_joined_at_one_of_its_first_three_blocks_only() -> None:
    raw_map = merge()
    x, y = raw_map.lanes["Y.0"].centerline[5, :2]
    # C is the fifth block of this route.
    assert correct_route(raw_map, ROUTE_ABCD, (x, y, 0.0)) == ROUTE_ABCD


def test_on_the_seam_of_two_blocks_the_way_starts_with_the_road() -> None:
    raw_map = merge()
    raw_map.roadblocks = dict(reversed(raw_map.roadblocks.items()))  # connectors first
    fixed = correct_route(raw_map, ROUTE_ABCD, (40.0, -40.0, 0.0))
    assert fixed == ["X", "X-B", *ROUTE_ABCD[2:]]


@pytest.mark.parametrize(("links", "repaired"), [(14, True), (15, False)])
def test_search_depth_is_thirty_blocks(links: int, repaired: bool) -> None:
    raw_map, route = chain(links + 2)
    given = route[2 * links :]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == (route if repaired else given)


def test_backward_search_depth_is_fifteen_blocks() -> None:
    # From the ego a way of 15 or 16 blocks leads to the route's first block and a short one to its
    # third. The second counts only if the search for the first gives up.
    names = [f"R{i:02d}" for i in range(8)] + ["A", "B"]
    roads = {n: Road((50.0 * i, 0.0), (50.0 * i + 40.0, 0.0)) for i, n in enumerate(names)}
    links = [(a, b, [(0, 0)]) for a, b in pairwise(names)]
    raw_map = fixture.road_map(roads, [*links, ("R01", "B", [(0, 0)])])
    route = with_connectors(names)
    assert correct_route(raw_map, route[-3:], (60.0, 0.0, 0.0)) == route[2:]
    assert correct_route(raw_map, route[-3:], (45.0, 0.0, 0.0)) == ["R00-R01", "R01", "R01-B", "B"]


def test_route_that_cannot_be_reached_stays() -> None:
    roads = {"A": Road((0, 0), (40, 0)), "B": Road((60, 0), (100, 0)), "X": Road((0, 50), (40, 50))}
    raw_map = fixture.road_map(roads, [("A", "B", [(0, 0)])])
    assert correct_route(raw_map, ["A", "A-B", "B"], (10.0, 50.0, 0.0)) == ["A", "A-B", "B"]


# --- correction: which block the ego is in -----------------------------------------------------


def test_route_block_wins_over_a_nearer_one_off_route() -> None:
    roads = {
        "P": Road((-60, 2.0), (-20, 2.0)),
        "X": Road((0, 0), (40, 0)),
        "A": Road((0, 2.0), (40, 2.0)),
        "B": Road((60, 2.0), (100, 2.0)),
    }
    links = [(a, b, [(0, 0)]) for a, b in ("PA", "AB", "XB", "XA")]
    raw_map = fixture.road_map(roads, links)
    # On X's axis, 2 m from A's: within reach of both. From X one could join the route at A.
    given = ["P-A", "A", "A-B", "B"]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == given
    # With both off route the way back may end in either; the map lists A-B first.
    assert correct_route(raw_map, ["B"], (10.0, 0.0, 0.0)) == ["A", "A-B", "B"]


def test_heading_tells_crossing_roads_apart() -> None:
    roads = {
        "E": Road((-30, 0), (30, 0)),
        "N": Road((0, -30), (0, 30)),
        "G": Road((50, 20), (90, 20)),
    }
    raw_map = fixture.road_map(roads, [("E", "G", [(0, 0)]), ("N", "G", [(0, 0)])])
    # The axis of N is nearer in the first case and farther in the second.
    assert correct_route(raw_map, ["G"], (0.2, 0.5, 0.1))[0] == "E"
    assert correct_route(raw_map, ["G"], (0.5, 0.2, 1.5))[0] == "N"


@pytest.mark.parametrize(("degrees", "fits"), [(44.0, True), (46.0, False)])
def test_a_lane_fits_up_to_45_degrees(degrees: float, fits: bool) -> None:
    raw_map, route = chain(3)
    raw_map.lanes["R00.0-R01.0"].centerline[:, 2] = np.pi
    # On the seam of R00 and a connector that leads the wrong way.
    fixed = correct_route(raw_map, route[2:], (40.0, 0.0, np.deg2rad(degrees)))
    assert fixed == (route if fits else route[1:])


def test_without_a_matching_lane_the_nearest_block_counts() -> None:
    raw_map, route = chain(4)
    # Faces west: no heading fits. Still R00 is where the ego stands.
    assert correct_route(raw_map, route[4:], (10.0, 0.0, np.pi)) == route


def test_without_a_block_at_hand_the_nearest_of_each_layer_counts() -> None:
    # Neither R00 nor the connector after it matches, so the way back ends in the connector.
    raw_map, route = chain(4)
    assert correct_route(raw_map, route[4:], (10.0, 8.0, 0.0)) == route[1:]


@pytest.mark.parametrize(("offset", "near"), [(0.99, True), (1.01, False)])
def test_a_block_is_near_if_it_touches_the_square(offset: float, near: bool) -> None:
    # The ego is north-east of A's corner by `offset` along both axes, so farther than 1 m as the
    # crow flies. On the connector it faces the wrong way; A fits, if it is looked at.
    raw_map, route = chain(3)
    pose = (40.0 + offset, 1.75 + offset, 0.0)
    connector = raw_map.lanes["R00.0-R01.0"]
    connector.centerline[:, 2] = np.pi
    raw_map.roadblocks["R00-R01"].polygon = shapely.box(41, 0, 50, 5)
    expected = route if near else route[1:]
    assert correct_route(raw_map, route[2:], pose) == expected


# --- correction: gaps and loops ----------------------------------------------------------------


@pytest.mark.parametrize(
    "missing", [["R01"], ["R01-R02"], ["R01", "R01-R02"], ["R01-R02", "R02", "R02-R03", "R03"]]
)
def test_missing_blocks_are_filled_in(missing: list[str]) -> None:
    raw_map, route = chain(6)
    given = [block for block in route if block not in missing]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == route


def test_route_of_roads_only_gets_its_connectors() -> None:
    raw_map, route = chain(6)
    assert correct_route(raw_map, route[::2], (10.0, 0.0, 0.0)) == route


def test_gap_without_a_way_across_stays() -> None:
    raw_map = merge()
    given = ["A", "Y", "Y-C", "C"]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == given


def test_of_two_ways_of_equal_length_the_one_noted_last_is_taken() -> None:
    roads = {
        "A": Road((0, 0), (40, 0)),
        "P": Road((60, 20), (100, 20)),
        "Q": Road((60, -20), (100, -20)),
        "B": Road((120, 0), (160, 0)),
    }
    for ways in ("PQ", "QP"):
        links = [("A", way, [(0, 0)]) for way in ways] + [(way, "B", [(0, 0)]) for way in ways]
        raw_map = fixture.road_map(roads, links)
        route = correct_route(raw_map, ["A", "B"], (10.0, 0.0, 0.0))
        assert route == ["A", f"A-{ways[1]}", ways[1], f"{ways[1]}-B", "B"]


def test_a_block_noted_twice_ranks_by_its_last_mention() -> None:
    # A to X and Y; X to U and V; Y to U; U and V to B. B is noted from U, from V, from U again.
    places = {"A": (0, 0), "X": (60, 20), "Y": (60, -20), "U": (120, 20), "V": (120, -20),
              "B": (180, 0)}  # fmt: skip
    roads = {name: Road((x, y), (x + 40, y)) for name, (x, y) in places.items()}
    links = [(a, b, [(0, 0)]) for a, b in ("AX", "AY", "XU", "XV", "YU", "UB", "VB")]
    raw_map = fixture.road_map(roads, links)
    assert correct_route(raw_map, ["A", "B"], (10.0, 0.0, 0.0)) == with_connectors("AYUB")


def test_route_ends_before_it_crosses_itself() -> None:
    raw_map, route = loop(width=3.5)
    assert correct_route(raw_map, route, (10.0, 0.0, 0.0)) == route[: route.index("E-F")]


def test_overlap_below_one_square_metre_is_no_loop() -> None:
    raw_map, route = loop(width=0.9)
    assert correct_route(raw_map, route, (10.0, 0.0, 0.0)) == route


def test_repair_that_drives_a_connector_twice_is_a_loop() -> None:
    roads = {
        "A": Road((0, 0), (40, 0)),
        "B": Road((60, 0), (100, 0), lanes=2),
        "C": Road((100, 60), (40, 60)),
        "D": Road((120, -1.75), (160, -1.75)),
    }
    links = [(a, b, [(0, 0)]) for a, b in ("BC", "CA")]
    links += [("A", "B", [(0, 0), (0, 1)]), ("B", "D", [(1, 0)])]
    raw_map = fixture.road_map(roads, links)
    # From C the way to D leads over A and B again.
    given = ["A", "A-B", "B", "B-C", "C", "D"]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == [*given[:5], "C-A"]


def test_all_faults_at_once() -> None:
    raw_map, route = loop(width=3.5)
    given = ["C", "nowhere", "D-E", "E", "E", "E-F", "F", "G"]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == route[: route.index("E-F")]


def test_self_touching_connector_does_not_stop_the_loop_check() -> None:
    raw_map, route = loop(width=3.5)
    bow_tie = shapely.Polygon([(45, -3), (55, 3), (55, -3), (45, 3)])
    assert not bow_tie.is_valid
    raw_map.roadblocks["E-F"].polygon = bow_tie
    assert correct_route(raw_map, route, (10.0, 0.0, 0.0)) == route[: route.index("E-F")]


# --- correction: unusable input ----------------------------------------------------------------


def test_unknown_and_repeated_blocks_are_skipped() -> None:
    raw_map, route = chain(3)
    given = ["?", *route[:2], route[1], "??", *route[2:]]
    assert correct_route(raw_map, given, (10.0, 0.0, 0.0)) == route


@pytest.mark.parametrize("given", [[], ["77", "78"]])
def test_route_without_known_blocks_is_refused(given: list[str]) -> None:
    raw_map, _ = chain(2)
    with pytest.raises(ScenarioError, match=r"map test: route_roadblocks \[.*no roadblock"):
        correct_route(raw_map, given, (10.0, 0.0, 0.0))


@pytest.mark.parametrize("pose", [(0.0, 0.0), (np.nan, 0.0, 0.0)])
def test_unusable_pose_is_refused(pose: tuple[float, ...]) -> None:
    raw_map, route = chain(2)
    with pytest.raises(ValueError, match="ego_pose must be finite"):
        correct_route(raw_map, route, pose)


def test_route_without_lanes_is_refused() -> None:
    raw_map, route = chain(2)
    for block in raw_map.roadblocks.values():
        block.lanes = ["gone"]
    with pytest.raises(ScenarioError, match="no lane of the map"):
        route_tables(raw_map, route, (10.0, 0.0, 0.0))


# --- start lane --------------------------------------------------------------------------------


def test_start_lane_is_the_one_under_the_rear_axle() -> None:
    raw_map, route = chain(2, lanes=2)
    lanes = [lane for block in route for lane in raw_map.roadblocks[block].lanes]
    for y, lane in ((1.0, "R00.0"), (-1.0, "R00.1")):
        pose = (10.0, y, 0.0)
        assert starting_lane(raw_map, lanes, pose, *box(pose)) == lane


def test_heading_decides_between_overlapping_lanes() -> None:
    roads = {"A": Road((0, 0), (40, 0)), "L": Road((60, 20), (60, 50)), "S": Road((60, 0), (90, 0))}
    raw_map = fixture.road_map(roads, [("A", "L", [(0, 0)]), ("A", "S", [(0, 0)])])
    lanes = ["A.0", "A.0-L.0", "A.0-S.0"]
    x, y = 43.0, 0.2
    for heading, lane in ((0.0, "A.0-S.0"), (0.6, "A.0-L.0")):
        pose = (x, y, heading)
        assert starting_lane(raw_map, lanes, pose, *box(pose)) == lane


def test_beside_the_lanes_the_centre_then_the_footprint_decide() -> None:
    raw_map, route = chain(2, lanes=2)
    lanes = [lane for block in route for lane in raw_map.roadblocks[block].lanes]
    entering = (-1.0, 1.0, 0.0)  # the rear axle is before the road's edge, the centre is not
    assert starting_lane(raw_map, lanes, entering, *box(entering)) == "R00.0"
    beside = (60.0, -5.5, 0.0)
    assert starting_lane(raw_map, lanes, beside, *box(beside)) == "R01.1"


def test_no_lane_to_start_on_is_refused() -> None:
    raw_map, _ = chain(2)
    with pytest.raises(ScenarioError, match="route_lanes is empty"):
        starting_lane(raw_map, [], (0.0, 0.0, 0.0), *box((0.0, 0.0, 0.0)))


# --- files in nuPlan's format ------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["ego behind", "ego beside", "gap", "loop"])
def test_broken_route_in_nuplan_files_is_repaired(
    tmp_path: Path, nuplan: ModuleType, fault: str
) -> None:
    if fault == "loop":
        raw_map, given = loop(width=3.5)
        start, expected = (5.0, 0.3, 0.0), given[: given.index("E-F")]
    elif fault == "ego beside":
        raw_map, given = merge(), ROUTE_ABCD
        start, expected = (5.0, -40.2, 0.0), ["X", "X-B", *ROUTE_ABCD[2:]]
    else:
        raw_map, expected = chain(6, lanes=2)
        start = (5.0, 1.5, 0.05)
        given = expected[4:] if fault == "ego behind" else [*expected[:3], *expected[6:]]
    fid = fixture.write_nuplan(tmp_path, raw_map, given, start)
    wanted = nuplan.ScenarioFilter(scenario_types=(fixture.TAG,))
    reader = nuplan.NuPlanReader(tmp_path / "nuplan-v1.1", tmp_path / "maps", wanted)
    (token,) = reader.tokens()
    raw = reader.read(token)
    assert raw.route_roadblocks == [fid[block] for block in given]
    pose = raw.ego[raw.num_history, :3]
    np.testing.assert_allclose(pose, [*(fixture.MAP_ORIGIN + start[:2]), start[2]], atol=1e-6)
    tables = route_tables(raw.map, raw.route_roadblocks, pose)
    assert tables.roadblocks == [fid[block] for block in expected]
    own = route_tables(raw_map, given, start)
    assert tables.start_lanes == [fid[lane] for lane in own.start_lanes]
    for read, built in (
        (tables.centerline, own.centerline),
        (tables.goal, own.goal),
        (tables.branches, own.branches),
    ):
        assert read == [[fid[lane] for lane in path] for path in built]
    for lane in tables.start_lanes:
        name = next(name for name, number in fid.items() if number == lane)
        error = raw.map.lanes[lane].centerline - raw_map.lanes[name].centerline
        assert np.abs(error[:, :2] - fixture.MAP_ORIGIN).max() < 1e-6


# --- stored runs of the published planner ------------------------------------------------------


def test_tables_reproduce_stored_runs(shared: Path, nuplan: ModuleType) -> None:
    runs = sorted(shared.glob("data/nuplan_format/*/golden_pdm_closed/*.npz"))
    assert runs
    readers = {}
    for run in runs:
        root = run.parents[1]
        if root not in readers:
            readers[root] = nuplan.NuPlanReader(root / "nuplan-v1.1", root / "maps")
        stored = np.load(run)
        raw_map = readers[root].map(str(stored["token"]))
        pose = stored["ego_state"][:3]
        tables = route_tables(raw_map, [str(block) for block in stored["route_in"]], pose)
        assert tables.roadblocks == stored["route_corrected"].tolist()
        start = starting_lane(raw_map, tables.start_lanes, pose, *box(tuple(pose)))
        assert start == str(stored["starting_lane"])
        path = tables.centerline[tables.start_lanes.index(start)]
        points = np.concatenate([raw_map.lanes[lane].centerline for lane in path])
        # The same points projected by the same library: equal to the last bit or nearly so.
        np.testing.assert_allclose(points, stored["centerline"], rtol=0, atol=1e-9)
