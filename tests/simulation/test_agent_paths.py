"""Paths of reactive agents: what joining, cutting and thinning keep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from spdm_jax.simulation.agent_paths import (
    AgentPath,
    append_lane,
    empty_path,
    path_between,
    path_end,
    path_from,
    path_pose,
    start_curvature,
    start_of_rest,
)
from spdm_jax.types import Lanes, Polylines

SIZE = 33


def lanes_of(*lines: np.ndarray) -> Lanes:
    """A lane table with nothing but baselines `[n, 3]`."""
    count = np.array([len(line) for line in lines])
    points = np.concatenate(lines)
    table = roads.scene_of(roads.road()).map.lanes
    polylines = Polylines(
        points=jnp.asarray(points),
        row=jnp.asarray(np.repeat(np.arange(len(lines)), count)),
        valid=jnp.ones(len(points), bool),
        start=jnp.asarray(np.cumsum(count) - count),
        count=jnp.asarray(count),
    )
    length = [np.hypot(*np.diff(line[:, :2], axis=0).T).sum() for line in lines]
    return table.replace(
        centerline=polylines, valid=jnp.ones(len(lines), bool), length=jnp.asarray(length)
    )


def straight(start: float, num: int, spacing: float = 2.0) -> np.ndarray:
    x = start + spacing * np.arange(num)
    return np.stack([x, np.zeros(num), np.zeros(num)], 1)


LANES = lanes_of(straight(0.0, 6), straight(10.0, 5), np.repeat(straight(18.0, 4), 2, 0))
_append = jax.jit(append_lane)


def append(path: AgentPath, progress: float, lane: int, lanes: Lanes = LANES) -> AgentPath:
    joined, overflow = _append(path, jnp.asarray(progress), lanes, jnp.int32(lane))
    assert not overflow
    return joined


def points(path: AgentPath) -> np.ndarray:
    return np.asarray(path.x)[: int(path.count)]


@pytest.fixture(scope="module")
def first() -> AgentPath:
    return append(empty_path(SIZE, jnp.float64), 0.0, 0)


def test_a_new_path_loses_its_last_point(first: AgentPath):
    np.testing.assert_allclose(points(first), [0, 2, 4, 6, 8])
    assert float(path_end(first)) == 8.0


def test_extension_starts_at_the_agent(first: AgentPath):
    longer = append(first, 3.0, 1)
    np.testing.assert_allclose(points(longer), [3, 4, 6, 8, 10, 12, 14, 16])
    assert float(path_end(longer)) == 13.0


def test_coincident_points_are_dropped(first: AgentPath):
    longer = append(append(first, 4.0, 1), 0.0, 2)
    np.testing.assert_allclose(points(longer), [4, 6, 8, 10, 12, 14, 16, 18, 20, 22])


def test_an_agent_beyond_the_end_starts_one_point_back(first: AgentPath):
    for progress, start in ((7.9, 7.9), (8.0, 6.0), (11.0, 6.0), (-1.0, 0.0)):
        assert float(start_of_rest(first, jnp.asarray(progress))) == pytest.approx(start)


def test_headings_turn_the_short_way(first: AgentPath):
    path = first.replace(heading=first.heading.at[:2].set(jnp.array([3.1, 2 * np.pi - 3.1])))
    _, _, heading = path_pose(path, jnp.asarray(1.0))
    assert abs(abs(float(heading)) - np.pi) < 1e-9


def test_what_lies_behind_collapses(first: AgentPath):
    x, _ = path_from(first, jnp.asarray(5.0))
    np.testing.assert_allclose(np.asarray(x)[:6], [5, 5, 5, 6, 8, 8])


def test_pieces_keep_their_ends_and_are_thinned(first: AgentPath):
    x, _ = path_between(first, jnp.asarray(1.0), jnp.asarray(7.0), 9)
    np.testing.assert_allclose(np.asarray(x), [1, 2, 4, 6, 7, 7, 7, 7, 7])
    x, _ = path_between(first, jnp.asarray(1.0), jnp.asarray(7.5), 4)
    np.testing.assert_allclose(np.asarray(x), [1, 2, 6, 7.5])


def test_too_long_paths_are_reported():
    _, overflow = _append(
        empty_path(5, jnp.float64), jnp.asarray(0.0), lanes_of(straight(0, 40)), jnp.int32(0)
    )
    assert overflow


def test_curvature_at_the_start():
    angle = np.linspace(0, 1, 200)
    circle = np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle), angle], 1)
    short = circle[:10]
    curvature = np.asarray(jax.jit(start_curvature)(lanes_of(straight(0, 6), circle, short)))
    np.testing.assert_allclose(curvature, [0, 1 / 20, 1 / 20], atol=1e-3)
