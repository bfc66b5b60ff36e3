"""Pictures of scenes and scored proposals: figures for papers, a player for the browser."""

from spdm_jax.viz.figure import plot_scene
from spdm_jax.viz.html import show, write_html

__all__ = ["plot_scene", "show", "write_html"]
