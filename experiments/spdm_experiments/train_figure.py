"""The picture of a training: its loss by step, and what was measured on held-out scenarios."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from spdm_jax.io.scenario_file import write_atomically

_SIZE = (10.0, 4.0)  # inches
_DPI = 110
_SMOOTHED = 0.02  # share of the steps that a mean runs over


def write_figure(path: Path, log: Any) -> None:
    """Draws losses on the left, metrics on the right.

    Args:
      path: PNG file to write.
      log: `spdm_models.train_state.Log`.

    Raises:
      ModuleNotFoundError: Matplotlib is not installed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    steps = len(log.losses)
    window = max(1, round(_SMOOTHED * steps))
    kernel = np.ones(window) / window
    x = np.arange(window, steps + 1)
    for i, name in enumerate(log.columns):
        # Parts that a stage of the training does not have are zero.
        values = np.where(log.losses[:, i] != 0, log.losses[:, i], np.nan)
        smooth = np.convolve(values, kernel, mode="valid") if steps else values
        if name != "gradient" and np.any(np.isfinite(smooth)):
            left.plot(x, smooth, linewidth=2.0 if i == 0 else 1.0, label=name)
    # A likelihood may be negative.
    scale = "log" if np.all(log.losses[:, :1] > 0) else "symlog"
    left.set(
        xlabel="step",
        ylabel="loss" if window == 1 else f"loss, mean of {window} steps",
        yscale=scale,
    )
    for i, name in enumerate(log.metrics[1:], 1):
        right.plot(log.validation[:, 0], log.validation[:, i], marker=".", label=name)
    right.set(xlabel="step", ylabel="held-out scenarios, m")
    right.set_ylim(bottom=0)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    write_atomically(path, buffer.getvalue())
