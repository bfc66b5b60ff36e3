"""The file that says what a folder holds: written once, compared on every later start."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spdm_jax.io.scenario_file import write_atomically

_SHOWN = 60  # characters of a value in an error text


def describe(
    path: Path, about: Mapping[str, Any], compared: Sequence[str], noted: Sequence[str]
) -> list[str]:
    """Writes a description, or checks that the one that is there says the same.

    Args:
      path: JSON file in a folder that exists.
      about: its content.
      compared: entries that must be the same.
      noted: entries whose change is only mentioned.

    Returns:
      What is different without consequence, in words.

    Raises:
      ValueError: the folder holds something else; names entry and both values.
    """
    content = (json.dumps(about, indent=1) + "\n").encode()
    if not path.exists() and _create(path, content):
        return []
    try:
        there = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not readable ({error}); use another --out") from error
    if not isinstance(there, dict):
        raise ValueError(f"{path}: does not describe a run; use another --out")
    ours = json.loads(content)
    for name in compared:
        found = _difference(name, there.get(name), ours.get(name))
        if found:
            where, old, new = found
            raise ValueError(
                f"{path} was made with {where} = {_short(old)}, this command says {_short(new)}. "
                "Use another --out, or the options of that run"
            )
    return [
        f"{name} was {there.get(name)}, is {ours.get(name)} for what is computed from here on"
        for name in noted
        if there.get(name) != ours.get(name)
    ]


def _create(path: Path, content: bytes) -> bool:
    """Writes a file that is not there yet; False if another process was first."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    write_atomically(temporary, content)
    try:
        os.link(temporary, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without hard links
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return True


def _difference(where: str, old: Any, new: Any) -> tuple[str, Any, Any] | None:
    """The first place where two JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in {**old, **new}:
            found = _difference(f"{where}.{name}", old.get(name), new.get(name))
            if found:
                return found
        return None
    numbers = lambda v: isinstance(v, list) and all(isinstance(x, int | float) for x in v)
    if isinstance(old, list) and isinstance(new, list) and not (numbers(old) and numbers(new)):
        if len(old) != len(new):
            return f"number of {where}", len(old), len(new)
        for i, pair in enumerate(zip(old, new, strict=True)):
            found = _difference(f"{where}[{i}]", *pair)
            if found:
                return found
        return None
    return None if old == new else (where, old, new)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
