"""From a metric cache to the published numbers: export, read, score, compare with NAVSIM's own."""

from pathlib import Path

import numpy as np
import pytest

import spdm_jax
from navsim_stand_in import metric_cache
from spdm_jax.navsim.navsim_export import export, write

SCENES = ("av2_pit57819_105", "in_intersection", "start_in_collision")


@pytest.mark.slow
@pytest.mark.parametrize("devkit", ["v1", "v2"])
def test_scores_of_exported_caches_are_those_of_navsim(shared: Path, tmp_path: Path, devkit: str):
    stored = []
    for name in SCENES:
        path = shared / "golden" / "navsim" / f"scene_{name}.npz"
        if not path.is_file():
            pytest.skip("reference data of NAVSIM not at hand")
        with np.load(path, allow_pickle=False) as file:
            stored.append(dict(file))
        cached = {
            "reference": stored[-1][f"{devkit}_pdm_ref"],
            "obj_pose": stored[-1][f"{devkit}_obj_pose"],
            "obj_valid": stored[-1][f"{devkit}_obj_valid"],
        }
        write(
            tmp_path / f"{name}.npz", export(metric_cache({**stored[-1], **cached}, devkit), name)
        )
    frames = spdm_jax.load_navsim(tmp_path)
    poses, previous = (np.stack([s[key] for s in stored]) for key in ("poses", "prev_poses"))
    if devkit == "v1":
        found = spdm_jax.score(frames, poses, profile="navsim1", precision="f64")
        wanted = np.stack([s["v1_results"] for s in stored])
        np.testing.assert_allclose(found.total, wanted[..., 6], rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.progress, wanted[..., 2], rtol=0, atol=1e-9)
        return
    found = spdm_jax.score(frames, poses, profile="navsim2", previous=previous, precision="f64")
    for column, name in (
        ("v2_epdms", "total"),
        ("v2_epdms_no_ec", "total_without_extended_comfort"),
        ("v2_epdms_unfiltered", "total_unfiltered"),
        ("v2_extended_comfort", "extended_comfort"),
    ):
        wanted = np.stack([s[column] for s in stored])
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=0, atol=1e-9, err_msg=column)
