"""The report's page: complete, self-contained, and alive in a browser."""

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import browser
import made_up_run as made_up
from browser import Page
from spdm_experiments.report_data import Run, load_run, summarise
from spdm_experiments.report_page import MAX_DOTS, Players, page_data, render
from spdm_experiments.report_terms import TERMS

GRID = made_up.GRID
TOKENS = [f"{kind}-{i}" for i in range(12) for kind in ("curve", "jaywalker")]
TABS = ("summary", "score", "runtime", "compare", "worst", "failures")
EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)><!--"
VOID = ("meta", "link", "input", "br", "img")
PLAYER = "<!doctype html><script>function showScene(i) { document.title = `scene ${i}`; }</script>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def first(folder: Path) -> Run:
    """An unfinished run with failures and times of stages."""
    rows = made_up.scored_rows(GRID, TOKENS)
    rows += made_up.failed_rows(GRID, "broken-0", "damaged scenario file")
    stages = made_up.stage_rows(GRID, TOKENS[:3])
    return load_run(made_up.write_run(folder / "new", rows, stages=stages, num_scenarios=30))


@pytest.fixture(scope="module")
def second(folder: Path) -> Run:
    """A finished run without failures and without times of stages, of most of those scenarios."""
    points = [{**point, "tracker": "corrected"} for point in GRID[1:]]
    rows = made_up.scored_rows(points, TOKENS[:20], seed=4)
    return load_run(made_up.write_run(folder / "old", rows, points=points))


def test_page_is_well_formed_and_needs_nothing_else(first: Run, second: Run):
    page = render([first, second])
    parsed = Page(page, VOID)
    assert parsed.open == [] and len(parsed.scripts) == 4
    # The one address names SVG; nothing is fetched from there.
    rest = page.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"(?m)^\s*//.*$| // .*$", "", rest))
    for tag, attributes in parsed.tags:
        assert "src" not in attributes, tag
        assert attributes.get("href", "data:,") == "data:,", tag
    assert not re.search(r"\b(fetch|XMLHttpRequest|import|innerHTML|eval)\b", page)
    assert "{{" not in page


def test_names_cannot_leave_the_data(folder: Path):
    points = [{**GRID[0], "idm.headway_time": t} for t in (1.0, 2.0)]
    rows = made_up.scored_rows(points, [EVIL, "curve-0"])
    rows += made_up.failed_rows(points, "broken-0", EVIL)
    run = load_run(made_up.write_run(folder / "evil", rows, points=points, suite=EVIL, device=EVIL))
    page = render([run], players=Players(f"<p>{EVIL}", [EVIL], [EVIL]))
    parsed = Page(page, VOID)
    assert len(parsed.scripts) == 4 and "alert" not in "".join(parsed.scripts[2:])
    data = json.loads(parsed.scripts[0])
    assert EVIL in {scene["token"] for scene in data["scenes"]}
    assert ["suite", EVIL] in data["runs"][0]["about"]
    assert json.loads(parsed.scripts[1]) == f"<p>{EVIL}"


def test_page_holds_the_numbers(first: Run, second: Run):
    data = page_data([first, second], worst=4)
    assert len(data["points"]) == 13 and data["runs"][1]["name"] == "old (B)"
    for shown, summary in zip(data["points"], [*summarise(first), *summarise(second)], strict=True):
        assert shown["means"]["total"] == pytest.approx(summary.means["total"], abs=1e-5)
        assert shown["intervals"]["total"] == pytest.approx(summary.intervals["total"], abs=1e-5)
        assert shown["failed"] == summary.failed
    assert [pair["points"] for pair in data["paired"]] == [[i, i + 6] for i in range(1, 7)]
    assert {pair["scenarios"] for pair in data["paired"]} == {20}
    assert [entry["name"] for entry in data["lists"]][:2] == [
        "Largest losses of A against B: SPDM 60",
        "Largest losses of A against B: SPDM 45",
    ]
    assert max(len(entry["rows"]) for entry in data["lists"]) == 4
    assert [entry["total"] for entry in data["failures"]] == [1, 0]
    scene = next(s for s in data["scenes"] if s["token"] == "curve-0")
    assert np.array(scene["values"], float).shape == (13, len(TERMS))


def test_many_scenarios_are_sampled_for_the_scatter(first: Run, monkeypatch: pytest.MonkeyPatch):
    assert len(TOKENS) + 1 < MAX_DOTS
    monkeypatch.setattr("spdm_experiments.report_page.MAX_DOTS", 10)
    data = page_data([first])
    assert len(data["scenes"]) == 10 and data["sampled"] == len(TOKENS) + 1
    assert data["points"][0]["scenarios"] == len(TOKENS)  # the means still see all of them


