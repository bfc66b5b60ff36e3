"""Pictures of planned scenes: PNG files."""

import io
from collections.abc import Sequence
from pathlib import Path

from spdm_jax import PlanSet, ScenarioSet
from spdm_jax.io.scenario_file import write_atomically
from spdm_jax.viz import plot_scene

_PANEL = 7.0  # inches
_DPI = 110


def write_png(path: Path, scenes: ScenarioSet, plans: Sequence[PlanSet], index: int) -> Path:
    """Draws one scene, one panel per planner.

    Args:
      path: file to write.
      scenes: scenarios.
      plans: their plans by one planner each.
      index: row of the scene.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # A figure of its own instead of pyplot: no window system, nothing left open.
    figure = Figure(figsize=(_PANEL * len(plans), _PANEL), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(plans), squeeze=False)[0]
    for axes, plan in zip(panels, plans, strict=True):
        plot_scene(scenes, plan, index, axes)
        axes.set_title(f"{scenes.infos[index].token}: {plan.name}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    write_atomically(path, buffer.getvalue())
    return path
