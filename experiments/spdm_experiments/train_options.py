"""Command-line options of `spdm train`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from spdm_experiments.options import OnDevice


@dataclass(frozen=True, kw_only=True)
class Train(OnDevice):
    """Train a learned planner on recorded or generated scenarios.

    Samples are computed once from several start times of each scenario. The same command goes on
    where an interrupted one stopped, also after a kill. OUT/weights.safetensors appears at the end.
    """

    model: Annotated[
        Positional[Literal["gameformer", "gameformer-0", "gameformer-dipp", "dtpp", "dipp"]],
        arg(metavar="MODEL"),
    ]
    """gameformer, gameformer-0 (without interaction levels), gameformer-dipp (DIPP's planner behind
    GameFormer), dtpp or dipp."""
    scenes: Annotated[Positional[tuple[str, ...]], arg(metavar="SCENES")]
    """Folders of scenario files (see spdm pack) or files; a suite's name (common-14, interactive-8)
    stands for further scenes of its kind, none of those that spdm simulate drives."""
    size: Literal["small", "full"] = "full"
    """full: the published sizes; small: a fifth of the widths."""
    modes: int = 6
    """Futures per agent of GameFormer (the paper's proposals need 15)."""
    out: Path = Path("out/train")
    """Folder to write or to go on with."""
    steps: int | None = None
    """Training steps; the published number of epochs if left out. The learning rate's schedule is
    spread over them."""
    batch: int | None = None
    """Samples of a step; the published number if left out."""
    rate: float | None = None
    """Learning rate at the beginning; the published one if left out."""
    seed: int = 0
    """Of the weights, the order of the samples and dropout."""
    every: int = 200
    """Steps between two checkpoints: what a kill can cost."""
    precision: Literal["f32", "bf16"] = "f32"
    """Of matrix products; bf16 has an effect on GPUs only and needs --size full. Weights are
    float32."""
    dropout: bool = True
    """Dropout during training."""
    stride: float = 1.0
    """Seconds between the start times of a scenario."""
    held_out: float = 0.1
    """Share of the scenarios that is kept for testing after every epoch."""
    per_type: int = 10
    """Scenes of each type of a suite."""
    limit: int | None = None
    """Take the first so many scenarios of each of SCENES."""
    samples: Path | None = None
    """Keep the samples in this .npz file, or take them from there."""
