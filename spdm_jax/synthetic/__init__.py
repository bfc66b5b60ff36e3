"""Seeded scenes and suites: roads, traffic and a recorded ego, for tests and benchmarks."""

from spdm_jax.synthetic.generator import SCENES, SyntheticReader, make_scene, scene_names
from spdm_jax.synthetic.suites import SUITES, SuiteReader, suite_names

__all__ = [
    "SCENES",
    "SUITES",
    "SuiteReader",
    "SyntheticReader",
    "make_scene",
    "scene_names",
    "suite_names",
]
