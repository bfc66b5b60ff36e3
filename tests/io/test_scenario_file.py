"""Scenario files: bit for bit, the same bytes each time, and loud about anything damaged."""

import dataclasses
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from random_world import world
from spdm_jax.io.build import build_scenario
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.scenario_file import is_complete, read_scenario, write_scenario
from spdm_jax.schema import LEAVES, from_leaves, leaves_of
from spdm_jax.types import SCHEMA_VERSION, Scenario, ScenarioInfo


@pytest.fixture(scope="module")
def built() -> tuple[Scenario, ScenarioInfo]:
    return build_scenario(world(1, blocks=2), margin=10.0)


@pytest.fixture(scope="module")
def content(
    built: tuple[Scenario, ScenarioInfo], tmp_path_factory: pytest.TempPathFactory
) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "world1.npz"
    write_scenario(path, *built)
    return path.read_bytes()


@pytest.fixture
def path(content: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "world1.npz"
    path.write_bytes(content)
    return path


def rewrite(path: Path, change: Callable[[dict[str, bytes]], None]) -> None:
    """Lets a change work on the members of a file."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def assert_same(first: Scenario, second: Scenario) -> None:
    for path, one in leaves_of(first).items():
        other = leaves_of(second)[path]
        assert one.dtype == other.dtype and one.shape == other.shape, path
        assert one.tobytes() == other.tobytes(), path


@settings(max_examples=5)
@given(
    seed=st.integers(0, 9999),
    blocks=st.integers(1, 3),
    agents=st.integers(0, 3),
    areas=st.integers(0, 2),
    odd=st.sampled_from([-0.0, np.nan, 5e-324, 1e308, 0.1]),
)
def test_read_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    blocks: int,
    agents: int,
    areas: int,
    odd: float,
):
    raw = world(seed, blocks=blocks, agents=agents, areas=areas)
    scenario, info = build_scenario(raw, margin=10.0)
    limits = np.full_like(scenario.map.lanes.speed_limit, odd)
    scenario = scenario.replace(
        map=scenario.map.replace(lanes=scenario.map.lanes.replace(speed_limit=limits))
    )
    info = dataclasses.replace(info, log_name='log "ü"\n', notes=("a", ""))
    path = tmp_path_factory.mktemp("file") / "x.npz"
    write_scenario(path, scenario, info)
    again, info_again = read_scenario(path)
    assert info_again == info
    assert_same(scenario, again)
    assert [type(leaf) for leaf in leaves_of(again).values()] == [np.ndarray] * len(LEAVES)


def test_same_scenario_gives_same_bytes(
    built: tuple[Scenario, ScenarioInfo], path: Path, monkeypatch: pytest.MonkeyPatch
):
    first = path.read_bytes()
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2033, 5, 18, 3, 33, 20, 2, 138, 0))
    # Memory layout is no part of a scenario either.
    scenario, info = built
    tracks = scenario.tracks.replace(x=np.asfortranarray(scenario.tracks.x))
    write_scenario(path, scenario.replace(tracks=tracks), info)
    assert path.read_bytes() == first


def test_file_is_a_plain_npz(built: tuple[Scenario, ScenarioInfo], path: Path):
    with np.load(path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["map.grid.edges"], built[0].map.grid.edges)
    with zipfile.ZipFile(path) as archive:
        metadata = json.loads(archive.read("metadata.json"))
        assert len(archive.namelist()) == len(LEAVES) + 1
    assert metadata["schema_version"] == SCHEMA_VERSION
    assert metadata["info"]["token"] == "world1"


def test_failed_write_leaves_the_old_file(
    built: tuple[Scenario, ScenarioInfo], path: Path, monkeypatch: pytest.MonkeyPatch
):
    old = path.read_bytes()

    def full(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        write_scenario(path, built[0], dataclasses.replace(built[1], log_name="other"))
    assert path.read_bytes() == old
    assert os.listdir(path.parent) == [path.name]


def test_file_appears_only_when_it_is_whole(
    built: tuple[Scenario, ScenarioInfo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path, seen = tmp_path / "a.npz", []
    replace = os.replace

    def spy(source: Path, target: Path) -> None:
        seen.append((Path(source).parent, path.exists(), zipfile.is_zipfile(source)))
        replace(source, target)

    monkeypatch.setattr(os, "replace", spy)
    write_scenario(path, *built)
    assert seen == [(tmp_path, False, True)]


def test_padded_or_cast_scenario_is_not_written(
    built: tuple[Scenario, ScenarioInfo], tmp_path: Path
):
    scenario, info = built
    path = tmp_path / "a.npz"
    cast = scenario.replace(time=scenario.time.astype(np.float32))
    with pytest.raises(ScenarioError, match="field time: dtype float32, expected float64"):
        write_scenario(path, cast, info)
    longer = scenario.replace(lights=np.zeros((3, 500), np.int8))
    with pytest.raises(ScenarioError, match=r"field lights: shape \(3, 500\), but ego"):
        write_scenario(path, longer, info)
    with pytest.raises(ScenarioError, match=r"info\.track_ids has 0 entries for 3 tracks"):
        write_scenario(path, scenario, dataclasses.replace(info, track_ids=()))
    batched = from_leaves({name: leaf[None] for name, leaf in leaves_of(scenario).items()})
    with pytest.raises(ScenarioError, match=r"field map\.lanes\.valid: shape"):
        write_scenario(path, batched, info)
    assert not path.exists()


def test_missing_file_is_the_systems_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        read_scenario(tmp_path / "absent.npz")
    assert not is_complete(tmp_path / "absent.npz", "absent")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(path: Path, share: float):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ScenarioError, match=r"world1.npz: damaged scenario file .* pack this"):
        read_scenario(path)
    assert not is_complete(path, "world1")


@settings(max_examples=60)
@given(data=st.data())
def test_flipped_bits_are_refused_or_harmless(
    built: tuple[Scenario, ScenarioInfo],
    content: bytes,
    tmp_path_factory: pytest.TempPathFactory,
    data: st.DataObject,
):
    path = tmp_path_factory.getbasetemp() / "flipped.npz"
    # Half of the flips hit the directory at the end, where a zip file is most fragile.
    start = data.draw(st.sampled_from([0, len(content) - 8000]))
    position = data.draw(st.integers(start, len(content) - 1))
    flipped = bytearray(content)
    flipped[position] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(flipped)
    try:
        scenario, info = read_scenario(path)
    except ScenarioError as error:
        assert "flipped.npz" in str(error)
    else:
        assert info == built[1]
        assert_same(scenario, built[0])


def _metadata(**values: object) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        metadata = json.loads(members["metadata.json"])
        metadata.update(values)
        members["metadata.json"] = json.dumps(metadata).encode()

    return change


def _info(name: str, value: object) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        metadata = json.loads(members["metadata.json"])
        metadata["info"][name] = value
        members["metadata.json"] = json.dumps(metadata).encode()

    return change


def _array(name: str, array: np.ndarray) -> Callable[[dict[str, bytes]], None]:
    return lambda members: members.update({f"{name}.npy": npy(array)})


def _drop(name: str) -> Callable[[dict[str, bytes]], None]:
    return lambda members: members.__delitem__(name)


def _shorten(members: dict[str, bytes]) -> None:
    members["time.npy"] = members["time.npy"][:-4]


def _lengthen(members: dict[str, bytes]) -> None:
    members["time.npy"] += b"more"


REFUSED = {
    "newer": (
        _metadata(schema_version=99),
        f"schema_version is 99, this library .* {SCHEMA_VERSION}",
    ),
    "no info": (_metadata(info=None), "info has fields None"),
    "no metadata": (_drop("metadata.json"), "no metadata.json"),
    "bad json": (lambda members: members.update({"metadata.json": b"{"}), "not readable"),
    "missing": (_drop("ego.vx.npy"), r"missing fields \['ego.vx.npy'\], unexpected fields \[\]"),
    "extra": (_array("ego.vz", np.zeros(3)), r"unexpected fields \['ego.vz.npy'\]"),
    "dtype": (_array("ego.vx", np.zeros(3, np.float32)), "field ego.vx: dtype float32, expected"),
    "order": (_array("origin", np.zeros(2, ">f8")), "field origin: dtype >f8, expected float64"),
    "shape": (_array("ego.vx", np.zeros(3)), r"field ego.vx: shape \(3,\), but ego.x has \d+ time"),
    "axes": (_array("origin", np.zeros(3)), r"field origin: shape \(3,\), expected axes \(2,\)"),
    "scalar": (_array("num_history", np.zeros(1, np.int32)), r"field num_history: shape \(1,\)"),
    "objects": (_array("time", np.array([None])), "field time is not a plain array"),
    "pickle": (
        lambda members: members.update({"time.npy": pickle.dumps([1.0])}),
        "field time is not a plain array",
    ),
    "short array": (_shorten, "field time is not a plain array"),
    "long array": (_lengthen, "field time is not a plain array .* bytes after"),
    "ids": (_info("lane_ids", ["a"]), r"info.lane_ids has 1 entries for \d+ lanes"),
    "id type": (_info("lane_ids", [1]), r"info.lane_ids is \[1\]"),
    "token type": (_info("token", 5), "info.token is 5"),
    "time type": (_info("iteration0_time_us", "x"), "info.iteration0_time_us is 'x'"),
    "field": (_info("colour", "x"), "info has fields .*colour"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_layouts_are_refused(path: Path, case: str):
    change, text = REFUSED[case]
    rewrite(path, lambda members: None)
    read_scenario(path)
    rewrite(path, change)
    with pytest.raises(ScenarioError, match=f"world1.npz: .*{text}"):
        read_scenario(path)


def test_completeness_needs_token_and_schema(path: Path):
    assert is_complete(path, "world1")
    assert not is_complete(path, "world2")
    rewrite(path, _metadata(schema_version=0))
    assert not is_complete(path, "world1")
