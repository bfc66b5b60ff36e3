"""Frames from arrays: what is refused and how, and what padding and stacking do."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from navsim_frame import ORIGIN, START_US, driving, frame, logged, straight
from spdm_jax.navsim.batch import stack, to_device
from spdm_jax.navsim.build import from_arrays


def changed(**changes: Any) -> dict[str, Any]:
    return {**frame(logged(20.0), red=0), **changes}


def put(name: str, at: Any, value: Any) -> dict[str, Any]:
    arrays = changed()
    values = np.array(arrays[name])
    values[at] = value
    return {**arrays, name: values}


WRONG = {
    "missing": ({k: v for k, v in frame().items() if k != "centerline"}, "centerline is missing"),
    "shape": (changed(ego_state=np.zeros(7)), r"ego_state has shape \[7\]; expected \[11\]"),
    "not finite": (put("reference", (3, 1), np.nan), r"reference\[3, 1\] is nan"),
    "not an integer": (changed(start_time_us=np.array(1.5)), "start_time_us is float64"),
    "negative time": (changed(start_time_us=np.array(-1)), "start_time_us is -1"),
    "one point": (changed(centerline=np.zeros((1, 3))), "centerline has 1 points"),
    "no length": (changed(centerline=np.zeros((5, 3))), "centerline has no length"),
    "vehicle": (put("vehicle_params", 1, 0.0), "vehicle_params is .*all positive"),
    "kind": (put("map_kind", 2, 7), r"map_kind\[2\] is 7; it must be 0 to 4"),
    "nothing drivable": (put("map_kind", slice(None), 1), "map_kind holds no road block"),
    "two corners": (put("map_ring_xy", slice(0, 5), ORIGIN), "ring 0 1 corners"),
    "offsets": (put("map_ring_offsets", -1, 3), "map_ring_offsets must rise from 0 to 25"),
    "ring without object": (put("map_ring_object", 1, 0), "names no ring of map object 1"),
    "far away": (put("map_ring_xy", 7, 0.0), "puts ring 1 .* m from the ego"),
    "type": (put("obj_type", 0, 9), r"obj_type\[0\] is 9"),
    "size": (put("obj_size", (0, 1), 0.0), "obj_size of object 0"),
    "pose": (put("log_pose", (4, 0, 2), np.inf), r"log_pose\[4, 0, 2\] is inf"),
    "flags": (changed(log_valid=np.ones((11, 1))), "log_valid is float64; expected bool"),
    "red": (changed(log_red=np.zeros((2, 11), bool)), r"log_red has shape \[2, 11\]"),
    "past order": (put("ego_past_us", 1, START_US), "ego_past_us is .*rising"),
    "past end": (changed(ego_past_us=np.arange(4)), f"must be start_time_us, {START_US}"),
    "human": (changed(human_poses=np.zeros((7, 3))), r"human_poses has shape \[7, 3\]"),
    "old plan": (
        changed(prev_poses=straight(1.0), prev_start_time_us=np.array(START_US - 700_000)),
        "0.7 s before start_time_us",
    ),
    "unknown plan": (
        changed(prev_poses=straight(1.0), prev_start_time_us=np.array(START_US - 300_000)),
        "ego_past_us must hold that stamp",
    ),
    "plan": (
        changed(prev_poses=np.zeros((3, 3)), prev_start_time_us=np.array(START_US - 500_000)),
        "prev_poses has shape .*3, 3",
    ),
}


@pytest.mark.parametrize("arrays, message", WRONG.values(), ids=WRONG.keys())
def test_bad_arrays_are_named(arrays: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=f"^frame 7: .*{message}"):
        from_arrays(arrays, name="frame 7")


def test_poses_of_frames_without_the_object_do_not_matter():
    gone = logged(20.0, frames=[0, 1])
    gone["pose"][5:] = np.nan
    scene = from_arrays(frame(gone))
    assert np.isfinite(scene.objects.x).all()
    assert scene.objects.valid[0].sum() == 2


def test_frames_are_local_and_padded():
    scene = from_arrays(frame(driving(20.0, 3.0)))
    np.testing.assert_array_equal(scene.origin, ORIGIN)
    assert scene.start_time_us == START_US
    assert abs(scene.ego.x) < 1
    assert scene.objects.x[0, 2] == pytest.approx(23.0)
    assert scene.objects.valid.shape == (16, 11)
    assert scene.objects.valid.sum() == 11
    assert scene.centerline.count == 4
    assert (scene.centerline.x[4:] == scene.centerline.x[3]).all()
    assert not scene.has_human
    assert not scene.previous.present


def test_single_precision_frames_keep_map_coordinates_on_the_host():
    scene = to_device(from_arrays(frame(logged(20.0))))
    floats = [v for v in jax.tree.leaves(scene) if jnp.issubdtype(v.dtype, jnp.floating)]
    assert {v.dtype for v in floats} == {np.dtype("float32"), np.dtype("float64")}
    assert isinstance(scene.origin, np.ndarray)
    assert scene.origin.dtype == np.float64
    assert scene.grid.edges.dtype == jnp.float32
    with pytest.raises(ValueError, match="dtype is int32"):
        to_device(from_arrays(frame()), jnp.int32)


def test_frames_of_different_sizes_stack():
    crowd = from_arrays(frame(*(logged(20.0 + i) for i in range(20))))
    both = stack([from_arrays(frame(red=1)), crowd])
    assert both.objects.x.shape == (2, 32, 11)
    assert both.objects.valid.any(axis=2).sum(axis=1).tolist() == [0, 20]
    assert both.grid.edge_polygon.min() == -1
    assert both.start_time_us.shape == (2,)
    with pytest.raises(ValueError, match="no frames"):
        stack([])
    plans = {"prev_start_time_us": np.array(START_US - 500_000)}
    two = changed(prev_poses=np.stack([straight(1.0)] * 2), **plans)
    with pytest.raises(ValueError, match=r"\[1, 2\] previous plans"):
        stack([crowd, from_arrays(two)])
