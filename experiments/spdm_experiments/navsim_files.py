"""Frames for NAVSIM's profiles: exported ones, or scenario files to make them of."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spdm_experiments.inventory import Entry, Inventory, take_inventory
from spdm_jax import Failure, NavsimSet, load, load_navsim, to_navsim
from spdm_jax.batching import Precision
from spdm_jax.io.raw import ScenarioError
from spdm_jax.navsim.frames import lack
from spdm_jax.navsim.reader import describe_export, is_export
from spdm_jax.padding import AXES, PaddingConfig, bucket
from spdm_jax.scoring.profile import Profile

FOREIGN = ("tracker", "forecast", "progress_reference")
"""Options that do not apply: the profiles say how."""


def refuse_foreign(options: object) -> None:
    """Refuses options that a NAVSIM profile would silently ignore.

    Raises:
      ValueError: names the first one that was given.
    """
    for name in FOREIGN:
        if getattr(options, name) != getattr(type(options), name):
            raise ValueError(
                f"--{name.replace('_', '-')} does not apply to NAVSIM's profiles: they replay the "
                "log and track with the reference's tracker. Leave it out"
            )


def refuse_frames(source: Path, files: Sequence[Path]) -> None:
    """Refuses exported frames where only scenarios will do.

    Raises:
      ValueError: the first file is one.
    """
    if is_export(files[0]):
        raise ValueError(
            f"{source}: holds frames exported from NAVSIM, which have no scenario; score and label "
            "take them with --profile navsim1 or navsim2"
        )


def frame_inventory(files: Sequence[Path], profile: Profile) -> Inventory:
    """Looks through files without making frames of them.

    Args:
      files: all exported frames, or all scenario files.
      profile: that they are to serve; exported frames that do not are failures.

    Raises:
      ScenarioError: two files hold the same frame, or none can be used.
    """
    if not any(is_export(path) for path in files):
        inventory = take_inventory(files)
    else:
        entries: dict[str, Entry] = {}
        failures, digest = [], hashlib.sha256()
        for path in files:
            digest.update(path.name.encode() + b"\0")
            try:
                info = describe_export(path)
                digest.update(hashlib.sha256(path.read_bytes()).digest())
            except (ScenarioError, OSError) as error:
                failures.append(Failure(path.stem, str(error)))
                continue
            if profile.name not in info.profiles:
                failures.append(Failure(info.token, lack(info, profile)))
                continue
            if info.token in entries:
                other = entries[info.token].path
                raise ScenarioError(f"{path}: holds frame {info.token!r}, and so does {other}")
            entries[info.token] = _entry(path, info.token, info.log_name, info.source)
        inventory = Inventory(list(entries.values()), failures, digest.hexdigest())
    if not inventory.entries:
        raise ScenarioError(f"{files[0]}: no usable frame: {inventory.failures[0].reason}")
    return inventory


def _entry(path: Path, token: str, log_name: str, source: str) -> Entry:
    return Entry(
        path=path,
        token=token,
        log_name=log_name,
        map_name="",
        scenario_type="",
        source=source,
        sizes={},
        route_points=0,
        lane_points=0,
        num_iterations=1,
    )


def common_padding(entries: Sequence[Entry]) -> PaddingConfig | None:
    """Returns one size per axis that holds all scenarios, so that one program plans them all.

    Exported frames have no such sizes: None.
    """
    if not entries[0].sizes:
        return None
    largest = {axis: max(entry.sizes[axis] for entry in entries) for axis in AXES}
    rooms = PaddingConfig()
    return PaddingConfig(
        **{axis: (bucket(size, getattr(rooms, axis)),) for axis, size in largest.items()}
    )


def load_frames(
    entries: Sequence[Entry],
    profile: Profile,
    precision: Precision,
    padding: PaddingConfig | None,
) -> NavsimSet:
    """Makes frames of files; one that cannot be used is a failure, not an error.

    Args:
      entries: files.
      profile: that they are to serve.
      precision: of PDM-Closed, where the files are scenarios.
      padding: of scenarios, see `common_padding`.
    """
    paths = [entry.path for entry in entries]
    try:
        if entries[0].source.startswith("NAVSIM"):
            found = load_navsim(paths)
        else:
            found = to_navsim(load(paths, padding=padding), precision=precision)
    except ValueError as error:  # none of them: each has its own reason
        if len(entries) == 1:
            return NavsimSet([], [], [Failure(entries[0].token, str(error))])
        alone = [load_frames([entry], profile, precision, padding) for entry in entries]
        return NavsimSet([], [], [failure for part in alone for failure in part.failures])
    # Failures know the file's name only.
    tokens = {entry.path.stem: entry.token for entry in entries}
    found.failures[:] = [Failure(tokens.get(f.token, f.token), f.reason) for f in found.failures]
    return found.serving(profile)


def read_previous(path: Path, tokens: Sequence[str]) -> dict[str, np.ndarray]:
    """Reads plans of the frame before.

    Args:
      path: .npz with "tokens" and "trajectories".
      tokens: of the frames that are scored.

    Returns:
      Token -> `[P, 8, 3]`, of those frames that the file names.

    Raises:
      ValueError: the file holds no such plans, or none of these frames.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            names, plans = content["tokens"].tolist(), content["trajectories"].astype(np.float64)
    except (ValueError, KeyError, EOFError, TypeError) as error:
        raise ValueError(
            f'{path}: no .npz file of "tokens" and "trajectories" ({error})'
        ) from error
    plans = plans[:, None] if plans.ndim == 3 else plans
    if plans.ndim != 4 or plans.shape[2:] != (8, 3) or len(names) != len(plans):
        raise ValueError(
            f"{path}: {len(names)} tokens, trajectories of shape {plans.shape}; expected "
            "[S, 8, 3] or [S, P, 8, 3], one set per token"
        )
    if not np.isfinite(plans).all():
        row = int(np.argwhere(~np.isfinite(plans))[0, 0])
        raise ValueError(f"{path}: trajectories[{row}] has values that are not finite")
    found = {name: plan for name, plan in zip(names, plans, strict=True) if name in set(tokens)}
    if not found:
        raise ValueError(f"{path}: holds a plan for none of the {len(tokens)} frames")
    return found
