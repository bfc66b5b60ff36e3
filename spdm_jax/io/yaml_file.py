"""Reads YAML files as their users have them."""

from pathlib import Path
from typing import Any

from spdm_jax.io.raw import ScenarioError


def read_fields(path: Path | str, kind: str, expected: str) -> dict[Any, Any]:
    """Returns the top-level fields of a file; every scalar is text.

    Args:
      path: the file.
      kind: of such files, for the error of a missing package.
      expected: what the file should hold, for the error text.

    Raises:
      ScenarioError: not YAML, or no fields.
      ImportError: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError(f"{kind} files need PyYAML: pip install 'spdm-jax[data]'") from error
    try:
        # The base loader keeps scalars as text: a token of digits only must stay a token.
        with open(path, encoding="utf-8") as file:
            entries = yaml.load(file, Loader=yaml.BaseLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ScenarioError(f"{path}: not a readable YAML file ({error})") from error
    if not isinstance(entries, dict):
        raise ScenarioError(f"{path}: holds no fields; expected {expected}")
    return entries