# ---- in a browser ----

ACTIONS = """<script>
const report = { tabs: {} };
const tabs = [...document.querySelectorAll("#tabs button")];
for (const tab of tabs) {
  tab.click();
  const part = document.getElementById(tab.getAttribute("aria-controls"));
  report.tabs[nameOf(part)] = {
    text: part.innerText, marks: part.querySelectorAll(".mark").length,
    shown: parts.filter((p) => !p.hidden).length,
    wide: document.documentElement.scrollWidth - window.innerWidth,
  };
}
const press = (key) => document.activeElement.dispatchEvent(
  new KeyboardEvent("keydown", { key, bubbles: true }));
tabs[5].focus();
press("ArrowRight");
report.right = location.hash;
press("End");
report.end = document.activeElement.textContent;

const change = (part, at, value) => {
  const list = document.querySelectorAll(`#part-${part} select`)[at];
  list.value = String(value);
  list.dispatchEvent(new Event("change"));
};
showTab("score");
change("score", 0, 1);
report.axisTitle = document.querySelector("#part-score svg").getAttribute("aria-label");
const before = document.querySelectorAll("#part-score .mark").length;
document.querySelector("#part-score .legend input").click();
report.off = before - document.querySelectorAll("#part-score .mark").length;
const mark = document.querySelector("#part-score .mark");
mark.focus();
report.tip = document.getElementById("tip").innerText;

showTab("compare");
change("compare", 0, 0);
change("compare", 1, 6);
report.dots = document.querySelectorAll("#part-compare circle").length;
const words = () => document.querySelector("#part-compare p").textContent;
report.words = words();
showTab("worst");
change("worst", 0, data.lists.length - 1);
const rows = () => [...document.querySelectorAll("#part-worst tbody tr")];
const cells = (k) => rows().map((row) => row.cells[k].textContent);
report.worst = cells(2).map(Number);
const sorter = document.querySelectorAll("#part-worst th button")[2];
sorter.click();
sorter.click();
report.sorted = cells(2).map(Number);
const link = document.querySelector("#part-worst tbody button");
report.token = link?.textContent;
link?.click();
const done = () => {
  report.player = document.querySelector("#player iframe")?.contentDocument.title;
  report.hash = decodeURIComponent(location.hash);
  document.body.append(Object.assign(document.createElement("pre"), {
    id: "report", textContent: JSON.stringify(report),
  }));
};
const view = document.querySelector("#player iframe");
if (view) view.addEventListener("load", () => setTimeout(done)); else done();
</script></body>"""


def browse(folder: Path, page: str) -> tuple[str, list[str]]:
    """Opens a page; returns it afterwards and what its console said."""
    file = folder / "page.html"
    file.write_text(page, encoding="utf-8")
    within = "--allow-file-access-from-files"  # pages within pages
    return browser.browse(folder, file, within, "--dump-dom", width=1300, milliseconds=4000)


def visit(folder: Path, page: str) -> dict[str, Any]:
    """Uses a page; returns what it showed."""
    output, console = browse(folder, page.replace("</body>", ACTIONS))
    assert console == []
    found = re.search(r'<pre id="report">(.*?)</pre>', output, re.DOTALL)
    assert found, output[-500:]
    return json.loads(html.unescape(found[1]))


def test_every_tab_of_one_run(tmp_path: Path, first: Run):
    players = Players(PLAYER, ["jaywalker-3", "curve-5"], ["2 scenes, planned anew."])
    told = visit(tmp_path, render([first], players=players))
    assert tuple(told["tabs"]) == TABS
    text = {name: tab["text"] for name, tab in told["tabs"].items()}
    assert all(tab["shown"] == 1 and tab["wide"] <= 0 for tab in told["tabs"].values())
    assert all(len(words) > 80 for words in text.values()), text
    assert "5 of 30 scenarios are missing" in text["summary"]
    assert "0123456789ab" in text["summary"] and "cpu (cpu)" in text["summary"]
    mean = summarise(first)[6].means["total"]
    assert f"{mean:.4f}" in text["summary"]
    assert "Proposal generation" in text["runtime"] and "Tracking" in text["runtime"]
    assert "broken-0" in text["failures"] and "damaged scenario file" in text["failures"]
    marks = {name: tab["marks"] for name, tab in told["tabs"].items()}
    assert marks["score"] == marks["runtime"] == 7 and marks["compare"] == len(TOKENS)
    # Keyboard and controls.
    assert told["right"] == "#summary" and told["end"] == "Failures"
    assert told["axisTitle"] == "No at-fault collision over Number of proposals N_p"
    assert told["off"] == 2  # PDM-Closed has two points
    assert told["tip"].startswith("SPDM 15\nNo at-fault collision 0.")
    assert told["dots"] == len(TOKENS)
    better = first.usable(6)["total"] - first.usable(0)["total"] > 1e-4
    assert f"SPDM 60 is better in {better.sum()} scenarios" in told["words"]
    assert told["worst"] == sorted(told["worst"])
    assert told["sorted"] == sorted(told["worst"], reverse=True)
    token = told["token"].removeprefix("▶ ")
    assert told["player"] == f"scene {players.tokens.index(token)}"
    assert told["hash"] == f"#worst/{token}"


