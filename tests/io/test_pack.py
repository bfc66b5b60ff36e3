"""Packing: one file per scenario, resumable, and one bad scenario does not stop the rest."""

import dataclasses
import json
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from spdm_jax import __version__
from spdm_jax.io import pack as pack_module
from spdm_jax.io.pack import PackReport, pack
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.synthetic import make_scene
from spdm_jax.types import SCHEMA_VERSION


@pytest.fixture(scope="module")
def scene() -> RawScenario:
    return make_scene("oncoming", 0)


class FakeReader:
    """Offers copies of one scene; tokens that start with `bad` fail in the way they name."""

    def __init__(self, scene: RawScenario, tokens: Sequence[str]):
        self.scene, self.names, self.reads = scene, tokens, []

    def tokens(self) -> Sequence[str]:
        return self.names

    def read(self, token: str) -> RawScenario:
        self.reads.append(token)
        if token == "bad_key":
            raise KeyError("lane 7")
        if token == "bad_file":
            raise OSError("log.db is locked")
        if token == "bad_scenario":
            raise ScenarioError("scenario bad_scenario: route is empty")
        if token == "stop":
            raise KeyboardInterrupt
        scene = dataclasses.replace(self.scene, token=token)
        if token == "bad_ego":
            scene.ego = np.full_like(scene.ego, np.nan)
        if token == "bad_token":
            scene.token = "other"
        return scene


def stored(folder: Path) -> dict:
    return json.loads((folder / "pack.json").read_text())


def test_every_scenario_becomes_a_file(scene: RawScenario, tmp_path: Path):
    calls = []
    reader = FakeReader(scene, ["b", "a", "c-1.x"])
    folder = tmp_path / "new" / "folder"
    report = pack(reader, folder, progress=lambda *call: calls.append(call))
    assert sorted(os.listdir(folder)) == ["a.npz", "b.npz", "c-1.x.npz", "pack.json"]
    assert report == PackReport(
        total=3, written=["b", "a", "c-1.x"], finished=True, sources=[scene.source]
    )
    assert calls == [(1, 3, "b", "written"), (2, 3, "a", "written"), (3, 3, "c-1.x", "written")]
    scenario, info = read_scenario(folder / "a.npz")
    assert info.token == "a" and scenario.num_iterations == scene.num_iterations
    content = stored(folder)
    assert content["counts"] == {"total": 3, "written": 3, "skipped": 0, "failed": 0}
    assert content["schema_version"] == SCHEMA_VERSION
    assert content["library_version"] == __version__
    assert content["sources"] == ["synthetic"]


def test_failures_are_listed_and_the_rest_goes_on(scene: RawScenario, tmp_path: Path):
    bad = ["bad_key", "bad_file", "bad_scenario", "bad_ego", "bad_token", "../up"]
    report = pack(FakeReader(scene, ["a", *bad, "z"]), tmp_path)
    assert report.written == ["a", "z"] and report.finished
    assert list(report.failed) == bad
    assert report.failed["bad_key"] == "KeyError: 'lane 7'"
    assert report.failed["bad_file"] == "OSError: log.db is locked"
    assert report.failed["bad_scenario"] == "scenario bad_scenario: route is empty"
    assert report.failed["bad_ego"].startswith("scenario bad_ego: ego[")
    assert "returned scenario other instead" in report.failed["bad_token"]
    assert "token '../up' cannot name a file" in report.failed["../up"]
    assert stored(tmp_path)["failed"] == report.failed
    assert sorted(os.listdir(tmp_path)) == ["a.npz", "pack.json", "z.npz"]
    assert not (tmp_path.parent / "up.npz").exists()


