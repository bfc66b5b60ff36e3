"""Exported frames from disk: what is read, and what a damaged or foreign file is told."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from navsim_stand_in import metric_cache, replay, road_scene
from spdm_jax.io.raw import ScenarioError
from spdm_jax.navsim.navsim_export import export, write
from spdm_jax.navsim.reader import is_export, load_frames, read_frame
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, NAVSIM2_UNFILTERED


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    return export(metric_cache(replay(road_scene(), 41)), "frame")


def stored(folder: Path, arrays: dict[str, np.ndarray], **changes: Any) -> Path:
    """Writes arrays, some of them changed or (None) left out."""
    path = folder / "frame.npz"
    changed = {**arrays, **{name: np.array(v) for name, v in changes.items() if v is not None}}
    write(path, {n: v for n, v in changed.items() if n not in changes or changes[n] is not None})
    return path


def test_frame_is_read_as_it_was_exported(tmp_path: Path, arrays: dict[str, np.ndarray]):
    path = stored(tmp_path, arrays)
    frame, info = read_frame(path)
    assert is_export(path)
    assert (info.token, info.log_name, info.source) == ("frame", "a log", "NAVSIM v2")
    origin = arrays["ego_state"][:2]
    np.testing.assert_array_equal(frame.origin, np.round(origin))
    np.testing.assert_allclose(frame.ego.x + frame.origin[0], origin[0], rtol=0, atol=1e-9)
    assert frame.objects.valid[:3, :9].sum(axis=1).tolist() == [9, 9, 9]
    assert not frame.objects.valid[:, 9:].any()
    assert frame.red.red[0].tolist() == [False] * 4 + [True] * 5 + [False] * 2
    assert bool(frame.has_human) and int(frame.past.count) == 14
    assert bool(frame.previous.present) and int(frame.previous.steps) == 5


def test_profiles_that_a_frame_serves(tmp_path: Path, arrays: dict[str, np.ndarray]):
    found = load_frames(stored(tmp_path, arrays))
    found.require(NAVSIM2)
    found.require(NAVSIM2_UNFILTERED)
    with pytest.raises(ValueError, match=r"frame frame: .*serves navsim2 .*not navsim1.*v1\.1"):
        found.require(NAVSIM1)
    old = export(metric_cache(replay(road_scene(), 51), devkit="v1"), "old")
    found = load_frames(stored(tmp_path, old))
    found.require(NAVSIM1)
    with pytest.raises(ValueError, match=r"frame old: exported with NAVSIM v1.*not navsim2; .*v2"):
        found.require(NAVSIM2)
    assert "1 frames, NAVSIM v1" in repr(found)
    left = found.serving(NAVSIM2)
    assert len(left) == 0 and "not navsim2" in left.failures[0].reason
    assert found.serving(NAVSIM1).tokens == ["old"]


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"version": 7}, r"version 7; this library reads 'navsim-scene', version 1"),
        ({"format": "other"}, "format is 'other'"),
        ({"devkit": "v3"}, "devkit is 'v3'; expected v1 or v2"),
        ({"ego_state": [float("nan")] * 11}, r"ego_state\[0\] is nan"),
        ({"reference": None}, "reference is missing"),
        ({"ego_past": None}, "ego_past is missing"),
        ({"log_red": None}, "log_red is missing"),
        ({"centerline": np.zeros((1, 3))}, "centerline has 1 points"),
        ({"log_pose": np.zeros((11, 3, 3))}, r"log_pose has shape \[11, 3, 3\]; expected 9 frames"),
        ({"map_kind": [0, 1, 1, 2, 9]}, r"map_kind\[4\] is 9"),
        ({"obj_size": np.zeros((3, 2))}, "obj_size of object 0"),
        ({"human_poses": np.zeros((4, 3))}, r"human_poses has shape \[4, 3\]"),
    ],
)
def test_bad_field_is_named_with_file_and_value(
    tmp_path: Path, arrays: dict[str, np.ndarray], changes: dict[str, Any], text: str
):
    path = stored(tmp_path, arrays, **changes)
    with pytest.raises(ScenarioError, match=text) as caught:
        read_frame(path)
    assert str(caught.value).startswith(str(path))


def test_polygon_of_two_points(tmp_path: Path, arrays: dict[str, np.ndarray]):
    offsets = np.array([0, 2, 7, 12, 17, 22])
    points = np.delete(arrays["map_ring_xy"], [2, 3, 4], axis=0)
    path = stored(tmp_path, arrays, map_ring_offsets=offsets, map_ring_xy=points)
    with pytest.raises(ScenarioError, match=r"map_ring_xy gives ring 0 2 corners"):
        read_frame(path)


def test_damaged_files(tmp_path: Path, arrays: dict[str, np.ndarray]):
    path = stored(tmp_path, arrays)
    content = path.read_bytes()
    for cut in (len(content) // 2, len(content) - 30, 10, 0):
        path.write_bytes(content[:cut])
        with pytest.raises(ScenarioError, match=r"frame\.npz: damaged .*export this frame again"):
            read_frame(path)
        assert not is_export(path)
    middle = len(content) // 2
    path.write_bytes(content[:middle] + bytes(64) + content[middle + 64 :])
    with pytest.raises(ScenarioError, match=r"frame\.npz: "):
        read_frame(path)


def test_nothing_is_unpickled(tmp_path: Path, arrays: dict[str, np.ndarray]):
    path = tmp_path / "frame.npz"
    np.savez(path, **{**arrays, "centerline": np.array([{}], object)})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ScenarioError, match="allow_pickle"):
        read_frame(path)


def test_other_files_are_told_apart(tmp_path: Path):
    path = tmp_path / "frame.npz"
    np.savez(path, trajectories=np.zeros(3))
    with pytest.raises(ScenarioError, match=r"no exported frame; .*navsim_export"):
        read_frame(path)
    assert not is_export(path)
    with pytest.raises(ScenarioError, match="no such file"):
        load_frames(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ScenarioError, match=r"no \.npz files"):
        load_frames(tmp_path / "empty")


def test_folder_keeps_what_can_be_used(tmp_path: Path, arrays: dict[str, np.ndarray]):
    write(tmp_path / "b.npz", {**arrays, "token": np.array("b")})
    write(tmp_path / "c.npz", {**arrays, "token": np.array("c")})
    (tmp_path / "a.npz").write_bytes(b"nothing")
    found = load_frames(tmp_path)
    assert found.tokens == ["b", "c"] and found.failures[0].token == "a"
    assert load_frames(tmp_path, tokens=["c", "b"]).tokens == ["c", "b"]
    assert load_frames(tmp_path, limit=2).tokens == ["b"]
    assert found.select([1]).tokens == ["c"]
    with pytest.raises(ScenarioError, match="'d'"):
        load_frames(tmp_path, tokens=["d"])
    write(tmp_path / "d.npz", {**arrays, "token": np.array("b")})
    with pytest.raises(ScenarioError, match=r"d\.npz: holds frame 'b', and so does .*b\.npz"):
        load_frames(tmp_path)
