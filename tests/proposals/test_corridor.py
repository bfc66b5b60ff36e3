"""Driving corridors against shapely's buffered lines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.ops import substring

from spdm_jax.agents.observation import RedLights, ego_inside, red_lights
from spdm_jax.geometry import Box, Path, box_at, make_path, project
from spdm_jax.proposals.corridor import (
    corridor_axis,
    corridor_hits_lights,
    corridors_hit_boxes,
    project_where,
)
from spdm_jax.types import LightStatus, Polygons

HALF_WIDTH = 1.1485
NUM_PATHS, NUM_POINTS, NUM_BOXES, NUM_SAMPLES = 3, 40, 200, 5
# GEOS drops vertices of the line that lie within 1 % of the width of it, and a round join of
# several chords counts as a circle here: shapes agree up to this much.
SLACK = 0.015
seeds = st.integers(0, 2**32 - 1)

_axes = jax.jit(jax.vmap(corridor_axis))


@jax.jit
def _hit(axes, half_width, box, present):
    """Every box as an object of its own at a single sample."""
    one_sample = jax.tree.map(lambda v: v[None, None], (box, present))
    return corridors_hit_boxes(axes, half_width, *one_sample)[0, :, 0]


_hit_all = jax.jit(corridors_hit_boxes)
_lights = jax.jit(jax.vmap(corridor_hits_lights, (0, None, None)))
_project_where, _project = jax.jit(project_where), jax.jit(jax.vmap(project, (0, None, None)))


def random_lines(rng: np.random.Generator, bend: float) -> tuple[list[np.ndarray], Path]:
    """Polylines with some repeated points, and the same as padded paths `[L, M]`."""
    lines, padded, counts = [], np.zeros((NUM_PATHS, NUM_POINTS, 3)), []
    for row in range(NUM_PATHS):
        count = int(rng.integers(2, NUM_POINTS + 1))
        turn = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.uniform(-bend, bend, count))
        step = rng.uniform(1, 4, count)
        step[rng.random(count) < 0.15] = 0.0
        step[1] = 2.0
        points = np.cumsum(step[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1), axis=0)
        points -= points.mean(axis=0)
        lines.append(points)
        padded[row, :count, :2], padded[row, :count, 2] = points, turn
        counts.append(count)
    x, y, heading = (jnp.asarray(padded[..., i]) for i in range(3))
    return lines, jax.vmap(make_path)(x, y, heading, jnp.asarray(counts, jnp.int32))


def random_boxes(rng: np.random.Generator, lines: list[np.ndarray]) -> tuple[Box, np.ndarray]:
    """Boxes around the lines, and the same as polygons."""
    rim = np.concatenate(lines)
    center = rim[rng.integers(len(rim), size=NUM_BOXES)] + rng.normal(0, 3, (NUM_BOXES, 2))
    heading = rng.uniform(-np.pi, np.pi, NUM_BOXES)
    size = rng.uniform(0.1, 2.5, (2, NUM_BOXES))
    box = box_at(*(jnp.asarray(v) for v in (*center.T, heading, *size)))
    return box, box_polygons(center, heading, *size)


def box_polygons(center, heading, half_length, half_width) -> np.ndarray:
    along = half_length[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    across = half_width[:, None] * np.stack([-np.sin(heading), np.cos(heading)], 1)
    corners = [center + i * along + j * across for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return np.asarray(shapely.polygons(np.stack(corners, 1)))


def corridor_of(points: np.ndarray, start: float, end: float):
    """The strip as the reference builds it: vertices between two arc lengths, then a buffer."""
    line = shapely.LineString(points)
    progress = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    start, end = np.clip([start, end], 0, progress[-1])
    inside = points[(progress >= start) & (progress <= end)]
    piece = shapely.LineString(inside) if len(inside) > 1 else substring(line, start, end)
    return shapely.buffer(piece, HALF_WIDTH, cap_style="square", quad_segs=16)


@settings(max_examples=20)
@given(seeds, st.sampled_from([0.02, 0.12, 0.9]))
def test_corridors_meet_the_boxes_that_shapely_meets(seed: int, bend: float):
    rng = np.random.default_rng(seed)
    lines, paths = random_lines(rng, bend)
    box, shapes = random_boxes(rng, lines)
    length = np.asarray(paths.length)
    start = rng.uniform(-2, 0.7 * length)
    end = start + rng.uniform(0.5, 60, NUM_PATHS)
    present = rng.random(NUM_BOXES) < 0.9
    axes = _axes(paths, jnp.asarray(start), jnp.asarray(end))
    hit = np.asarray(_hit(axes, jnp.asarray(HALF_WIDTH), box, jnp.asarray(present)))
    assert not hit[:, ~present].any()
    for row, points in enumerate(lines):
        strip = corridor_of(points, start[row], end[row])
        must = shapely.intersects(strip.buffer(-SLACK), shapes) & present
        may = (shapely.distance(strip, shapes) <= SLACK) & present
        assert not (must & ~hit[row]).any()
        assert not (hit[row] & ~may).any()
        assert (may & ~must).mean() < 0.1  # few are left open


@pytest.mark.parametrize("gap, touches", [(-1e-9, True), (1e-9, False)])
@pytest.mark.parametrize("place", ["beside", "behind", "beyond"])
def test_straight_corridor_ends_in_square_caps(gap: float, touches: bool, place: str):
    x = jnp.asarray(np.linspace(0, 30, NUM_POINTS))
    path = make_path(x, jnp.zeros_like(x), jnp.zeros_like(x), jnp.asarray(NUM_POINTS, jnp.int32))
    paths = jax.tree.map(lambda v: jnp.broadcast_to(v, (NUM_PATHS, *v.shape)), path)
    axes = _axes(paths, jnp.zeros(NUM_PATHS), jnp.full(NUM_PATHS, 100.0))
    reach = HALF_WIDTH + 0.5 + gap
    center = {
        "beside": (12.3, reach),
        "behind": (-reach, HALF_WIDTH),  # touches the corner region that a round cap would miss
        "beyond": (30 + reach, -HALF_WIDTH),
    }[place]
    one = box_at(*(jnp.full(NUM_BOXES, v) for v in (*center, 0.0, 0.5, 0.5)))
    hit = _hit(axes, jnp.asarray(HALF_WIDTH), one, jnp.ones(NUM_BOXES, bool))
    np.testing.assert_array_equal(hit, touches)


def test_many_hits_are_all_found():
    """More pairs than are tested at a time."""
    x = jnp.asarray(np.linspace(0, 20, NUM_POINTS))
    path = make_path(x, jnp.zeros_like(x), jnp.zeros_like(x), jnp.asarray(NUM_POINTS, jnp.int32))
    paths = jax.tree.map(lambda v: jnp.broadcast_to(v, (NUM_PATHS, *v.shape)), path)
    axes = _axes(paths, jnp.zeros(NUM_PATHS), jnp.full(NUM_PATHS, 100.0))
    station = np.linspace(0, 20, NUM_BOXES)
    side = np.where(np.arange(NUM_BOXES) % 2, 0.0, 9.0)
    box = box_at(
        *(jnp.asarray(v) for v in (station, side)), *(jnp.full(NUM_BOXES, v) for v in (0.3, 2, 1))
    )
    hit = np.asarray(_hit(axes, jnp.asarray(HALF_WIDTH), box, jnp.ones(NUM_BOXES, bool)))
    np.testing.assert_array_equal(hit, np.broadcast_to(side == 0, hit.shape))


@settings(max_examples=20)
@given(seeds)
def test_moving_objects_are_found_at_every_sample(seed: int):
    """Objects that sweep some road, seen together and sample by sample."""
    rng = np.random.default_rng(seed)
    lines, paths = random_lines(rng, 0.2)
    box, _ = random_boxes(rng, lines)
    way = rng.normal(0, 4, (2, NUM_BOXES)) * (rng.random(NUM_BOXES) < 0.7)
    steps = np.arange(NUM_SAMPLES)[:, None]
    moved = Box(
        box.x + steps * way[0],
        box.y + steps * way[1],
        *(jnp.stack([v] * NUM_SAMPLES) for v in box[2:]),
    )
    present = jnp.asarray(rng.random((NUM_SAMPLES, NUM_BOXES)) < 0.9)
    axes = _axes(paths, jnp.zeros(NUM_PATHS), jnp.asarray(paths.length))
    half_width = jnp.asarray(HALF_WIDTH)
    window = jax.tree.map(lambda v: v[None], moved)
    found = _hit_all(axes, half_width, window, present[None])
    at = np.asarray(_project_where(paths, half_width, window, found))[0]
    together = np.asarray(found)[0]
    for sample in range(NUM_SAMPLES):
        here = Box(*(v[sample] for v in moved))
        alone = np.asarray(_hit(axes, half_width, here, present[sample]))
        np.testing.assert_array_equal(together[:, sample], alone)
        plain = np.where(alone, _project(paths, here.x, here.y), 0)
        np.testing.assert_allclose(at[:, sample], plain, atol=1e-9)
    assert together.any() and not together.all()


def lights_of(shapes: list[shapely.Polygon]) -> RedLights:
    """Areas as the red connectors of a route."""
    edges, row = [], []
    for i, shape in enumerate(shapes):
        ring = shapely.get_coordinates(shape)
        edges.append(np.concatenate([ring[:-1], ring[1:]], axis=1))
        row += [i] * (len(ring) - 1)
    flat = np.concatenate(edges)
    size = 256
    pad = lambda v: np.concatenate([v, np.zeros((size - len(v), *v.shape[1:]), v.dtype)])
    polygons = Polygons(
        xy=jnp.asarray(pad(flat[:, :2])),
        next_xy=jnp.asarray(pad(flat[:, 2:])),
        row=jnp.asarray(pad(np.array(row, np.int32))),
        valid=jnp.asarray(np.arange(size) < len(flat)),
        start=jnp.zeros(len(shapes), jnp.int32),
        count=jnp.zeros(len(shapes), jnp.int32),
    )
    on = jnp.ones(len(shapes), bool)
    status = jnp.full(len(shapes), LightStatus.RED, jnp.int8)
    return red_lights(status, on, ~on, polygons, len(shapes), size)


@settings(max_examples=20)
@given(seeds)
def test_corridors_meet_the_lights_that_shapely_meets(seed: int):
    rng = np.random.default_rng(seed)
    lines, paths = random_lines(rng, 0.12)
    rim = np.concatenate(lines)
    shapes = []
    for _ in range(8):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
        radius = rng.uniform(1, 6, 9)
        center = rim[rng.integers(len(rim))] + rng.normal(0, 4, 2)
        ring = center + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        shapes.append(shapely.Polygon(ring))
    shapes[0] = shapely.box(*(rim.min(0) - 9), *(rim.max(0) + 9))  # all within one area
    red = lights_of(shapes)
    zero, far = jnp.zeros(NUM_PATHS), jnp.full(NUM_PATHS, 1e3)
    hit = np.asarray(_lights(_axes(paths, zero, far), jnp.asarray(HALF_WIDTH), red))
    for row, points in enumerate(lines):
        strip = corridor_of(points, 0, 1e3)
        must = [strip.buffer(-SLACK).intersects(s) for s in shapes]
        may = [strip.distance(s) <= SLACK for s in shapes]
        assert not (must & ~hit[row]).any()
        assert not (hit[row] & ~np.array(may)).any()
        assert hit[row, 0]


def test_red_lights_keep_area_centroid_and_who_is_inside():
    shapes = [shapely.box(0, 0, 20, 5), shapely.Polygon([(30, 0), (40, 0), (30, 9)])]
    red = lights_of(shapes)
    centers = [(s.centroid.x, s.centroid.y) for s in shapes]
    np.testing.assert_allclose(red.centroid, centers)
    within = box_at(jnp.asarray(10.0), jnp.asarray(2.5), jnp.asarray(0.0), 2.6, 1.1)
    np.testing.assert_array_equal(ego_inside(red, within), [True, False])
    across = within._replace(x=jnp.asarray(0.5))
    np.testing.assert_array_equal(ego_inside(red, across), [False, False])
