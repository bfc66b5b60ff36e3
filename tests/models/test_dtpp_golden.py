"""DTPP against stored runs of its public code; `python -m tests.parity` compares all of them."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_models import dtpp
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_tree import TreeConfig, expand
from spdm_models.lattice import Course
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures
from spdm_models.state_dict import from_state_dict

CONFIG = DTPPConfig(EncoderConfig(width=32))


@pytest.fixture
def folder(shared: Path) -> Path:
    path = shared / "golden" / "models" / "dtpp"
    if not path.is_dir():
        pytest.skip("reference data not at hand")
    return path


@jax.jit
def score(params, features, branches):
    encoding = dtpp.encode(params, CONFIG, features)
    return dtpp.decode(params, CONFIG, encoding, features, branches, 80).scoring.scores


def test_scores_in_float64(folder: Path):
    with np.load(folder / "small_constantcost_seed0_params.npz") as state:
        params = from_state_dict(
            dict(state), dtpp.abstract(CONFIG), dtpp.extras(CONFIG), dtype=np.float64
        )
    data = np.load(folder / "small_constantcost_seed0.npz")
    given = lambda name: jnp.asarray(data[f"in/{name}"][:1], jnp.float64)
    features = SceneFeatures(
        ego_past=given("ego_agent_past"),
        neighbors_past=given("neighbor_agents_past"),
        lanes=given("map_lanes"),
        crosswalks=given("map_crosswalks"),
        route_lanes=given("route_lanes"),
    )
    ours = np.asarray(score(params, features, given("second_stage_ego_trajectory")))
    real = np.arange(30) < data["in/n_second"][0]
    reference = data["f64/b1_0/second/scores"]
    np.testing.assert_allclose(ours[:, real], reference[:, real], atol=1e-9)
    np.testing.assert_array_equal(np.isneginf(ours[0]), ~real)


def test_expansion_in_float32(folder: Path):
    data = np.load(folder / "tree_seed0.npz")
    rows = np.stack([data[f"paths/ref{i}"] for i in range(3)]).astype(np.float32)
    columns = (jnp.asarray(rows[..., i]) for i in range(4))
    courses = Course(*columns, count=jnp.full(3, rows.shape[1], jnp.int32))
    grow = jax.jit(expand, static_argnums=(4, 5))
    for key in ("expand0", "expand1", "expand5"):
        root = bool(data[f"{key}/is_root"])
        start, limit = jnp.asarray(data[f"{key}/x0"]), jnp.float32(13)
        states, kept = grow(start, courses, jnp.ones(3, bool), limit, root, TreeConfig())
        ours = np.asarray(states)[np.asarray(kept)]
        reference = data[f"{key}/trajs"][..., :6]
        assert ours.shape == reference.shape
        # Rounding may put a state on the next row of its path, 0.1 m away.
        same = np.all(np.abs(ours[..., :2] - reference[..., :2]) < 1e-3, axis=-1)
        assert np.mean(same) > 0.99
        np.testing.assert_allclose(ours[same], reference[same], atol=1e-5)
