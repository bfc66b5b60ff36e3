"""Lane sequences along a route: against brute force on random maps, and case by case."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import shapely

import nuplan_fixture as fixture
from spdm_jax.io.raw import RawLane, RawMap, RawRoadblock
from spdm_jax.io.route import RouteTables, route_tables
from spdm_jax.io.route_paths import (
    BRANCH_HORIZON,
    CENTERLINE_WINDOW,
    MAX_BRANCHES,
    branch_paths,
    centerline_paths,
    goal_paths,
    route_graph,
)

Sequences = list[list[str]]


Road = fixture.Road


def lane_map(blocks: Sequence[Sequence[str]], length: dict[str, float], links: str) -> RawMap:
    """A map by its graph alone; every second block is a connector. `links`: "a>b a>c ..."."""
    raw_map = RawMap(name="graph", lanes={}, roadblocks={})
    ends = [link.split(">") for link in links.split()]
    for i, lanes in enumerate(blocks):
        block = f"block{i}"
        area = shapely.box(1e4 * i, 0, 1e4 * i + 1, 1)
        raw_map.roadblocks[block] = RawRoadblock(block, i % 2 == 1, area, list(lanes))
        for lane in lanes:
            line = np.array([[0.0, 0.0, 0.0], [length[lane], 0.0, 0.0]])
            raw_map.lanes[lane] = RawLane(
                id=lane,
                is_connector=i % 2 == 1,
                roadblock=block,
                centerline=line,
                left_boundary=line[:, :2],
                right_boundary=line[:, :2],
                polygon=line[:, :2],
                successors=[b for a, b in ends if a == lane],
                predecessors=[a for a, b in ends if b == lane],
            )
    return raw_map


def random_map(seed: int, density: float = 0.5, back_links: bool = False) -> RawMap:
    """Three to six blocks of one to three lanes, random links to the next block and back."""
    rng = np.random.default_rng(seed)
    blocks = [
        [f"{i}{chr(97 + k)}" for k in range(rng.integers(1, 4))] for i in range(rng.integers(3, 7))
    ]
    lanes = [lane for block in blocks for lane in block]
    length = {lane: float(rng.uniform(5, 80)) for lane in lanes}
    links = [
        f"{a}>{b}"
        for before, after in itertools.pairwise(blocks)
        for a in before
        for b in after
        if rng.random() < density
    ]
    if back_links:
        links += [f"{a}>{b}" for a in lanes for b in lanes if rng.random() < 0.08]
    return lane_map(blocks, length, " ".join(links))


def tables_of(raw_map: RawMap) -> RouteTables:
    """Tables of the route over all blocks of the map, without a correction of the route."""
    graph = route_graph(raw_map, list(raw_map.roadblocks))
    centerlines, reaches = centerline_paths(graph)
    return RouteTables(
        roadblocks=list(raw_map.roadblocks),
        start_lanes=graph.lanes,
        centerline=[graph.ids(p) for p in centerlines],
        reaches_goal=reaches,
        goal=[graph.ids(p) for p in goal_paths(graph, centerlines, reaches)],
        branches=[graph.ids(p) for p in branch_paths(graph)],
    )


def length_of(raw_map: RawMap, lanes: Sequence[str]) -> float:
    return sum(float(raw_map.lanes[lane].centerline[-1, 0]) for lane in lanes)


def linked(raw_map: RawMap, lanes: Sequence[str]) -> bool:
    return all(b in raw_map.lanes[a].successors for a, b in itertools.pairwise(lanes))


def all_paths(raw_map: RawMap, lane: str) -> Sequences:
    """Every path without repetition from a lane, by depth-first search."""
    found: Sequences = []

    def extend(path: list[str]) -> None:
        found.append(path)
        for following in raw_map.lanes[path[-1]].successors:
            if following not in path:
                extend([*path, following])

    extend([lane])
    return found


# --- centreline --------------------------------------------------------------------------------


@pytest.mark.parametrize("back_links", [False, True])
def test_centerline_is_the_shortest_path(back_links: bool) -> None:
    reached = missed = 0
    for seed in range(30):
        raw_map = random_map(seed, back_links=back_links)
        tables = tables_of(raw_map)
        last = list(raw_map.roadblocks)[-1]
        for lane, path, reaches in zip(
            tables.start_lanes, tables.centerline, tables.reaches_goal, strict=True
        ):
            paths = all_paths(raw_map, lane)
            goals = [p for p in paths if raw_map.lanes[p[-1]].roadblock == last]
            assert path in paths
            assert reaches == bool(goals)
            if goals:
                reached += 1
                best = min(length_of(raw_map, p) for p in goals)
                assert length_of(raw_map, path) == pytest.approx(best, abs=1e-9)
                continue
            missed += 1
            # Depth counts along the shortest path to each lane that can be reached.
            shortest = {}
            for p in sorted(paths, key=lambda p: length_of(raw_map, p)):
                shortest.setdefault(p[-1], p)
            deepest = max(len(p) for p in shortest.values())
            candidates = [p for p in shortest.values() if len(p) == deepest]
            best = min(length_of(raw_map, p) for p in candidates)
            assert len(path) == deepest
            assert length_of(raw_map, path) == pytest.approx(best, abs=1e-9)
    assert reached > 50 and missed > 50


def test_of_equally_long_paths_the_one_found_first_wins() -> None:
    for first, second in ("bc", "cb"):
        raw_map = lane_map(
            [["a"], ["b", "c"], ["d"]],
            dict.fromkeys("abcd", 10.0),
            f"a>{first} a>{second} b>d c>d",
        )
        assert tables_of(raw_map).centerline[0] == ["a", first, "d"]


def test_centerline_looks_thirty_blocks_ahead() -> None:
    names = [f"{i:02d}" for i in range(40)]
    links = " ".join(f"{a}>{b}" for a, b in itertools.pairwise(names))
    tables = tables_of(lane_map([[n] for n in names], dict.fromkeys(names, 10.0), links))
    assert CENTERLINE_WINDOW == 30
    assert tables.centerline[0] == names[:30]
    assert tables.centerline[9] == names[9:39]
    assert tables.centerline[10] == names[10:]
    assert tables.reaches_goal == [i >= 10 for i in range(40)]
    assert tables.goal[0] == names


# --- goal lanes --------------------------------------------------------------------------------


def goal_cost(raw_map: RawMap, start: str, sequence: Sequence[str]) -> tuple[int, int, float]:
    """Lanes crossed, jumps between entries and length; written without the code under test."""
    blocks = list(raw_map.roadblocks.values())
    crossed = jumps = 0
    before = None
    for lane in sequence:
        block = raw_map.roadblocks[raw_map.lanes[lane].roadblock]
        entries = [start] if before is None else raw_map.lanes[before].successors
        entries = [entry for entry in entries if entry in block.lanes]
        if not entries:
            return 1000, 0, 0.0
        at = list(block.lanes).index(lane)
        crossed += (2 if blocks.index(block) % 2 else 1) * min(
            abs(list(block.lanes).index(entry) - at) for entry in entries
        )
        jumps += before is not None and lane not in entries
        before = lane
    return crossed, jumps, length_of(raw_map, sequence)


def test_goal_lanes_cross_the_fewest_lanes() -> None:
    changed = 0
    for seed in range(60):
        raw_map = random_map(seed, density=0.35)
        tables = tables_of(raw_map)
        blocks = [list(block.lanes) for block in raw_map.roadblocks.values()]
        for lane, sequence, centerline, reaches in zip(
            *(tables.start_lanes, tables.goal, tables.centerline, tables.reaches_goal), strict=True
        ):
            if reaches:
                assert sequence == centerline
                continue
            first = next(i for i, block in enumerate(blocks) if lane in block)
            end = first
            while end + 1 < len(blocks) and any(
                linked(raw_map, pair) for pair in itertools.product(blocks[end], blocks[end + 1])
            ):
                end += 1
            options = itertools.product(*blocks[first : end + 1])
            crossed, jumps, length = min(goal_cost(raw_map, lane, option) for option in options)
            found = goal_cost(raw_map, lane, sequence)
            assert len(sequence) == end + 1 - first
            assert found[:2] == (crossed, jumps)
            assert found[2] == pytest.approx(length, abs=0.01)  # compared in whole millimetres
            changed += crossed > 0
    assert changed > 50


def test_lane_that_ends_leads_to_the_one_beside_it() -> None:
    roads = {"A": Road((0, 0), (90, 0), lanes=2), "B": Road((110, 1.75), (250, 1.75))}
    raw_map = fixture.road_map(roads, [("A", "B", [(0, 0)])])
    tables = route_tables(raw_map, ["A", "A-B", "B"], (10.0, -1.75, 0.0))
    assert tables.start_lanes == ["A.0", "A.1", "A.0-B.0", "B.0"]
    assert tables.centerline[:2] == [["A.0", "A.0-B.0", "B.0"], ["A.1"]]
    assert tables.reaches_goal == [True, False, True, True]
    assert tables.goal[1] == tables.goal[0] == tables.centerline[0]
    assert [b for b in tables.branches if b[0] == "A.1"] == [["A.1"]]


def test_change_comes_in_the_first_block_if_the_lanes_there_lead_on() -> None:
    # Lane 0 ends with road B; one may change in A, on the connector or in B.
    roads = {
        "A": Road((0, 0), (90, 0), lanes=2),
        "B": Road((110, 0), (200, 0), lanes=2),
        "C": Road((220, -1.75), (300, -1.75)),
    }
    raw_map = fixture.road_map(roads, [("A", "B", [(0, 0), (1, 1)]), ("B", "C", [(1, 0)])])
    tables = route_tables(raw_map, ["A", "A-B", "B", "B-C", "C"], (10.0, 1.75, 0.0))
    assert tables.goal[0] == ["A.1", "A.1-B.1", "B.1", "B.1-C.0", "C.0"]
    # On the connector already: keep it and change on the road.
    on_connector = tables.start_lanes.index("A.0-B.0")
    assert tables.goal[on_connector] == ["A.0-B.0", "B.1", "B.1-C.0", "C.0"]


def test_one_change_late_beats_two_changes_early() -> None:
    raw_map = lane_map(
        [["a0", "a1", "a2"], ["c2"], ["b0", "b1"], ["d0"], ["e0"]],
        dict.fromkeys("a0 a1 a2 c2 b0 b1 d0 e0 c0".split(), 20.0),
        "a2>c2 c2>b1 b0>d0 d0>e0",
    )
    tables = tables_of(raw_map)
    assert tables.goal[2] == ["a2", "c2", "b0", "d0", "e0"]


def test_goal_lanes_end_before_a_gap_in_the_route() -> None:
    raw_map = lane_map(
        [["a0", "a1"], ["c0"], ["b0"], ["d0"]],
        dict.fromkeys(["a0", "a1", "c0", "b0", "d0"], 20.0),
        "a0>c0 b0>d0",
    )
    tables = tables_of(raw_map)
    assert tables.reaches_goal == [False, False, False, True, True]
    assert tables.goal == [["a0", "c0"], ["a0", "c0"], ["c0"], ["b0", "d0"], ["d0"]]


# --- branches ----------------------------------------------------------------------------------


def fork(shared_length: float) -> RawMap:
    """a, then b of the given length, then c or d; both rejoin in e."""
    length = {"a": 30.0, "b": shared_length, "c": 40.0, "d": 50.0, "e": 20.0}
    return lane_map([["a"], ["b"], ["c", "d"], ["e"]], length, "a>b b>d b>c c>e d>e")


def test_fork_within_the_horizon_gives_two_branches() -> None:
    branches = tables_of(fork(BRANCH_HORIZON - 1)).branches
    assert [b for b in branches if b[0] == "a"] == [["a", "b", "c", "e"], ["a", "b", "d", "e"]]


def test_fork_beyond_the_horizon_gives_one_branch() -> None:
    branches = tables_of(fork(BRANCH_HORIZON)).branches
    assert [b for b in branches if b[0] == "a"] == [["a", "b", "c", "e"]]
    assert [b for b in branches if b[0] == "b"] == [["b", "c", "e"], ["b", "d", "e"]]


def test_branch_continues_to_the_goal_rather_than_farther() -> None:
    length = {"a": 30.0, "b": 120.0, "c": 500.0, "d": 50.0, "e": 20.0}
    blocks = [["a"], ["b"], ["c", "d"], ["e"]]
    raw_map = lane_map(blocks, length, "a>b b>c b>d d>e")
    assert tables_of(raw_map).branches[0] == ["a", "b", "d", "e"]
    raw_map = lane_map(blocks, length, "a>b b>d b>c")  # neither arrives: the longer one
    assert tables_of(raw_map).branches[0] == ["a", "b", "c"]


def test_branches_that_arrive_come_first() -> None:
    length = dict.fromkeys("abcde", 20.0)
    raw_map = lane_map([["a"], ["b", "c"], ["d"], ["e"]], length, "a>b a>c c>d d>e")
    assert tables_of(raw_map).branches[:2] == [["a", "c", "d", "e"], ["a", "b"]]


def test_branches_of_random_maps() -> None:
    for seed in range(30):
        raw_map = random_map(seed)
        tables = tables_of(raw_map)
        last = list(raw_map.roadblocks)[-1]
        for lane in tables.start_lanes:
            paths = [
                p for p in all_paths(raw_map, lane) if not raw_map.lanes[p[-1]].successors
            ]  # from the lane to where it can go no farther
            heads = {head(raw_map, p) for p in paths}
            branches = [b for b in tables.branches if b[0] == lane]
            assert all(branch in paths for branch in branches)
            assert sorted(head(raw_map, b) for b in branches) == sorted(heads)
            for branch in branches:
                same = [p for p in paths if head(raw_map, p) == head(raw_map, branch)]
                arrived = [p for p in same if raw_map.lanes[p[-1]].roadblock == last]
                best = (
                    min(length_of(raw_map, p) for p in arrived)
                    if arrived
                    else max(length_of(raw_map, p) for p in same)
                )
                assert length_of(raw_map, branch) == pytest.approx(best, abs=0.01)


def head(raw_map: RawMap, path: Sequence[str]) -> tuple[str, ...]:
    """The lanes of a path that begin within the branch horizon."""
    reached, lanes = 0.0, [path[0]]
    for lane in path[1:]:
        if reached >= BRANCH_HORIZON:
            break
        lanes.append(lane)
        reached += length_of(raw_map, [lane])
    return tuple(lanes)


def test_number_of_branches_is_bounded() -> None:
    # Twenty forks in a row within 100 m: a million ways.
    blocks = [[f"{i}a", f"{i}b"] for i in range(21)]
    links = " ".join(
        f"{a}>{b}" for p, q in itertools.pairwise(blocks) for a, b in itertools.product(p, q)
    )
    length = dict.fromkeys(itertools.chain(*blocks), 4.0)
    raw_map = lane_map(blocks, length, links)
    tables = tables_of(raw_map)
    branches = [tuple(b) for b in tables.branches if b[0] == "0a"]
    assert len(set(branches)) == len(branches) == MAX_BRANCHES
    assert all(len(b) == len(blocks) and linked(raw_map, b) for b in branches)
    # The nearest forks are told apart: every way over the next four blocks is there.
    assert len({b[1:5] for b in branches}) == 16


def test_cycles_end() -> None:
    length = dict.fromkeys("abcd", 10.0)
    raw_map = lane_map([["a"], ["b"], ["c"], ["d"]], length, "a>b b>c c>a a>a")
    tables = tables_of(raw_map)
    assert tables.centerline == [["a", "b", "c"], ["b", "c", "a"], ["c", "a", "b"], ["d"]]
    assert tables.branches == [["a", "b", "c"], ["b", "c"], ["c"], ["d"]]
