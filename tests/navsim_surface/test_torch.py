"""NAVSIM's score as a reward: torch tensors in and out."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import spdm_jax
from navsim_stand_in import straight
from spdm_jax import NavsimSet, TorchScorer, torch_score
from spdm_jax.navsim.results import COMPONENTS
from spdm_jax.scoring.profile import NAVSIM2
from spdm_jax.torch_bridge.task import NavsimTask, navsim_poses
from spdm_jax.trajectories import resample, to_local

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

DRIVES = np.concatenate([straight(8.0, 16.0, 0.5), straight(8.0, left=-0.6)])


@pytest.fixture(scope="module")
def tensor() -> Any:
    """`[2, 4, 8, 3]`, other trajectories in every frame."""
    return torch.from_numpy(np.stack([DRIVES, DRIVES[::-1]]).astype(np.float32))


@pytest.fixture(scope="module")
def scorer(frames: NavsimSet) -> TorchScorer:
    return TorchScorer(frames, profile="navsim2", threads=2)


@pytest.fixture(scope="module")
def found(scorer: TorchScorer, tensor: Any) -> dict[str, Any]:
    return scorer(tensor)


def test_equal_to_score(frames: NavsimSet, tensor: Any, found: dict[str, Any]):
    assert tuple(found) == COMPONENTS
    wanted = spdm_jax.score(frames, tensor.numpy(), profile="navsim2")
    for name, values in found.items():
        assert values.dtype == torch.float32 and values.shape == (2, 4)
        np.testing.assert_allclose(values, getattr(wanted, name), rtol=1e-5, atol=1e-4)
    assert len(found["total"].unique()) > 2


def test_tokens_and_components(frames: NavsimSet, tensor: Any, found: dict[str, Any]):
    back = torch_score(frames, tensor.flip(0), ["slow", "fast"], profile="navsim2")
    assert torch.equal(back, found["total"].flip(0))
    some = torch_score(
        frames, tensor, component=("traffic_light", "lane_keeping"), profile="navsim2"
    )
    assert torch.equal(some["traffic_light"], found["traffic_light"])


def test_poses_of_another_interval_and_frame(frames: NavsimSet):
    frame = frames.frames[0]
    ego = jax.tree.map(np.asarray, frame.ego)
    dense = np.zeros((4, 41, 3))
    at = np.linspace(0, 8, 41)
    for row, drive in enumerate(DRIVES):
        nodes = np.concatenate([np.zeros((1, 3)), drive])
        dense[row] = np.stack([np.interp(at, np.arange(9), c) for c in nodes.T], axis=1)
    pose = np.array([[ego.x, ego.y, ego.heading]])
    local = to_local(dense[None], "ego", pose, np.zeros((1, 2)))[0]
    tasks = NavsimTask(NAVSIM2, "ego", 0.1), NavsimTask(NAVSIM2, "local", 0.1)
    for values, task in zip((dense, local), tasks, strict=True):
        got = navsim_poses(jax.numpy.asarray(values), ego, task)
        np.testing.assert_allclose(got, DRIVES, rtol=0, atol=1e-9)
    slow = resample(dense[None], 0.1)[0, :, ::10]
    got = navsim_poses(jax.numpy.asarray(slow), ego, NavsimTask(NAVSIM2, "ego", 1.0))
    np.testing.assert_allclose(got[:, 1::2], DRIVES[:, 1::2], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "options, text",
    [
        ({"profile": "tuplan"}, "the scenes are NAVSIM's frames"),
        ({"profile": "navsim1"}, "frame fast: exported with NAVSIM v2"),
        ({"profile": "navsim2", "tracker": "none"}, "tracker does not apply"),
        ({"profile": "navsim2", "component": "driving"}, "no component 'driving'; there are total"),
        ({"profile": "navsim2", "tokens": ["fast", "x"]}, "scene 'x' is not in the scenario set"),
    ],
)
def test_bad_settings_are_refused(
    frames: NavsimSet, tensor: Any, options: dict[str, Any], text: str
):
    with pytest.raises(ValueError, match=text):
        torch_score(frames, tensor, **options)


def test_bad_tensors_are_refused(scorer: TorchScorer, tensor: Any):
    with pytest.raises(ValueError, match=r"requires a gradient.*detach\(\)"):
        scorer(tensor.clone().requires_grad_())
    with pytest.raises(ValueError, match=r"6 steps at 0\.1 s"):
        scorer(tensor[:, :, :6])
    broken = tensor.clone()
    broken[1, 2, 3, 0] = float("nan")
    with pytest.raises(ValueError, match=r"trajectories\[1, 2, 3, 0\] is nan"):
        scorer(broken)


def test_failed_frame_is_named(exported: Path, tmp_path: Path, tensor: Any):
    for path in exported.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "broken.npz").write_bytes(b"")
    frames = spdm_jax.load_navsim(tmp_path)
    with pytest.raises(ValueError, match=r"scene 'broken' is not in .*failed to load"):
        torch_score(frames, tensor, ["fast", "broken"], profile="navsim2")
