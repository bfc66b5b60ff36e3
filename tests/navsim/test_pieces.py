"""Pieces of NAVSIM's scores against plain walks through time, shapely and polynomial fits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

import plain_scorer as plain
from navsim_frame import ORIGIN, frame, rectangle
from spdm_jax.config import ScoringParams, VehicleParams
from spdm_jax.geometry import box_at, make_path
from spdm_jax.navsim import layers, timing
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.two_stage import follow_up_weights
from spdm_jax.scoring.areas import ego_areas
from spdm_jax.scoring.driving import driving_direction, lane_keeping
from spdm_jax.scoring.history_comfort import (
    EgoPast,
    center_comfort_signals,
    history_comfort_flags,
    plan_differences,
    plan_features,
)
from spdm_jax.scoring.lights import STEPS_PER_FRAME, RedConnectors, red_contact
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, TUPLAN, profile_named
from spdm_jax.types import Array, EgoState

VEHICLE, PARAMS = VehicleParams(), ScoringParams()
ROWS, STEPS, ROOM = 8, 41, 16
seeds = st.integers(0, 2**32 - 1)


def moving(heading: Array, ax: Array, ay: Array) -> EgoState:
    given = {"heading": heading, "ax": ax, "ay": ay}
    return EgoState(
        **{
            name: jnp.broadcast_to(jnp.asarray(given.get(name, 0.0), float), np.shape(heading))
            for name in EgoState.__dataclass_fields__
        }
    )


# --------------------------------------------------------------------------------------- time


def test_stamps_are_truncated_to_microseconds():
    lag = lambda start: timing.sample_times(start) - start - 100_000 * np.arange(STEPS)
    early = lag(4_000_000)
    assert early[1] == -1
    assert not early[2:].any()
    sampled = timing.sampling(4_000_000)
    assert sampled.share[1] == 99_999 / 500_000
    assert sampled.share[2] == 0.4
    assert sampled.left[0] == sampled.share[0] == 0
    assert sampled.left[-1] == 7
    assert sampled.share[-1] == 1
    # With the time of today most stamps are early, those of poses too.
    today = 1_623_707_858_950_113
    assert (lag(today) == -1).sum() > STEPS // 2
    assert (timing.pose_times(today) - today - 500_000 * np.arange(1, 9) == -1).all()
    shares = timing.sampling(today).share
    assert shares.min() >= 0
    assert shares.max() <= 1


@pytest.mark.parametrize("first, count", [(-1_500_000, 14), (-1_500_231, 15), (-1_400_001, 14)])
def test_the_past_ends_two_samples_early(first: int, count: int):
    start = 1_650_000_000_500_000
    times = start + np.array([first, -1_000_000, -500_000, 0])
    states = np.zeros((4, 11))
    states[:, 0], states[:, 2] = np.arange(4), [3.0, 3.1, -3.1, -3.0]
    states[:, 8:] = 1.0
    stamps, sampled = timing.past_samples(states, times)
    assert len(stamps) == len(sampled) == count
    np.testing.assert_array_equal(np.diff(stamps), 100_000)
    # Regular stamps: -1.5 ... -0.2 s, although -0.1 s would be before the current state.
    assert stamps[-1] + 100_000 < start
    assert sampled[0, 0] == 0
    assert np.abs(np.diff(sampled[:, 2])).max() < 0.1  # headings are unwrapped
    assert not sampled[:, 8:].any()
    past = timing.ego_past(sampled, ROOM)
    np.testing.assert_array_equal(past.heading[ROOM - count :], sampled[:, 2])
    assert set(past.heading[: ROOM - count]) <= {sampled[0, 2]}


# ------------------------------------------------------------------------ direction, lane, lights

_direction = jax.jit(
    lambda x, flags: driving_direction(x, jnp.zeros_like(x), flags, PARAMS, 11, False)
)


@settings(max_examples=15)
@given(seeds)
def test_the_way_against_traffic_is_summed_over_eleven_steps(seed: int):
    rng = np.random.default_rng(seed)
    step = rng.uniform(0, 1.1, (ROWS, STEPS)) * rng.uniform(0, 1, (ROWS, 1))
    step[:, 0] = 0
    against = rng.random((ROWS, STEPS)) < 0.7
    x = np.cumsum(step, axis=1)
    ours = np.asarray(_direction(jnp.asarray(x), jnp.asarray(against)))
    way = np.where(against, step, 0)
    longest = [max(row[max(0, k - 10) : k + 1].sum() for k in range(STEPS)) for row in way]
    np.testing.assert_array_equal(ours, [1.0 if w < 2 else 0.5 if w < 6 else 0.0 for w in longest])


LINE = np.array([[-30.0, 0], [0, 0], [0, 0], [25, 4], [60, 4]])
_keeps = jax.jit(
    lambda x, y, inside: lane_keeping(
        make_path(jnp.asarray(LINE[:, 0]), jnp.asarray(LINE[:, 1]), jnp.zeros(5), jnp.int32(5)),
        x,
        y,
        inside,
    )
)


@settings(max_examples=15)
@given(seeds)
def test_lane_keeping_passes_over_intersections(seed: int):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-40, 60, (ROWS, 1)) + np.arange(STEPS)
    near = np.interp(x, LINE[:, 0], LINE[:, 1])
    # Mostly beside the line, now and then on it or in an intersection.
    y = near + np.where(rng.random((ROWS, STEPS)) < 0.04, 0, 1) * rng.uniform(0.3, 1, (ROWS, 1))
    inside = np.repeat(rng.random((ROWS, STEPS // 5 + 1)) < 0.3, 5, axis=1)[:, :STEPS]
    ours = np.asarray(_keeps(jnp.asarray(x), jnp.asarray(y), jnp.asarray(inside)))
    line = shapely.LineString(LINE)
    for row in range(ROWS):
        counter, kept = 0, 1.0
        for k in range(STEPS):
            if inside[row, k]:
                continue
            beside = line.distance(shapely.Point(x[row, k], y[row, k])) > 0.5
            counter = counter + 1 if beside else 0
            kept = 0.0 if counter >= 20 else kept
        assert ours[row] == kept


def test_twenty_steps_beside_the_line_are_one_too_many():
    x = np.broadcast_to(np.arange(STEPS) * 0.1 - 20, (ROWS, STEPS))
    y = np.zeros((ROWS, STEPS))
    inside = np.zeros((ROWS, STEPS), bool)
    y[0, :20], y[1, :19], y[2, :19], y[3, :30] = 1, 1, 1, 1
    y[2, 25:36] = 1  # an intersection between two runs joins them
    inside[2, 19:25] = inside[3, 15:26] = True
    ours = np.asarray(_keeps(jnp.asarray(x), jnp.asarray(y), jnp.asarray(inside)))
    assert ours[:5].tolist() == [0, 1, 0, 1, 1]


_touches = jax.jit(
    lambda x, y, h, red: red_contact(box_at(x, y, h, jnp.asarray(2.5), jnp.asarray(1.1)), red)
)


@settings(max_examples=15)
@given(seeds)
def test_red_contacts_are_those_of_shapely(seed: int):
    rng = np.random.default_rng(seed)
    rings, edges = [], np.zeros((64, 4))
    start, count = np.zeros(4, np.int32), np.zeros(4, np.int32)
    for j in range(3):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
        ring = rng.uniform(-15, 15, 2) + np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(
            0.5, 9, (7, 1)
        )
        rings.append(shapely.Polygon(ring))
        start[j], count[j] = 7 * j, 7
        edges[7 * j : 7 * j + 7] = np.concatenate([ring, np.roll(ring, -1, axis=0)], axis=1)
    lit = rng.random((4, 11)) < 0.5
    x = rng.uniform(-20, 10, (ROWS, 1)) + rng.uniform(0, 0.6, (ROWS, 1)) * np.arange(STEPS)
    y = rng.uniform(-15, 15, (ROWS, 1)) + np.zeros((1, STEPS))
    heading = np.broadcast_to(rng.uniform(-3, 3, (ROWS, 1)), (ROWS, STEPS))
    red = RedConnectors(
        edges=jnp.asarray(edges),
        start=jnp.asarray(start),
        count=jnp.asarray(count),
        red=jnp.asarray(lit),
    )
    ours = np.asarray(_touches(*(jnp.asarray(v) for v in (x, y, heading)), red))
    for row in range(ROWS):
        corners = plain.corners(x[row], y[row], heading[row], 5.0, 2.2)
        boxes = [shapely.Polygon(box) for box in corners]
        first = STEPS
        for k in range(STEPS):
            active = [r for j, r in enumerate(rings) if lit[j, k // STEPS_PER_FRAME]]
            if any(shapely.intersects(boxes[k], r) for r in active):
                first = k
                break
        assert ours[row] == first


# ---------------------------------------------------------------------------------------- areas


_areas = jax.jit(ego_areas)


@settings(max_examples=10)
@given(seeds)
def test_few_bits_tell_what_many_polygons_do(seed: int):
    rng = np.random.default_rng(seed)
    low = rng.uniform(-60, 50, (40, 2))
    size = rng.uniform(1, 25, (40, 2))
    rings = []
    for a, b in zip(low, size, strict=True):
        angle = rng.uniform(0, np.pi)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        rings.append(a + (rectangle(0, 0, *b) - b / 2) @ turn)
    polygons = [shapely.Polygon(ring) for ring in rings]
    kind = rng.integers(0, 5, 40)
    kind[0] = layers.BLOCK
    on_route = rng.random(40) < 0.5
    given = {
        **frame(),
        "map_ring_offsets": np.arange(41) * 5,
        "map_ring_xy": np.concatenate(rings) + ORIGIN,
        "map_ring_object": np.arange(40),
        "map_kind": kind,
        "map_on_route": on_route,
    }
    scene = from_arrays(given)
    masks = scene.masks
    assert (
        sum(bin(word).count("1") for word in np.asarray(masks.lanes))
        < np.isin(kind, layers.LANE_KINDS).sum()
    )
    pose = rng.uniform(-60, 60, (2, 30, 2)), rng.uniform(-3, 3, (30, 2))
    x, y, heading = (jnp.asarray(v) for v in (*pose[0], pose[1]))
    ego = moving(heading, 0.0, 0.0).replace(x=x, y=y)
    reach = VEHICLE.rear_axle_to_center
    box = box_at(
        x + reach * jnp.cos(heading),
        y + reach * jnp.sin(heading),
        heading,
        jnp.asarray(0.5 * VEHICLE.length),
        jnp.asarray(0.5 * VEHICLE.width),
    )
    areas, crossings = jax.tree.map(np.asarray, _areas(scene.grid, masks, ego, box))
    drivable, lanes = np.isin(kind, layers.DRIVABLE_KINDS), np.isin(kind, layers.LANE_KINDS)
    for i in np.ndindex(*x.shape):
        center = (box.x[i], box.y[i])
        corner = plain.corners(*center, heading[i], VEHICLE.length, VEHICLE.width)
        inside = np.array([shapely.contains_xy(p, *corner.T) for p in polygons])
        own = inside[lanes]
        many = own.any(1).sum() > 1 and not own.all(1).any()
        assert areas.multiple_lanes[i] == many
        assert areas.non_drivable[i] == (not inside[drivable].any(0).all())
        in_any = lambda flags, at: any(
            shapely.contains_xy(p, *at) for p, take in zip(polygons, flags, strict=True) if take
        )
        assert areas.oncoming[i] == (not in_any(lanes & on_route, center))
        assert crossings.center[i] == in_any(kind == layers.INTERSECTION, center)
        rear = (float(x[i]), float(y[i]))
        assert crossings.rear_axle[i] == in_any(kind == layers.INTERSECTION, rear)


def test_lanes_of_one_number_are_apart():
    boxes = [shapely.box(3.0 * i, 0, 3.0 * i + 2.9, 50) for i in range(40)]
    number = layers.shared_bits(boxes, 6.0)
    for i, a in enumerate(boxes):
        for j, b in enumerate(boxes[:i]):
            assert number[i] != number[j] or a.distance(b) > 6.0
    assert number.max() < 6


# -------------------------------------------------------------------------------------- comfort


def noisy(rng: np.random.Generator, size: int) -> tuple[Array, Array, Array, Array]:
    heading = np.cumsum(rng.normal(0, 0.03, (ROWS, size)), axis=1) + rng.uniform(-3, 3, (ROWS, 1))
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    ax, ay = rng.normal(0, 1, (2, ROWS, size))
    return heading, ax, ay, rng.normal(0, 0.1, (ROWS, size))


def plain_signals(heading, ax, ay, turning) -> np.ndarray:
    """`[6, T]` of one row."""
    smooth = lambda v: np.round(plain.smooth(v, 8, 2), 8)
    lon, lat = smooth(ax + VEHICLE.rear_axle_to_center * turning), smooth(ay)
    heading = np.unwrap(heading)
    derived = (
        plain.smooth(smooth(np.hypot(ax, ay)), 15, 2, 1),
        plain.smooth(lon, 15, 2, 1),
        plain.smooth(heading, 5, 3, 2),
        plain.smooth(heading, 5, 2, 1),
    )
    return np.round([lon, lat, *derived], 8)


_center_signals = jax.jit(center_comfort_signals)
_NAMES = ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate")


@pytest.mark.parametrize("count", [14, 15, 16])
def test_comfort_with_a_past_filters_past_and_present_as_one(count: int):
    size = ROOM + STEPS
    rows = noisy(np.random.default_rng(count), size)
    begin = ROOM - count
    padded = [v.copy() for v in rows]
    padded[0][:, :begin] = padded[0][:, begin : begin + 1]
    for values in padded[1:]:
        values[:, :begin] = 1e3  # never seen
    given = [jnp.asarray(v) for v in padded]
    signals = _center_signals(*given, VEHICLE, jnp.int32(begin))
    ours = np.stack([signals[name] for name in _NAMES], 1)
    for row in range(ROWS):
        expected = plain_signals(*(v[row, begin:] for v in rows))
        np.testing.assert_allclose(ours[row, :, begin:], expected, atol=2e-8)


def test_the_past_is_as_long_as_it_says():
    rng = np.random.default_rng(3)
    heading, ax, ay, _ = noisy(rng, STEPS)
    states = moving(0.05 * heading, 0.05 * ax, 0.05 * ay)
    calm = np.zeros(ROOM)
    judged = jax.jit(lambda past: history_comfort_flags(states, past, VEHICLE, PARAMS))

    def flags(ax: np.ndarray, count: int) -> np.ndarray:
        fields = {"heading": calm, "ax": ax, "ay": calm, "count": np.int32(count)}
        return np.asarray(judged(EgoPast(**{k: jnp.asarray(v) for k, v in fields.items()})))

    assert not flags(np.full(ROOM, -6.0), 14)[:, 0].any()
    assert flags(calm, 14)[:, 0].all()
    # Beyond the count nothing counts, and without a past everything passes.
    older = np.where(np.arange(ROOM) < 2, -60.0, 0.0)
    np.testing.assert_array_equal(flags(older, 14), flags(calm, 14))
    assert not flags(older, 16)[:, 0].any()
    assert flags(np.full(ROOM, -6.0), 0).all()


@pytest.mark.parametrize("steps", [0, 3, 5])
def test_extended_comfort_compares_the_shared_time(steps: int):
    rng = np.random.default_rng(steps)
    ours, theirs = (noisy(rng, STEPS)[:3] for _ in range(2))
    rms = np.asarray(plan_differences(moving(*ours), moving(*theirs), jnp.int32(steps)))
    end = STEPS - steps

    def features(heading, ax, ay) -> np.ndarray:
        accel = np.round(plain.smooth(np.hypot(ax, ay), 8, 2), 8)
        heading = np.unwrap(heading)
        derived = (plain.smooth(accel, 15, 2, 1), plain.smooth(heading, 5, 2, 1))
        # A polynomial of order 2 also for the second derivative.
        return np.round([accel, *derived, plain.smooth(heading, 5, 2, 2)], 8)

    for row in range(ROWS):
        now = features(*(v[row, :end] for v in ours))
        then = features(*(v[row, steps:] for v in theirs))
        expected = np.sqrt(np.mean((now - then) ** 2, axis=1))
        np.testing.assert_allclose(rms[row], expected, atol=1e-7)


def test_single_precision_keeps_its_type():
    rows = noisy(np.random.default_rng(1), STEPS)
    heading, ax, ay, turning = (jnp.asarray(v, jnp.float32) for v in rows)
    signals = (
        center_comfort_signals(heading, ax, ay, turning, VEHICLE),
        plan_features(heading, ax, ay, STEPS),
    )
    assert {v.dtype for v in jax.tree.leaves(signals)} == {np.dtype("float32")}


# ------------------------------------------------------------------------------- weights, profiles


def test_follow_ups_near_the_end_weigh_most():
    starts = jnp.asarray([[0.0, 0.1], [0.0, 0.5], [9.0, 9.0]])
    near = np.asarray(follow_up_weights(jnp.zeros(2), starts))
    assert near.sum() == pytest.approx(1)
    assert near[0] / near[1] == pytest.approx(np.exp((0.25 - 0.01) / 0.2))
    far = np.asarray(follow_up_weights(jnp.asarray([50.0, 0]), starts))
    np.testing.assert_allclose(far, 1 / 3)
    masked = follow_up_weights(jnp.asarray([50.0, 0]), starts, jnp.asarray([True, True, False]))
    np.testing.assert_allclose(masked, [0.5, 0.5, 0])


def test_profiles_are_found_by_name():
    assert profile_named("navsim1") is NAVSIM1
    assert profile_named("tuplan") is TUPLAN
    assert hash(NAVSIM2) != hash(profile_named("navsim2_unfiltered"))
    assert sum(w for _, w in NAVSIM1.weights) == 12
    assert sum(w for _, w in NAVSIM2.weights) == 16
    assert NAVSIM2.judges("traffic_light")
    assert not NAVSIM1.judges("driving_direction")
    with pytest.raises(ValueError, match=r"'navsim3'.*navsim1, navsim2, navsim2_unfiltered"):
        profile_named("navsim3")
