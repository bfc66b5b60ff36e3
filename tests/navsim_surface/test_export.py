"""The script that NAVSIM users run: from a metric cache to arrays and back to the same score."""

import ast
import sys
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Polygon

from navsim_stand_in import Loader, metric_cache, replay, road_scene
from spdm_jax.navsim import navsim_export
from spdm_jax.navsim.navsim_export import export, export_all, main

SAME = (
    "start_time_us",
    "ego_state",
    "vehicle_params",
    "map_ring_offsets",
    "map_ring_xy",
    "map_ring_object",
    "map_kind",
    "map_on_route",
    "obj_type",
    "obj_is_agent",
    "obj_size",
    "log_red",
    "red_offsets",
    "red_xy",
    "ego_past",
    "ego_past_us",
    "human_poses",
)


def test_arrays_of_a_cache_are_those_of_the_scene():
    scene = replay(road_scene(), 41)
    found = export(metric_cache(scene), str(scene["token"]))
    assert found.keys() == road_scene().keys()
    for name in ("format", "version", "devkit", "token", "log_name", *SAME):
        np.testing.assert_array_equal(found[name], scene[name], err_msg=name)
    np.testing.assert_allclose(found["centerline"], scene["centerline"], rtol=0, atol=1e-12)
    # A sample may lie a microsecond before the state it is made of, at 8 m/s.
    np.testing.assert_allclose(found["reference"], scene["reference"], rtol=0, atol=1e-5)
    frames, there = slice(0, 41, 5), scene["obj_valid"][:41:5]
    np.testing.assert_array_equal(found["log_valid"], there)
    np.testing.assert_allclose(
        found["log_pose"][there], scene["obj_pose"][frames][there], rtol=0, atol=1e-8
    )
    assert found["log_velocity"][4, 1, 0] == 6.0 and not found["log_velocity"][:, 2].any()


def test_first_version_has_eleven_frames_and_neither_lights_nor_past():
    found = export(metric_cache(replay(road_scene(), 51), devkit="v1"), "a")
    assert str(found["devkit"]) == "v1" and found["log_valid"].shape == (11, 3)
    assert not {"log_red", "ego_past", "human_poses"} & found.keys()


def test_synthetic_scene_has_no_human():
    found = export(metric_cache(replay(road_scene(), 41), human=False), "a")
    assert "human_poses" not in found and "ego_past" in found


def test_headings_of_boxes_all_the_way_round():
    scene = replay(road_scene(), 41)
    headings = np.linspace(-3.1, 3.1, 9)
    scene["obj_pose"][::5, 0, 2] = headings
    found = export(metric_cache(scene), "a")
    np.testing.assert_allclose(found["log_pose"][:, 0, 2], headings, rtol=0, atol=1e-8)


def test_two_layers_may_use_one_identifier():
    cache = metric_cache(replay(road_scene(), 41))
    areas = cache.drivable_area_map
    areas.tokens[4] = areas.tokens[1]
    found = export(cache, "a")
    np.testing.assert_array_equal(found["map_ring_xy"], road_scene()["map_ring_xy"])
    assert not found["map_on_route"][4]


def test_every_token_is_written_once_and_failures_are_told(tmp_path: Path):
    scene = replay(road_scene(), 41)
    broken = metric_cache(scene)
    ring = broken.drivable_area_map._geometries[0]
    inner = np.asarray(ring.exterior.coords).mean(axis=0) + 0.1 * np.eye(3)[:, :2]
    broken.drivable_area_map._geometries[0] = Polygon(ring.exterior.coords, [inner])
    loader = Loader({"good": metric_cache(scene), "bad": broken, "other": metric_cache(scene)})
    told = dict(export_all(loader, tmp_path))
    assert told["good"] == told["other"] == ""
    assert "ROADBLOCK area0 has a hole" in told["bad"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.npz", "other.npz"]
    with np.load(tmp_path / "good.npz", allow_pickle=False) as stored:
        assert set(stored.files) == road_scene().keys()
    assert dict(export_all(loader, tmp_path)).keys() == {"bad"}  # what is there is kept
    assert not list(export_all(loader, tmp_path, "2/3"))  # bad, good, other: the second is there
    with pytest.raises(ValueError, match="4/3"):
        list(export_all(loader, tmp_path, "4/3"))


def test_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    cache = metric_cache(replay(road_scene(), 41))
    devkit = type(sys)("navsim.common.dataloader")
    devkit.MetricCacheLoader = lambda folder: Loader({"a": cache})  # pyright: ignore[reportAttributeAccessIssue]
    for name in ("navsim", "navsim.common"):
        monkeypatch.setitem(sys.modules, name, type(sys)(name))
    monkeypatch.setitem(sys.modules, "navsim.common.dataloader", devkit)
    assert main([str(tmp_path), str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "a.npz").is_file()
    assert "1 scenes written, 0 failed" in capsys.readouterr().out
    cache.observation.unique_objects["track000"].tracked_object_type.name = "TRAIN"
    assert main([str(tmp_path), str(tmp_path / "again")]) == 1
    assert "failed: a: ValueError: object track000 is of the unknown type TRAIN" in (
        capsys.readouterr().err
    )


def test_runs_in_the_environment_of_the_devkit():
    source = Path(navsim_export.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 9))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module))
        elif isinstance(node, ast.Call):
            assert getattr(node.func, "id", "") != "zip" or not node.keywords, "zip(strict=)"
    own = {name for name in names if name.split(".")[0] not in sys.stdlib_module_names}
    assert own == {"numpy", "navsim.common.dataloader"}
