"""`spdm train`: scenarios to samples to weights, in a folder that an interrupted run goes on with.

OUT/run.json            # what is trained on what; every later start is compared with it
OUT/state.safetensors   # the last checkpoint
OUT/losses.parquet      # one row per step (.csv without Polars)
OUT/validation.parquet  # one row per epoch
OUT/losses.png
OUT/weights.safetensors # at the end
"""

import csv
import io
import json
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spdm_experiments.description import describe
from spdm_experiments.runtime import configure_jax, provenance, stop_after
from spdm_experiments.terminal import print_files, reasons
from spdm_experiments.train_options import Train
from spdm_jax.io.scenario_file import write_atomically

RUN = "run.json"
WEIGHTS = "weights.safetensors"
COMPARED = ("command", "model", "size", "network", "fit", "held_out", "stride", "input_hash")
"""Entries of run.json that must be the same for a training to go on."""
NOTED = ("versions", "commit", "device")
"""Entries whose change is only mentioned."""


def run_train(options: Train) -> bool:
    """Trains a model; returns False if a scenario could not be read.

    Raises:
      ValueError: options or scenarios are of no use, the folder holds another training, or the
        loss is no number any more.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    configure_jax(options)
    from spdm_experiments.train_scenes import find_scenes, make_samples
    from spdm_models.train_data import count
    from spdm_models.train_loop import FitConfig, fit
    from spdm_models.train_tasks import make_task
    from spdm_models.weights import save_weights

    for name in ("steps", "batch", "every"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name} is {value}; it must be at least 1")
    if options.precision == "bf16" and options.size == "small":
        # Its heads are 6 wide, for which XLA has no bfloat16 product on GPUs.
        raise ValueError("--precision bf16 needs --size full; leave it out for small networks")
    task = make_task(options.model, options.size, options.modes)
    inventory = find_scenes(options)
    began = time.perf_counter()
    samples = make_samples(inventory, task.sample, options)
    total = count(samples.train)
    tested = 0 if samples.held_out is None else count(samples.held_out)
    print(f"{total} samples to train on, {tested} held out ({time.perf_counter() - began:.1f} s)")
    batch = options.batch or task.recipe.batch
    per_epoch = total // min(batch, total)
    config = FitConfig(
        steps=options.steps or task.recipe.epochs * per_epoch,
        batch=batch,
        seed=options.seed,
        rate=options.rate,
        every=options.every,
        dropout=options.dropout,
        precision=options.precision,
    )
    about = {
        "command": "train",
        "model": options.model,
        "size": options.size,
        "network": asdict(task.config),
        "fit": {name: value for name, value in asdict(config).items() if name != "every"},
        "held_out": options.held_out,
        "stride": options.stride,
        "input_hash": inventory.digest,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    facts = {
        "scenes": list(options.scenes),
        "num_scenarios": len(inventory.entries),
        "samples": {"train": total, "held_out": tested},
        **provenance(),
    }
    for line in describe(options.out / RUN, {**about, **facts}, COMPARED, NOTED):
        print(f"note: {line}", file=sys.stderr)
    started = json.loads((options.out / RUN).read_text(encoding="utf-8"))
    # As JSON has it: tuples become lists.
    about = json.loads(json.dumps(about))
    line = _StepLine(config.steps, per_epoch)
    with stop_after("step", signal.SIGTERM) as stop:
        fitted = fit(
            task,
            samples.train,
            samples.held_out,
            config,
            options.out,
            about,
            progress=line.show,
            stop=stop,
        )
    line.close()
    written = _write_log(options.out, fitted.log)
    if fitted.step < config.steps:
        print_files(written)
        raise KeyboardInterrupt
    training = {
        "task": options.model,
        "size": options.size,
        "steps": config.steps,
        "batch": config.batch,
        "rate": task.recipe.rate if config.rate is None else config.rate,
        "dropout": config.dropout,
        "stride": options.stride,
        "seed": options.seed,
        # Of the first start: the same weights have the same header, whoever went on with them.
        **{name: value for name, value in started.items() if name in facts},
        "validation": _last(fitted.log),
        **task.learnt(fitted.params),
    }
    weights = options.out / WEIGHTS
    save_weights(weights, task.model, task.config, task.network(fitted.params), training)
    print(_summary(fitted.log, per_epoch))
    print_files([weights, *written])
    for title, found in (("without samples", samples.unused), ("failed", samples.failures)):
        if found:
            lines = reasons({one.token: one.reason for one in found}, options.out / RUN)
            number = f"{len(found)} scenario{'s' * (len(found) != 1)}"
            print("\n".join([f"{number} {title}:", *lines]))
    return not samples.failures


def _write_log(folder: Path, log: Any) -> list[Path]:
    steps = np.arange(1, len(log.losses) + 1, dtype=np.float32)[:, None]
    columns = ("step", *log.columns)
    written = [_write_table(folder / "losses", columns, np.hstack([steps, log.losses]))]
    if len(log.validation):
        written.append(_write_table(folder / "validation", log.metrics, log.validation))
    from spdm_experiments.train_figure import write_figure

    figure = folder / "losses.png"
    try:
        write_figure(figure, log)
    except ModuleNotFoundError as error:
        print(f"note: no {figure.name}: {error}", file=sys.stderr)
    else:
        written.append(figure)
    return written


def _write_table(stem: Path, columns: Sequence[str], rows: np.ndarray) -> Path:
    """Writes rows as Parquet, or as text where Polars is not installed."""
    try:
        import polars
    except ModuleNotFoundError:
        path, text = stem.with_suffix(".csv"), io.StringIO()
        csv.writer(text).writerows([columns, *rows.tolist()])
        write_atomically(path, text.getvalue().encode())
        return path
    path, buffer = stem.with_suffix(".parquet"), io.BytesIO()
    table = polars.DataFrame(dict(zip(columns, rows.T, strict=True)))
    table.with_columns(polars.col("step").cast(polars.Int32)).write_parquet(buffer)
    write_atomically(path, buffer.getvalue())
    return path


def _last(log: Any) -> dict[str, float]:
    if not len(log.validation):
        return {}
    return dict(zip(log.metrics, np.round(log.validation[-1], 4).tolist(), strict=True))


def _summary(log: Any, per_epoch: int) -> str:
    if not len(log.losses):
        return "nothing to do"
    text = f"loss {log.losses[:per_epoch, 0].mean():.3f} -> {log.losses[-per_epoch:, 0].mean():.3f}"
    tested = [f"{name} {value:.2f} m" for name, value in _last(log).items() if name != "step"]
    return "; ".join([text, *tested])


class _StepLine:
    """One line on the error stream: step, epoch, loss, rate, time left."""

    def __init__(self, total: int, per_epoch: int):
        self._total, self._per_epoch = total, per_epoch
        self._begin: tuple[int, float] | None = None
        self._shown = 0.0
        self._terminal = sys.stderr.isatty()

    def show(self, done: int, log: Any) -> None:
        """Shows it, where it is time for it; the first call starts the clock."""
        now = time.perf_counter()
        if self._begin is None:
            self._begin = done, now
        if done < self._total and now - self._shown < (0.2 if self._terminal else 10.0):
            return
        self._shown = now
        loss = log.losses[-self._per_epoch :, 0].mean()
        text = f"step {done}/{self._total}  epoch {-(-done // self._per_epoch)}  loss {loss:.3f}"
        tested = [f"{name} {value:.2f}" for name, value in _last(log).items() if name != "step"]
        text = "  ".join([text, *tested])
        before, began = self._begin
        if done > before:
            rate = (done - before) / (now - began)
            left = round((self._total - done) / rate)
            text += f"  {rate:.1f} steps/s  eta {left // 60}:{left % 60:02d}"
        sys.stderr.write(f"\r\x1b[K{text}" if self._terminal else f"{text}\n")
        sys.stderr.flush()

    def close(self) -> None:
        """Leaves the line."""
        if self._terminal:
            sys.stderr.write("\n")
