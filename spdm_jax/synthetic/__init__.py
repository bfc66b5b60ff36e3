"""Seeded scenes for tests, examples and benchmarks: roads, traffic and a recorded ego."""

from spdm_jax.synthetic.generator import SCENES, SyntheticReader, make_scene, scene_names

__all__ = ["SCENES", "SyntheticReader", "make_scene", "scene_names"]
