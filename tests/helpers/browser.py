"""Pages as their readers meet them: as tags and scripts, and alive in headless Chromium."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest


class Page(HTMLParser):
    """Collects the tags, their attributes and the text of scripts.

    Args:
      text: of the page.
      void: tags that are never closed.
    """

    def __init__(self, text: str, void: Sequence[str] = ("meta", "link", "input")):
        super().__init__()
        self.void = void
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.scripts: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.void:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data


def browse(
    folder: Path, file: Path, *arguments: str, width: int = 1400, milliseconds: int = 2000
) -> tuple[str, list[str]]:
    """Opens a page in headless Chromium; returns its output and what its console said.

    Args:
      folder: for the browser's profile.
      file: the page.
      *arguments: what to do with it.
      width: of the window, px.
      milliseconds: that the page believes to have.
    """
    program = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if program is None:
        pytest.skip("no Chromium found")
    run = subprocess.run(
        [
            program,
            *"--headless --no-sandbox --disable-gpu --disable-dev-shm-usage --no-first-run".split(),
            *"--disable-background-networking --disable-component-update --disable-sync".split(),
            "--enable-logging=stderr",
            f"--window-size={width},900",
            f"--virtual-time-budget={milliseconds}",
            f"--user-data-dir={folder / 'profile'}",
            *arguments,
            file.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout, [line for line in run.stderr.splitlines() if "CONSOLE" in line]


def run_scripts(page: Path, script: str) -> Any:
    """Runs the scripts of a page, then one more, without a browser; see `fake_page.js`.

    Args:
      page: HTML file.
      script: body of a function, which sees the page's own names, `nodes` and `drawn`.

    Returns:
      What it returns.
    """
    program = shutil.which("node")
    if program is None:
        pytest.skip("no Node.js found")
    command = [program, str(Path(__file__).with_name("fake_page.js")), str(page), script]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout)
