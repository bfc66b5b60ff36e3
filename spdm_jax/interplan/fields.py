"""Values of a modification file, as text (YAML's base loader) or as plain Python values."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from spdm_jax.io.raw import ScenarioError


def is_null(value: Any) -> bool:
    """Whether a value stands for nothing."""
    return value is None or value in ("", "null", "~", "Null", "NULL")


def number(value: Any, where: str) -> float:
    """Reads one finite number.

    Raises:
      ScenarioError: it is none; names `where` and the value.
    """
    try:
        result = float(value)
    except (TypeError, ValueError):
        result = math.nan
    if not math.isfinite(result):
        raise ScenarioError(f"{where} is {value!r}; expected a number")
    return result


def numbers(value: Any, size: int, where: str) -> tuple[float, ...]:
    """Reads a list of `size` numbers.

    Raises:
      ScenarioError: the length or an entry is wrong.
    """
    items = entry_list(value, where)
    if len(items) != size:
        raise ScenarioError(f"{where} is {value!r}; expected {size} numbers")
    return tuple(number(item, f"{where}[{i}]") for i, item in enumerate(items))


def boolean(value: Any, where: str) -> bool:
    """Reads true or false.

    Raises:
      ScenarioError: it is neither.
    """
    if str(value).lower() not in ("true", "false"):
        raise ScenarioError(f"{where} is {value!r}; expected true or false")
    return str(value).lower() == "true"


def entry_list(value: Any, where: str) -> Sequence[Any]:
    """Reads a list; null is an empty one.

    Raises:
      ScenarioError: it is something else.
    """
    if is_null(value):
        return []
    if not isinstance(value, list | tuple):
        raise ScenarioError(f"{where} is {value!r}; expected a list")
    return value


def mapping_of(value: Any, where: str) -> Mapping[str, Any]:
    """Reads a mapping; null is an empty one.

    Raises:
      ScenarioError: it is something else.
    """
    if is_null(value):
        return {}
    if not isinstance(value, Mapping):
        raise ScenarioError(f"{where} is {value!r}; expected fields")
    return value


def unknown_fields(entries: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """Refuses fields that nobody reads.

    Raises:
      ScenarioError: there is one; names it and the known ones.
    """
    for key in entries:
        if key not in known:
            raise ScenarioError(f"{where}: field {key!r} is unknown; known are {sorted(known)}")
