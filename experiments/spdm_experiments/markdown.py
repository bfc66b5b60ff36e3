"""Pieces of Markdown pages that commands write: tables, and the part that people wrote."""

from collections.abc import Sequence
from pathlib import Path


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Returns a table, its last line ended."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def kept_part(page: Path, heading: str) -> str:
    """Returns what a page has from a heading on; the heading alone if it has not got it."""
    if page.is_file() and heading in (before := page.read_text(encoding="utf-8")):
        return before[before.index(heading) :]
    return f"{heading}\n"
