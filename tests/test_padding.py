"""Padding: masks stay true, indices stay in range, and nothing real changes or is cut."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from random_world import world
from spdm_jax.io.build import build_scenario, raw_map
from spdm_jax.padding import (
    PaddedStack,
    PaddingConfig,
    batch,
    bucket,
    sizes_of,
    to_device,
)
from spdm_jax.schema import LEAVES, from_leaves, leaves_of
from spdm_jax.types import PolygonGrid, Scenario, ScenarioInfo

AXES = sorted({axis for leaf in LEAVES.values() for axis in leaf.axes if isinstance(axis, str)})
# The grid is the largest part of a scenario; small buckets keep these tests quick.
SMALL = PaddingConfig(
    grid_cells=(1024, 4096, 16384, 65536, 262144),
    grid_rows=(64, 512, 4096),
    grid_edges=(64, 1024, 16384),
)


@pytest.fixture(scope="module")
def built() -> list[tuple[Scenario, ScenarioInfo]]:
    raws = [world(2), world(7, blocks=2, lanes=3, agents=0), world(4, areas=0)]
    return [build_scenario(raw, margin=15.0) for raw in raws]


def pad_scenario(scenario: Scenario, sizes: dict[str, int]) -> Scenario:
    stack = PaddedStack(1, sizes)
    stack.add(leaves_of(scenario), sizes_of(scenario))
    return from_leaves({path: np.asarray(array[0]) for path, array in stack.leaves().items()})


def polygons_at(grid: PolygonGrid, points: np.ndarray) -> list[set[int]]:
    """Returns the polygons that contain each point, by the rule that `PolygonGrid` states."""
    i, j = np.floor((points - grid.origin) / grid.cell_size).astype(int).T
    cells = i * grid.shape[1] + j
    centers = grid.origin + (np.stack([i, j], 1) + 0.5) * grid.cell_size
    found = []
    for cell, center, point in zip(cells, centers, points, strict=True):
        row = grid.cell_row[cell]
        words = grid.masks[grid.row_mask[row]]
        inside = {n for n in range(32 * len(words)) if words[n // 32] >> (n % 32) & 1}
        own = slice(grid.edge_start[row], grid.edge_start[row] + grid.edge_count[row])
        edges = grid.edges[own]
        way = shapely.LineString([(0, 0), point - center])
        for edge, polygon in zip(edges, grid.edge_polygon[own], strict=True):
            if polygon >= 0 and way.crosses(shapely.LineString(edge.reshape(2, 2))):
                inside ^= {int(polygon)}
        found.append(inside)
    return found


def test_bucket_takes_the_smallest_that_fits():
    assert [bucket(n, (64, 8, 16)) for n in (0, 8, 9, 64)] == [8, 8, 16, 64]
    with pytest.raises(ValueError, match="65 exceeds the largest bucket 64"):
        bucket(65, (64, 8, 16))


def test_config_is_hashable_and_covers_every_axis():
    assert hash(PaddingConfig()) == hash(PaddingConfig())
    assert PaddingConfig(lanes=(4,)) != PaddingConfig()
    fields = {field.name for field in dataclasses.fields(PaddingConfig)}
    assert fields == {*AXES} - {"grid_words"}
    for field in fields:
        sizes = getattr(PaddingConfig(), field)
        assert list(sizes) == sorted(set(sizes)) and all(type(size) is int for size in sizes)


@settings(max_examples=10)
@given(extra=st.dictionaries(st.sampled_from(AXES), st.integers(0, 40)))
def test_real_entries_are_unchanged_and_padding_is_inert(
    built: list[tuple[Scenario, ScenarioInfo]], extra: dict[str, int]
):
    for scenario, _ in built:
        present = sizes_of(scenario)
        target = {axis: size + extra.get(axis, 0) for axis, size in present.items()}
        padded = pad_scenario(scenario, target)
        sizes = sizes_of(padded)
        del target["grid_words"], sizes["grid_words"]
        assert sizes == target
        for path, leaf in leaves_of(padded).items():
            source = leaves_of(scenario)[path]
            assert leaf.dtype == source.dtype, path
            if path not in ("map.grid.masks", "map.grid.edge_polygon"):
                real = tuple(slice(n) for n in source.shape)
                np.testing.assert_array_equal(leaf[real], source, err_msg=path)
                rest = leaf.copy()
                rest[real] = LEAVES[path].fill
                assert (rest == LEAVES[path].fill).all(), path


def test_stack_used_again_holds_nothing_of_before(built: list[tuple[Scenario, ScenarioInfo]]):
    scenes = [scenario for scenario, _ in built]
    most = {axis: max(sizes_of(scene)[axis] for scene in scenes) + 2 for axis in AXES}
    stack = PaddedStack(3, most, dtype=np.float32)
    for scene in scenes:
        stack.add(leaves_of(scene), sizes_of(scene))
    stack.clear()
    stack.add(leaves_of(scenes[1]), sizes_of(scenes[1]))
    fresh = leaves_of(pad_scenario(scenes[1], most))
    for path, array in stack.leaves().items():
        kind = np.float32 if fresh[path].dtype == np.float64 else fresh[path].dtype
        assert array.shape == (1, *fresh[path].shape) and array.dtype == kind, path
        np.testing.assert_array_equal(array[0], fresh[path].astype(kind), err_msg=path)


def test_padding_values(built: list[tuple[Scenario, ScenarioInfo]]):
    scenario, _ = built[0]
    present = sizes_of(scenario)
    padded = pad_scenario(scenario, {axis: size + 3 for axis, size in present.items()})
    lanes = padded.map.lanes
    for mask in (lanes.valid, padded.map.roadblocks.valid, padded.ego_valid, lanes.polygon.valid):
        assert not mask[-3:].any()
    assert not padded.tracks.valid[-3:].any() and not padded.tracks.valid[:, -3:].any()
    for index in (lanes.successors, lanes.roadblock, padded.route.start_lane):
        assert (index[-3:] == -1).all()
    assert (padded.route.branch_lanes[:, -3:] == -1).all()
    assert (lanes.speed_limit[-3:] == 0).all() and (lanes.polygon.count[-3:] == 0).all()
    assert (lanes.polygon.row[-3:] == 0).all() and lanes.polygon.row.max() < present["lanes"]
    assert np.isnan(lanes.speed_limit).any()
    for path, leaf in leaves_of(padded).items():
        assert path == "map.lanes.speed_limit" or np.isfinite(leaf).all(), path


@pytest.mark.parametrize("extra", [0, 1, 37])
def test_grid_numbers_polygons_as_the_padded_rows(
    built: list[tuple[Scenario, ScenarioInfo]], extra: int
):
    scenario, info = built[1]
    target = {axis: size + extra for axis, size in sizes_of(scenario).items()}
    target["car_parks"] += extra
    padded = pad_scenario(scenario, target)
    local, world_map = raw_map(scenario, info), padded.map
    shapes = {i: shapely.Polygon(lane.polygon) for i, lane in enumerate(local.lanes.values())}
    after = len(world_map.lanes.valid)
    shapes |= {after + i: area.polygon for i, area in enumerate(local.car_parks)}
    after += len(world_map.car_parks.count)
    shapes |= {after + i: area.polygon for i, area in enumerate(local.intersections)}
    assert local.car_parks and local.intersections

    rng = np.random.default_rng(0)
    points = []
    for shape in shapes.values():
        x0, y0, x1, y1 = shape.bounds
        points.append(rng.uniform((x0, y0), (x1, y1), (6, 2)))
        points.append(shapely.get_coordinates(shape.representative_point()))
    points = np.concatenate(points)
    expected = [
        {number for number, shape in shapes.items() if shape.contains(shapely.Point(point))}
        for point in points
    ]
    assert polygons_at(world_map.grid, points) == expected
    assert set().union(*expected) == set(shapes)


def test_batch_stacks_common_buckets(built: list[tuple[Scenario, ScenarioInfo]]):
    scenarios = [scenario for scenario, _ in built]
    stacked = batch(scenarios, SMALL)
    largest = {
        axis: max(sizes_of(scenario)[axis] for scenario in scenarios)
        for axis in sizes_of(scenarios[0])
    }
    shapes = {}
    for path, leaf in leaves_of(stacked).items():
        assert isinstance(leaf, np.ndarray) and leaf.shape[0] == 3, path
        assert leaf.dtype == np.dtype(LEAVES[path].dtype)
        shapes |= dict(zip(LEAVES[path].axes, leaf.shape[1:], strict=True))
    for field in dataclasses.fields(PaddingConfig):
        expected = bucket(largest[field.name], getattr(SMALL, field.name))
        assert shapes[field.name] == expected, field.name
    areas = shapes["lanes"] + shapes["car_parks"] + shapes["intersections"]
    assert shapes["grid_words"] == -(-areas // 32)
    for i, scenario in enumerate(scenarios):
        alone = batch([scenario], SMALL)
        assert stacked.origin[i].tolist() == alone.origin[0].tolist() == scenario.origin.tolist()
        length = len(scenario.time)
        np.testing.assert_array_equal(stacked.time[i, :length], scenario.time)
        assert stacked.tracks.valid[i].sum() == scenario.tracks.valid.sum()


def test_overflow_is_an_error_that_says_what_to_do(
    built: list[tuple[Scenario, ScenarioInfo]],
):
    scenarios = [scenario for scenario, _ in built]
    config = dataclasses.replace(SMALL, tracks=(1, 2))
    text = (
        "scene {}: 3 tracks, largest bucket 2. Raise PaddingConfig.tracks or leave the scene out. "
        "Nothing was truncated."
    )
    with pytest.raises(ValueError) as plain:
        batch(scenarios, config)
    assert str(plain.value) == text.format("#0")
    with pytest.raises(ValueError) as named:
        batch(scenarios[1:], config, tokens=["one", "two"])
    assert str(named.value) == text.format("two")
    with pytest.raises(ValueError, match="no scenarios"):
        batch([], SMALL)


def test_sizes_must_hold_the_scenario(built: list[tuple[Scenario, ScenarioInfo]]):
    scenario, _ = built[0]
    sizes = sizes_of(scenario)
    with pytest.raises(ValueError, match="3 tracks, sizes says 2; nothing was truncated"):
        pad_scenario(scenario, sizes | {"tracks": 2})
    del sizes["slots"]
    with pytest.raises(ValueError, match="sizes lacks axis slots"):
        pad_scenario(scenario, sizes)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_device_arrays_have_the_type_asked_for(
    built: list[tuple[Scenario, ScenarioInfo]], dtype: type
):
    host = batch([built[0][0]], SMALL)
    device = to_device(host, dtype)
    assert isinstance(device.origin, np.ndarray) and device.origin is host.origin
    for path, leaf in leaves_of(device).items():
        source = leaves_of(host)[path]
        if path == "origin":
            continue
        assert isinstance(leaf, jax.Array), path
        floating = np.issubdtype(source.dtype, np.floating)
        assert leaf.dtype == (dtype if floating else source.dtype), path
        np.testing.assert_array_equal(leaf, source.astype(leaf.dtype))
    np.testing.assert_allclose(device.time, host.time, atol=1e-5)


def test_device_type_must_be_usable(built: list[tuple[Scenario, ScenarioInfo]]):
    with pytest.raises(ValueError, match="dtype is int32; pass a floating type"):
        to_device(built[0][0], jnp.int32)
    with jax.enable_x64(False), pytest.raises(ValueError, match="64-bit types are off"):
        to_device(built[0][0], jnp.float64)
