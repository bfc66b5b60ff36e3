"""Driven routes and corner lanes against the lists of the specification, on random worlds."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from spdm_jax.io.flatten import index_table, polygons_of_rings
from spdm_jax.metrics.routes import corner_lanes, driven_route, lane_changes
from spdm_jax.scoring.areas import Areas
from spdm_jax.types import Lanes

LANES, STEPS, SEEDS = 12, 40, 48
NEAR = 5.0


class World:
    """A few lanes and connectors, strewn at random and linked at random; lists hold numbers."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.connector = rng.random(LANES) < 0.6
        links = rng.random((LANES, LANES)) < 0.45
        np.fill_diagonal(links, False)
        self.out = [np.flatnonzero(row).tolist() for row in links]
        self.into = [np.flatnonzero(row).tolist() for row in links.T]
        corner, size = rng.uniform(-25, 15, (LANES, 2)), rng.uniform(8, 20, (LANES, 2))
        self.shapes = [shapely.box(*c, *(c + s)) for c, s in zip(corner, size, strict=True)]
        drift = rng.normal(0, 4.0, (STEPS, 2)).cumsum(0)
        self.points = drift + rng.uniform(-8, 8, 2)
        offset = np.array([[4, 1], [-1, 1], [-1, -1], [4, -1]])
        self.corners = self.points[:, None] + offset
        self.crossing = rng.random(STEPS) < 0.6
        self.stayed = self.emptied = self.narrowed = 0

    def inside(self, point: np.ndarray) -> list[int]:
        # No two lanes overlap: what a later one shares with an earlier one is not in it.
        at = shapely.Point(point)
        found = [i for i in range(LANES) if self.shapes[i].contains(at)]
        lanes = [i for i in found if not self.connector[i]]
        return [i for i in found if self.connector[i] or i == lanes[0]]

    def look_up(self, point: np.ndarray) -> list[int]:
        found = self.inside(point)
        lanes = [i for i in found if not self.connector[i]]
        return lanes or found

    def keep_on(self, before: list[int], point: np.ndarray) -> list[int]:
        here = self.inside(point)
        kept = [i for i in before if i in here]
        if not kept and len(before) == 1:
            kept = [i for i in self.out[before[0]] if i in here]
        return kept

    def route(self) -> list[list[int]]:
        lists: list[list[int]] = []
        for index, point in enumerate(self.points):
            before = lists[-1] if lists else []
            now = self.keep_on(before, point)
            if not now:
                now = self.look_up(point)
                astray = self.connector[now[0]] if now else self.crossing[index]
                if index > 1 and before and self.connector[before[0]] and astray:
                    at = shapely.Point(point)
                    near = [i for i in before if self.shapes[i].distance(at) < NEAR]
                    self.stayed += bool(near)
                    now = near or now
            lists.append(now)
        for index in reversed(range(STEPS - 1)):
            now, after = lists[index], lists[index + 1]
            if len(now) < 2:
                continue
            if len(now) > len(after) and set(after) <= set(now):
                lists[index] = after
                self.emptied += not after
            if after and not self.connector[after[0]]:
                entering = [i for i in now if i in self.into[after[0]]]
                self.narrowed += 0 < len(entering) < len(now)
                lists[index] = entering or lists[index]
        return lists

    def corner_lists(self) -> list[list[list[int]]]:
        lists, candidates = [], []
        for index, points in enumerate(self.corners):
            row, union = [], []
            for point in points:
                now = self.keep_on(candidates, point)
                if not now:
                    now = self.look_up(point)
                    if index == 1:
                        candidates = candidates + [i for i in now if i not in candidates]
                union += [i for i in now if i not in union]
                row.append(now)
            lists.append(row)
            candidates = union
        return lists

    def common(self, row: list[list[int]]) -> set[int] | None:
        if not any(row):
            return set()
        if not all(row):
            return None
        fl, rl, rr, fr = (set(members) for members in row)
        if shared := fl & rl & rr & fr:
            return shared
        out = lambda members: members | {j for i in members for j in self.out[i]}
        into = lambda members: members | {j for i in members for j in self.into[i]}
        if not (rl & out(rr)) | (rr & out(rl)):
            return None
        return into(fl) & out(rr) & into(fr) & out(rl) or None

    def changes(self, sets: list[set[int] | None]) -> list[tuple[int, int, bool]]:
        """Begin, end and success of each lane change."""
        found, begin, origin = [], None, set()
        for index in range(1, STEPS):
            now, before = sets[index], sets[index - 1]
            if begin is None:
                if now is None and before:
                    begin, origin = index, before | {j for i in before for j in self.out[i]}
            elif now is not None:
                found.append((begin, index, bool(now) and not origin & now))
                begin = None
        if begin is not None:
            found.append((begin, STEPS - 1, False))
        return found

    def lanes(self) -> Lanes:
        names = {str(i): i for i in range(LANES)}
        table = lambda links: [[str(i) for i in row] for row in links]
        both = index_table([*table(self.out), *table(self.into)], names)
        both = np.pad(both, ((0, 0), (0, LANES - both.shape[1])), constant_values=-1)
        rings = [shapely.get_coordinates(shape) for shape in self.shapes]
        fields: dict = dict.fromkeys(Lanes.__dataclass_fields__)
        return Lanes(
            **fields
            | {
                "valid": np.ones(LANES, bool),
                "is_connector": self.connector,
                "successors": both[:LANES],
                "predecessors": both[LANES:],
                "polygon": polygons_of_rings(rings, np.zeros(2)),
            }
        )

    def flags(self, lists) -> np.ndarray:
        result = np.zeros((len(lists), LANES), bool)
        for row, members in zip(result, lists, strict=True):
            row[list(members)] = True
        return result


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    return [World(seed) for seed in range(SEEDS)]


