"""Reads the trajectories that `spdm score` is given."""

from pathlib import Path

import numpy as np

from spdm_experiments.chunks import Survey
from spdm_jax.trajectories import check_trajectories, resample


def stored_shape(path: Path) -> tuple[int, ...]:
    """Returns the shape of a file's trajectories, () where `read_trajectories` will refuse it."""
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content.shape
        with content:
            return content["trajectories"].shape
    except (ValueError, EOFError, KeyError):
        return ()


def read_trajectories(path: Path, dt: float, found: Survey) -> np.ndarray:
    """Reads a trajectory file and brings it to the order of the scenarios.

    Args:
      path: .npy or .npz, see the help of `spdm score`.
      dt: spacing of the poses, s.
      found: the scenarios.

    Returns:
      `[P, T, 3]` for all scenarios, or `[S, P, T, 3]` in the order of `found.paths`.

    Raises:
      ValueError: the file is no such array, or does not fit the scenarios.
    """
    try:
        content = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: not a .npy or .npz file of plain arrays ({error})") from error
    tokens: np.ndarray | None = None
    if isinstance(content, np.ndarray):
        values = content
    else:
        with content:
            if "trajectories" not in content.files:
                raise ValueError(
                    f"{path}: holds {', '.join(content.files) or 'nothing'}; name the poses "
                    '"trajectories"'
                )
            values = content["trajectories"]
            tokens = content["tokens"] if "tokens" in content.files else None
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise ValueError(f"{path}: trajectories are of type {values.dtype}; pass real numbers")
    if values.ndim == 3:
        if tokens is not None:
            raise ValueError(
                f"{path}: tokens with trajectories of shape {values.shape}; one set per token is "
                "[S, P, T, 3], one set for all scenarios goes without tokens"
            )
    elif values.ndim == 4:
        values = values[_order(path, values.shape[0], tokens, found)]
    try:
        checked = check_trajectories(values.astype(np.float64), dt, len(found.paths))
        resample(checked[:1, :1], dt)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return values


def _order(path: Path, count: int, tokens: np.ndarray | None, found: Survey) -> list[int]:
    """Returns the row of each scenario."""
    if tokens is None:
        if count != found.num_files:
            raise ValueError(
                f"{path}: trajectories of {count} scenarios, but there are {found.num_files} "
                'scenario files. Take as many with --limit, or store "tokens" beside them.'
            )
        return found.places
    if tokens.shape != (count,):
        raise ValueError(f"{path}: tokens has shape {tokens.shape} for {count} sets")
    row = {str(token): i for i, token in enumerate(tokens)}
    if missing := [token for token in found.tokens if token not in row]:
        raise ValueError(
            f"{path}: no trajectories for scenario {missing[0]!r} ({len(missing)} are missing)"
        )
    return [row[token] for token in found.tokens]