def test_every_tab_of_two_runs(tmp_path: Path, first: Run, second: Run):
    told = visit(tmp_path, render([first, second]))
    text = {name: tab["text"] for name, tab in told["tabs"].items()}
    assert all(len(words) > 80 for words in text.values()), text
    assert (
        "A minus B" in text["summary"] and "tracker reference (A), corrected (B)" in text["summary"]
    )
    assert "SPDM (B)" in text["score"]
    assert "Largest losses of A against B" in text["worst"]
    assert "without a player" in text["worst"] and "token" not in told
    assert "None: every scenario that was run has scores" in text["failures"]
    assert told["tabs"]["score"]["marks"] == 13


def test_tabs_are_never_blank(tmp_path: Path, folder: Path):
    """A run in which everything failed, without times of stages."""
    rows = made_up.failed_rows(GRID[:1], "a", "damaged") + made_up.failed_rows(GRID[:1], "b", "")
    run = load_run(made_up.write_run(folder / "failed", rows, points=GRID[:1]))
    page = render([run], players=Players(notes=["No player: no scenario has scores."]))
    output, console = browse(tmp_path, page)
    assert console == []
    parts = re.findall(r'<section id="part-(\w+)".*?>(.*?)</section>', output, re.DOTALL)
    text = {name: html.unescape(re.sub("<[^>]*>", " ", body)) for name, body in parts}
    assert tuple(text) == TABS
    assert "No scenario has scores yet." in text["score"]
    assert "No scenario has scores yet." in text["runtime"] and "--stage-times" in text["runtime"]
    assert "No scenario has scores at both grid points." in text["compare"]
    assert "No scenario has scores here." in text["worst"] and "No player" in text["worst"]
    assert "2 scenarios failed" in text["failures"]


def test_single_point_is_drawn(tmp_path: Path, folder: Path):
    rows = made_up.scored_rows(GRID[:1], TOKENS)
    run = load_run(made_up.write_run(folder / "single", rows, points=GRID[:1]))
    output, console = browse(tmp_path, render([run]))
    assert console == [] and "NaN" not in output
    assert len(re.findall(r'class="mark"', output)) >= 2 + len(TOKENS)


def test_scripts_in_names_stay_text(tmp_path: Path, folder: Path):
    rows = made_up.scored_rows(GRID[:1], [EVIL, "curve-0"])
    rows += made_up.failed_rows(GRID[:1], "broken-0", EVIL)
    run = load_run(made_up.write_run(folder / "worse", rows, points=GRID[:1], suite=EVIL))
    output, console = browse(tmp_path, render([run]))
    assert console == []  # a picture that cannot be loaded would be told there
    tags = {tag for tag, _ in Page(output, VOID).tags}
    assert "img" not in tags and "&lt;img src=x" in output


def test_page_fits_a_phone(tmp_path: Path, first: Run, second: Run):
    """Nothing is wider than the screen but what scrolls by itself."""
    (tmp_path / "report.html").write_text(render([first, second]), encoding="utf-8")
    measure = """<iframe src="report.html" style="width:390px;height:800px"></iframe><script>
      const frame = document.querySelector("iframe");
      frame.addEventListener("load", () => {
        const page = frame.contentWindow, wide = {};
        for (const name of %s) {
          page.showTab(name);
          wide[name] = page.document.documentElement.scrollWidth - page.innerWidth;
        }
        document.body.append(Object.assign(document.createElement("pre"), {
          id: "report", textContent: JSON.stringify(wide),
        }));
      });</script></body>"""
    output, console = browse(tmp_path, f"<!doctype html><body>{measure % json.dumps(TABS)}")
    assert console == []
    found = re.search(r'<pre id="report">(.*?)</pre>', output, re.DOTALL)
    assert found and all(over <= 0 for over in json.loads(found[1]).values()), output[-300:]
