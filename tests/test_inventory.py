"""Scenario files of a sweep: what is known of them unread, and how chunks of them are loaded."""

import dataclasses
import shutil
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest

import sweep_pack as packs
from spdm_experiments.inventory import Shard, split, take_inventory
from spdm_experiments.loading import Loader
from spdm_experiments.sweep_scene import UNREAD, Shared, Switches, read_scene
from spdm_jax import load, spdm
from spdm_jax.batching import group_by_shape
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.padding import PaddingConfig, batch, sizes_of
from spdm_jax.schema import leaves_of

COUNT = 7
TOKENS = [f"scene-{i:02d}" for i in range(COUNT)]


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert packs.write_pack(folder, COUNT) == TOKENS
    return folder


def take_inventory_of(folder: Path):
    return take_inventory(sorted(folder.glob("*.npz"))).entries


def test_inventory_knows_the_files_without_reading_them(pack: Path):
    found = take_inventory(sorted(pack.glob("*.npz")))
    assert [entry.token for entry in found.entries] == TOKENS
    scenario, info = read_scenario(found.entries[0].path)
    sizes = sizes_of(scenario)
    assert {**found.entries[0].sizes, "grid_words": sizes["grid_words"]} == sizes
    assert found.entries[0].scenario_type == info.scenario_type
    count = np.append(scenario.map.lanes.centerline.count, 0)
    longest = max(count[s].sum(axis=1).max() for s in (scenario.route.goal_lanes,))
    assert found.entries[0].route_points >= longest > 0


def test_inventory_digest_goes_by_names_and_contents(pack: Path, tmp_path: Path):
    digest = lambda folder: take_inventory(sorted(folder.glob("*.npz"))).digest
    copy = tmp_path / "copy"
    shutil.copytree(pack, copy)
    assert digest(copy) == digest(pack)
    packs.write_pack(tmp_path / "other", 1, slow=1)
    shutil.copy(tmp_path / "other" / "scene-00.npz", copy / "scene-00.npz")
    assert digest(copy) != digest(pack)


def test_inventory_lists_what_cannot_be_used(pack: Path, tmp_path: Path):
    shutil.copytree(pack, tmp_path / "copy")
    content = (pack / "scene-00.npz").read_bytes()
    (tmp_path / "copy" / "scene-00.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "copy" / "scene-01.npz").write_bytes(b"")
    files = sorted((tmp_path / "copy").glob("*.npz"))
    found = take_inventory(files)
    assert [f.token for f in found.failures] == TOKENS[:2]
    assert all("damaged scenario file" in f.reason for f in found.failures)
    tight = PaddingConfig(lanes=(1,))
    assert "1 lanes" not in take_inventory(files, tight).failures[2].reason
    assert "largest bucket is 1" in take_inventory(files, tight).failures[2].reason
    shutil.copy(pack / "scene-02.npz", tmp_path / "copy" / "again.npz")
    with pytest.raises(ScenarioError, match="and so does"):
        take_inventory(sorted((tmp_path / "copy").glob("*.npz")))


def test_loading_pads_as_a_batch_does(pack: Path):
    entries = take_inventory_of(pack)
    (group,) = group_by_shape([entry.sizes for entry in entries])
    loaded = Loader().load(entries, group.padding)
    assert loaded.batch is not None and not loaded.failures
    scenarios, infos = zip(*(read_scenario(entry.path) for entry in entries), strict=True)
    whole = leaves_of(batch(scenarios, group.padding))
    for path, leaf in leaves_of(loaded.batch).items():
        np.testing.assert_array_equal(leaf, whole[path], err_msg=path)
        assert leaf.dtype == whole[path].dtype
    assert loaded.track_ids == [info.track_ids for info in infos]
    part = Loader(unread=UNREAD, dtype=np.float32).load(entries, group.padding)
    assert part.batch is not None
    for path, leaf in leaves_of(part.batch).items():
        assert leaf.shape == whole[path].shape
        if path.startswith(UNREAD):
            assert not leaf.any()
        else:
            np.testing.assert_array_equal(leaf, whole[path].astype(leaf.dtype), err_msg=path)


def test_the_planner_does_not_read_what_loading_leaves_out(pack: Path):
    """A layer that some rule starts to read must leave `UNREAD`, or it would see zeros."""
    scenes = load(pack, limit=1)
    planner = spdm(20)
    static = Switches(dataclasses.replace(planner.config, forecast="perfect"))
    shape = lambda v: jax.ShapeDtypeStruct(np.shape(v), np.asarray(v).dtype)
    scene = jax.tree.map(lambda leaf: shape(leaf[0]), scenes.batch)
    counts = np.array([15, 20], np.int32)
    shared = Shared(params=planner.params, num_proposals=counts, by_goal=counts > 15)
    traced = jax.make_jaxpr(lambda *args: read_scene(args[0], None, args[1], static))(
        scene, jax.tree.map(shape, shared)
    )
    read = {id(v) for equation in traced.jaxpr.eqns for v in equation.invars}
    names = list(leaves_of(scene))
    used = [n for n, v in zip(names, traced.jaxpr.invars, strict=False) if id(v) in read]
    assert "map.lanes.centerline.points" in used
    assert not [name for name in used if name.startswith(UNREAD)]


def test_file_with_a_wrong_byte_fails_alone(pack: Path, tmp_path: Path):
    shutil.copytree(pack, tmp_path / "copy")
    entries = take_inventory_of(tmp_path / "copy")
    content = bytearray(entries[1].path.read_bytes())
    with zipfile.ZipFile(entries[1].path) as archive:
        member = archive.getinfo("map.grid.edges.npy")
    content[member.header_offset + member.compress_size // 2] ^= 255
    entries[1].path.write_bytes(content)
    (group,) = group_by_shape([entry.sizes for entry in entries])
    loaded = Loader().load(entries, group.padding)
    assert [entry.token for entry in loaded.entries] == [TOKENS[0], *TOKENS[2:]]
    ((failure, entry),) = loaded.failures
    assert entry is entries[1] and "scene-01" in failure.reason


def test_shards_divide_the_tokens():
    tokens = [f"token-{i}" for i in range(300)]
    shards = [Shard.parse(f"{i}/3") for i in (1, 2, 3)]
    counts = [sum(shard.holds(token) for token in tokens) for shard in shards]
    assert sum(counts) == 300 and min(counts) > 60
    for text in ("0/3", "4/3", "1", "a/b", "1/0"):
        with pytest.raises(ValueError, match="write I/N"):
            Shard.parse(text)


@pytest.mark.parametrize("count, size, expected", [(5, 2, [2, 2, 1]), (4, 4, [4]), (0, 3, [])])
def test_split(count: int, size: int, expected: list[int]):
    parts = split(count, size)
    assert [len(part) for part in parts] == expected
    assert [i for part in parts for i in part] == list(range(count))