def test_second_run_only_does_what_is_missing(scene: RawScenario, tmp_path: Path):
    names = ["a", "b", "c", "d", "bad_key"]
    pack(FakeReader(scene, names), tmp_path)
    whole = {name: (tmp_path / f"{name}.npz").read_bytes() for name in names[:4]}
    before = os.stat(tmp_path / "a.npz").st_mtime_ns
    # b is cut off, c of another schema, d another scenario's file.
    (tmp_path / "b.npz").write_bytes(whole["b"][:-100])
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("metadata.json", json.dumps({"schema_version": 0, "info": {}}))
    (tmp_path / "d.npz").write_bytes(whole["a"])
    reader = FakeReader(scene, names)
    report = pack(reader, tmp_path)
    assert report.skipped == ["a"] and report.written == ["b", "c", "d"]
    assert list(report.failed) == ["bad_key"]
    assert reader.reads == ["b", "c", "d", "bad_key"]
    assert os.stat(tmp_path / "a.npz").st_mtime_ns == before
    assert {name: (tmp_path / f"{name}.npz").read_bytes() for name in names[:4]} == whole


def test_overwrite_does_everything(scene: RawScenario, tmp_path: Path):
    pack(FakeReader(scene, ["a"]), tmp_path)
    reader = FakeReader(scene, ["a"])
    assert pack(reader, tmp_path, overwrite=True).written == ["a"]
    assert reader.reads == ["a"]


def test_repeated_tokens_stop_before_any_work(scene: RawScenario, tmp_path: Path):
    reader = FakeReader(scene, ["a", "b", "a"])
    with pytest.raises(ValueError, match="1 tokens occur more than once, first 'a'"):
        pack(reader, tmp_path / "x")
    assert not reader.reads and not (tmp_path / "x").exists()


def test_interrupt_leaves_finished_files_and_a_report(scene: RawScenario, tmp_path: Path):
    with pytest.raises(KeyboardInterrupt):
        pack(FakeReader(scene, ["a", "stop", "b"]), tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a.npz", "pack.json"]
    content = stored(tmp_path)
    assert content["finished"] is False and content["written"] == ["a"]
    assert pack(FakeReader(scene, ["a", "b"]), tmp_path).skipped == ["a"]


def test_interrupt_while_writing_leaves_no_part(
    scene: RawScenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    replace = os.replace

    def interrupt(source: Path, target: Path) -> None:
        if Path(target).name == "b.npz":
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        pack(FakeReader(scene, ["a", "b"]), tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["a.npz", "pack.json"]


def test_full_disk_is_not_blamed_on_the_scenario(
    scene: RawScenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(pack_module, "write_scenario", full)
    with pytest.raises(OSError, match="no space"):
        pack(FakeReader(scene, ["a", "b"]), tmp_path)
    assert stored(tmp_path)["failed"] == {} and not stored(tmp_path)["finished"]


def test_scenarios_of_a_map_share_its_index(
    scene: RawScenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = []
    index = pack_module.MapIndex
    monkeypatch.setattr(pack_module, "MapIndex", lambda m: made.append(m) or index(m))
    pack(FakeReader(scene, ["a", "b", "c"]), tmp_path)
    assert made == [scene.map]


def test_nuplan_logs_are_packed(shared: Path, tmp_path: Path):
    pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
    from spdm_jax.io.nuplan import NuPlanReader, ScenarioFilter

    root = shared / "data" / "nuplan_format" / "pit_adcf7d18"
    tokens = ("6908254371165198", "fbbf816e61003e9b")
    reader = NuPlanReader(root, scenario_filter=ScenarioFilter(scenario_tokens=tokens))
    report = pack(reader, tmp_path)
    assert report.written == list(tokens) and report.sources == ["nuplan"]
    for token in tokens:
        scenario, info = read_scenario(tmp_path / f"{token}.npz")
        raw = reader.read(token)
        assert info.map_name == raw.map.name
        x = scenario.ego.x[raw.ego_valid] + scenario.origin[0]
        np.testing.assert_allclose(x, raw.ego[raw.ego_valid, 0], rtol=1e-15)
        assert scenario.route.start_lane.size and scenario.tracks.valid.any()