@partial(jax.jit)
@partial(jax.vmap)
def follow(lanes, inside, crossing, points, valid):
    x, y = points[:, 0], points[:, 1]
    return driven_route(lanes, Areas(inside, crossing), x, y, valid, NEAR)


@partial(jax.jit)
@partial(jax.vmap)
def follow_corners(lanes, inside, time, valid):
    corners = corner_lanes(lanes, inside)
    return corners, lane_changes(lanes, corners, time, valid)


def stacked(trees):
    return jax.tree.map(lambda *v: jnp.stack([jnp.asarray(x) for x in v]), *trees)


def test_routes(worlds: list[World]):
    inside = [w.flags([w.inside(p) for p in w.points]) for w in worlds]
    given = [
        (w.lanes(), i, w.crossing, w.points, np.ones(STEPS, bool))
        for w, i in zip(worlds, inside, strict=True)
    ]
    ours = np.asarray(follow(*stacked(given)))
    expected = [w.route() for w in worlds]
    for w, mine, lists in zip(worlds, ours, expected, strict=True):
        np.testing.assert_array_equal(mine, w.flags(lists))
    # The worlds hold what the rules are about.
    for rule in ("stayed", "emptied", "narrowed"):
        assert sum(getattr(w, rule) for w in worlds) > 1, rule


def test_routes_of_runs_that_end_early(worlds: list[World]):
    steps = 17
    valid = np.arange(STEPS) < steps
    whole, cut = [], []
    for w in worlds:
        inside = w.flags([w.inside(p) for p in w.points])
        whole.append((w.lanes(), inside, w.crossing, w.points, valid))
        cut.append(tuple(v[:steps] for v in (inside, w.crossing, w.points, valid)))
    ours = np.asarray(follow(*stacked(whole)))
    for (lanes, *_), arrays, mine in zip(whole, cut, ours, strict=True):
        alone = follow(*stacked([(lanes, *arrays)]))[0]
        np.testing.assert_array_equal(mine[:steps], alone)
        assert not mine[steps:].any()


def test_corners_and_lane_changes(worlds: list[World]):
    time = 0.1 * np.arange(STEPS)
    given = []
    for w in worlds:
        inside = [w.flags([w.inside(p) for p in points]) for points in w.corners]
        given.append((w.lanes(), np.stack(inside), time, np.ones(STEPS, bool)))
    ours, ended = jax.tree.map(np.asarray, follow_corners(*stacked(given)))
    total = 0
    for i, w in enumerate(worlds):
        lists = w.corner_lists()
        for corner in range(4):
            expected = w.flags([row[corner] for row in lists])
            np.testing.assert_array_equal(ours.corners[i, :, corner], expected)
        sets = [w.common(row) for row in lists]
        np.testing.assert_array_equal(ours.common[i], w.flags([s or () for s in sets]))
        assert ours.apart[i].tolist() == [s is None for s in sets]
        changes = w.changes(sets)
        total += len(changes)
        found = np.flatnonzero(ended.ended[i])
        assert [(end, ended.succeeded[i][end]) for end in found] == [
            (end, success) for _, end, success in changes
        ]
        np.testing.assert_allclose(
            ended.duration[i][found], [0.1 * (end - begin) for begin, end, _ in changes]
        )
    assert total > 10
