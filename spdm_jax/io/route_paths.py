"""Lane sequences along a corrected route: centreline, goal lanes and branches.

All three work on `RouteGraph`, the lane graph cut down to the route's lanes, and return one entry
per *slot*. Slots number the route's lanes: blocks in route order, within a block from left to
right. Sequences are lists of slots.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spdm_jax.io.raw import RawMap, ScenarioError

CENTERLINE_WINDOW = 30
"""Route blocks that a centreline looks ahead, its own block included (tuplan_garage)."""
BRANCH_HORIZON = 100.0
"""Branches that part later than this beyond the end of their first lane count as one, m."""
MAX_BRANCHES = 32
"""Branches told apart for one start lane; forks further away than that are not split."""
CONNECTOR_CHANGE = 2
"""Price of a lane change inside a roadblock connector; on a road it is 1."""

_Cost = tuple[int, int, int]


@dataclass(frozen=True)
class RouteGraph:
    """The lane graph restricted to the lanes of a route; lanes are numbered by slot.

    Attributes:
      lanes: lane id of each slot.
      blocks: slots of each route block, left to right (empty where the map lists no lane).
      block_of: route block of each slot.
      place: position of each slot within its block.
      is_connector: per route block.
      successors: on-route successors of each slot, in the map's order.
      onward: the successors that lie in a later route block; this graph has no cycle.
      length: arc length of each baseline, m.
      length_mm: the same in whole millimetres, so that sums do not depend on their order.
    """

    lanes: list[str]
    blocks: list[list[int]]
    block_of: list[int]
    place: list[int]
    is_connector: list[bool]
    successors: list[list[int]]
    onward: list[list[int]]
    length: list[float]
    length_mm: list[int]

    def ids(self, slots: Sequence[int]) -> list[str]:
        """Returns the lane ids of a sequence of slots."""
        return [self.lanes[slot] for slot in slots]


def route_graph(raw_map: RawMap, route: Sequence[str]) -> RouteGraph:
    """Builds the lane graph of a route.

    Args:
      raw_map: the map; lanes that a block lists and the map lacks are left out.
      route: ids of the route's roadblocks, in order of travel, without repetition.

    Returns:
      The graph.

    Raises:
      ScenarioError: none of the route's blocks has a lane in the map.
    """
    slot_of: dict[str, int] = {}
    blocks: list[list[int]] = []
    for block in route:
        slots = []
        for lane in raw_map.roadblocks[block].lanes:
            if lane in raw_map.lanes and lane not in slot_of:
                slot_of[lane] = len(slot_of)
                slots.append(slot_of[lane])
        blocks.append(slots)
    if not slot_of:
        raise ScenarioError(
            f"map {raw_map.name}: roadblocks.lanes names no lane of the map for the route "
            f"{list(route)[:5]}; check that lanes and roadblocks come from the same map"
        )
    lanes = list(slot_of)
    block_of = [b for b, slots in enumerate(blocks) for _ in slots]
    successors = [
        list(dict.fromkeys(slot_of[s] for s in raw_map.lanes[lane].successors if s in slot_of))
        for lane in lanes
    ]
    length = [_arc_length(raw_map.lanes[lane].centerline) for lane in lanes]
    return RouteGraph(
        lanes=lanes,
        blocks=blocks,
        block_of=block_of,
        place=[i for slots in blocks for i in range(len(slots))],
        is_connector=[raw_map.roadblocks[block].is_connector for block in route],
        successors=successors,
        onward=[
            [s for s in after if block_of[s] > block_of[slot]]
            for slot, after in enumerate(successors)
        ],
        length=length,
        length_mm=[round(1000.0 * value) for value in length],
    )


def centerline_paths(graph: RouteGraph) -> tuple[list[list[int]], list[bool]]:
    """Finds PDM's centreline from every route lane.

    It is the shortest path (sum of baseline lengths) over on-route successors to any lane of the
    last block in the window. If there is none, it is the cheapest path among those with the most
    lanes.

    Args:
      graph: lanes of the route.

    Returns:
      One path per slot, starting with the slot, and whether it ends in the route's last block.

    Source: tuplan_garage `Dijkstra`; of equally long paths, the one found first wins there too.
    """
    last = len(graph.blocks) - 1
    goals = [min(b + CENTERLINE_WINDOW - 1, last) for b in graph.block_of]
    paths: list[list[int]] = [[] for _ in graph.lanes]
    for slot in reversed(range(len(graph.lanes))):
        after = graph.successors[slot]
        # A lane with a single way on shares its successor's path: same goal, all costs shifted.
        if len(after) == 1 and graph.block_of[slot] != goals[slot]:
            tail = paths[after[0]]
            if tail and goals[after[0]] == goals[slot] and slot not in tail:
                paths[slot] = [slot, *tail]
                continue
        paths[slot] = _shortest_path(graph, slot, goals[slot])
    return paths, [graph.block_of[path[-1]] == last for path in paths]


def goal_paths(
    graph: RouteGraph, centerlines: Sequence[Sequence[int]], reaches_goal: Sequence[bool]
) -> list[list[int]]:
    """Finds the lanes that lead to the route's last block with the fewest lane changes.

    The entry of a block is the lane in which one leaves it. So the first entry need not be the
    start lane: it is the lane one has to change to before the block ends. Of sequences with
    equally many lanes crossed, those win that jump between consecutive entries least (they change
    in the first block), then the shortest. A sequence ends before the first block that no lane of
    the block ahead of it leads to.

    Args:
      graph: lanes of the route.
      centerlines: per slot, the centreline.
      reaches_goal: per slot, whether the centreline ends in the last block; such a centreline
        needs no change and is the answer.

    Returns:
      One sequence per slot, one lane per block.
    """
    # leave[slot]: cost from the end of the lane to the goal, and the lane that the next block is
    # left in; absent where the lane has no successor in the next block.
    leave: dict[int, tuple[_Cost, int]] = {}
    for b in reversed(range(len(graph.blocks))):
        following = set(graph.blocks[b + 1]) if b + 1 < len(graph.blocks) else set()
        for slot in graph.blocks[b]:
            options = [
                _best_exit(graph, entry, leave, jump=1)
                for entry in graph.successors[slot]
                if entry in following
            ]
            if options:
                leave[slot] = min(options)
        if not any(slot in leave for slot in graph.blocks[b]):
            leave.update({slot: ((0, 0, 0), -1) for slot in graph.blocks[b]})

    sequences: list[list[int]] = []
    for slot, (centerline, reaches) in enumerate(zip(centerlines, reaches_goal, strict=True)):
        if reaches:
            sequences.append(list(centerline))
            continue
        sequence = []
        at = _best_exit(graph, slot, leave, jump=0)[1]
        while at >= 0:
            sequence.append(at)
            at = leave[at][1]
        sequences.append(sequence)
    return sequences


def branch_paths(graph: RouteGraph) -> list[list[int]]:
    """Lists the distinct ways on along the route, for every route lane.

    Two ways that use the same lanes over the first `BRANCH_HORIZON` beyond the end of the start
    lane count as one; it is continued on the shortest way to the last block, or on the longest way
    where none gets there. Only successors in later route blocks are followed.

    Args:
      graph: lanes of the route.

    Returns:
      Sequences, grouped by start lane (their first entry) in slot order; within a group those that
      reach the last block come first.
    """
    last = len(graph.blocks) - 1
    # Per slot: (misses the goal, its rank: length to the goal or minus the length to the end,
    # next slot); the smallest is the best continuation.
    onward: list[tuple[bool, int, int]] = [(True, 0, -1)] * len(graph.lanes)
    for slot in reversed(range(len(graph.lanes))):
        if graph.block_of[slot] == last:
            onward[slot] = (False, graph.length_mm[slot], -1)
            continue
        options = [(onward[s][0], onward[s][1], s) for s in graph.onward[slot]]
        missed, rank, following = min(options, default=(True, 0, -1))
        own = -graph.length_mm[slot] if missed else graph.length_mm[slot]
        onward[slot] = (missed, rank + own, following)

    branches: list[list[int]] = []
    for start in range(len(graph.lanes)):
        prefixes = sorted(_branch_prefixes(graph, start), key=lambda p: (onward[p[-1]][0], p))
        for prefix in prefixes:
            branch = list(prefix)
            while (following := onward[branch[-1]][2]) >= 0:
                branch.append(following)
            branches.append(branch)
    return branches


def _shortest_path(graph: RouteGraph, start: int, goal_block: int) -> list[int]:
    """Dijkstra from a slot to a block; falls back on the cheapest of the deepest slots."""
    parent = {start: -1}
    cost = {start: 0.0}
    depth = {start: 1}
    found = {start: 0}  # order of discovery breaks ties
    queue = [(0.0, 0, start)]
    expanded: dict[int, None] = {}
    end = -1
    while queue:
        _, _, slot = heapq.heappop(queue)
        if slot in expanded:
            continue
        if graph.block_of[slot] == goal_block:
            end = slot
            break
        expanded[slot] = None
        for following in graph.successors[slot]:
            total = cost[slot] + graph.length[following]
            if following in expanded or total >= cost.get(following, np.inf):
                continue
            found.setdefault(following, len(found))
            parent[following] = slot
            cost[following] = total
            depth[following] = depth[slot] + 1
            heapq.heappush(queue, (total, found[following], following))
    if end < 0:
        # Expanded in order of cost: the first of the deepest is the cheapest of them.
        end = max(expanded, key=lambda slot: depth[slot])
    path = [end]
    while parent[path[-1]] >= 0:
        path.append(parent[path[-1]])
    return path[::-1]


def _best_exit(
    graph: RouteGraph, entry: int, leave: dict[int, tuple[_Cost, int]], *, jump: int
) -> tuple[_Cost, int]:
    """Chooses the lane in which to leave the block that one is in on lane `entry`.

    Args:
      graph: lanes of the route.
      entry: slot one is in.
      leave: cost of leaving the block, for the slots from which the next block can be reached.
      jump: price of a change that shows as two consecutive entries without a link.

    Returns:
      Cost (lanes crossed, jumps, mm) from the start of the block to the goal, and the chosen slot.
    """
    b = graph.block_of[entry]
    price = CONNECTOR_CHANGE if graph.is_connector[b] else 1
    return min(
        (
            (
                leave[slot][0][0] + price * abs(graph.place[slot] - graph.place[entry]),
                leave[slot][0][1] + jump * (slot != entry),
                leave[slot][0][2] + graph.length_mm[slot],
            ),
            slot,
        )
        for slot in graph.blocks[b]
        if slot in leave
    )


def _branch_prefixes(graph: RouteGraph, start: int) -> list[tuple[int, ...]]:
    """Enumerates the lane sequences up to the branch horizon, nearest forks first."""
    horizon = round(1000.0 * BRANCH_HORIZON)
    ready: list[tuple[int, ...]] = []
    queue: list[tuple[int, tuple[int, ...]]] = [(0, (start,))]
    while queue:
        reached, prefix = heapq.heappop(queue)
        after = graph.onward[prefix[-1]]
        full = len(ready) + len(queue) + len(after) > MAX_BRANCHES
        if reached >= horizon or not after or full:
            ready.append(prefix)
            continue
        for slot in after:
            heapq.heappush(queue, (reached + graph.length_mm[slot], (*prefix, slot)))
    return ready


def _arc_length(points: np.ndarray) -> float:
    """Returns the length of a polyline, m."""
    step = np.diff(points[:, :2], axis=0)
    return float(np.hypot(step[:, 0], step[:, 1]).sum())
