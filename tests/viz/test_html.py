"""The page: complete, self-contained, and alive in a browser."""

import html
import json
import re
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import Page, browse, run_scripts
from spdm_jax import __version__
from spdm_jax.results import PlanSet, ScenarioSet
from spdm_jax.types import ScenarioInfo
from spdm_jax.viz import show, write_html
from spdm_jax.viz.html import page_data, render

BEST, PADDED, NUM = 6, (1, 2), 10  # as in conftest.py
PROVENANCE = {"suite": "synthetic", "device": "CPU", "seed": "7", "commit": "abc123"}


def refuse(word: str) -> None:
    raise AssertionError(f"{word} is not JSON")


def data_of(text: str) -> dict[str, Any]:
    return json.loads(Page(text).scripts[0], parse_constant=refuse)


@pytest.fixture(scope="module")
def page(scenes: ScenarioSet, plans: PlanSet) -> str:
    return render(scenes, plans, provenance=PROVENANCE)


def test_page_is_well_formed_and_needs_nothing_else(page: str):
    parsed = Page(page)
    assert parsed.open == [] and len(parsed.scripts) == 3
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"(?m)^\s*//.*$| // .*$", "", page))
    for tag, attributes in parsed.tags:
        assert "src" not in attributes, tag
        assert attributes.get("href", "data:,") == "data:,", tag
    assert not re.search(r"\b(fetch|XMLHttpRequest|import|innerHTML|eval)\b", page)
    assert "{{" not in page


def test_page_holds_all_scenes_and_only_real_proposals(
    page: str, scenes: ScenarioSet, plans: PlanSet
):
    data = data_of(page)
    real = [r for r in range(NUM) if r not in PADDED]
    assert [s["token"] for s in data["scenes"]] == [i.token for i in scenes.infos]
    (planner,) = data["planners"]
    assert planner["name"] == "Arcs" and len(planner["scenes"]) == len(scenes)
    for index, plan in enumerate(planner["scenes"]):
        assert plan["row"] == real and real[plan["best"]] == BEST
        per_proposal = [*plan["scores"].values()]
        per_proposal += [plan[k] for k in ("states", "moments", "lost", "stage", "path", "speed")]
        assert {len(values) for values in per_proposal} == {len(real)}
        states = np.array(plan["states"]).reshape(len(real), -1, 3)
        assert np.abs(states[..., 0] / 100 - plans.tracked.x[index, real]).max() <= 0.00501
        assert np.abs(states[..., 2] / 1000 - plans.tracked.heading[index, real]).max() <= 0.000501
        assert plan["lost"][3] == list(plans.explain(index, real[3]).lost)
        assert len(plan["forecast"]) == len(data["scenes"][index]["objects"])
        assert all(f is None or len(f) == 63 for f in plan["forecast"])


def test_page_says_where_it_comes_from(page: str):
    about = data_of(page)["about"]
    expected = {
        "version": f"spdm-jax {__version__}",
        "planner": "Arcs",
        **PROVENANCE,
        "scenes": "12",
    }
    assert about == [list(pair) for pair in expected.items()]


def test_numbers_that_are_not_finite_become_null(scenes: ScenarioSet, plans: PlanSet):
    total, x = np.array(plans.scores.total), np.array(plans.tracked.x)
    total[0, 0] = np.nan
    x[0, 0, 5] = np.inf
    broken = replace(
        plans,
        scores=plans.scores.replace(total=total),
        tracked=plans.tracked.replace(x=x),
    )
    plan = data_of(render(scenes, broken))["planners"][0]["scenes"][0]
    assert plan["scores"]["total"][0] is None and plan["states"][0][15] is None
    assert plan["status"] == "failed" and plan["states"][0][16] is not None


def test_names_cannot_leave_the_data(scenes: ScenarioSet, plans: PlanSet):
    evil = "</script><script>alert(1)</script><!--"
    infos: list[ScenarioInfo] = [replace(i, scenario_type=evil) for i in scenes.infos]
    page = render(
        replace(scenes, infos=infos),
        replace(plans, infos=infos, name=evil),
        provenance={evil: evil},
        title=f"{evil} {{{{data}}}}",
    )
    parsed = Page(page)
    assert len(parsed.scripts) == 3 and "alert(1)" not in "".join(parsed.scripts[1:])
    data = data_of(page)
    assert data["scenes"][0]["type"] == data["planners"][0]["name"] == evil
    assert [evil, evil] in data["about"]


def test_planners_of_one_name_are_told_apart(scenes: ScenarioSet, make_plans):
    names = lambda *plans: [p["name"] for p in page_data(scenes, plans)["planners"]]
    few, many, other = make_plans(scenes, 8), make_plans(scenes, 10), make_plans(scenes, 8, "Other")
    assert names(few, many, other) == ["Arcs 8", "Arcs 10", "Other"]
    assert names(few, few) == ["Arcs 8 (1)", "Arcs 8 (2)"]


def test_writing_replaces_at_once_or_not_at_all(
    tmp_path: Path, scenes: ScenarioSet, plans: PlanSet, page: str
):
    path = tmp_path / "scenes.html"
    assert write_html(path, scenes, plans, provenance=PROVENANCE) == path
    assert path.read_text(encoding="utf-8") == page
    with pytest.raises(ValueError, match="plans is empty"):
        write_html(path, scenes, [])
    with pytest.raises(ValueError, match="missing"):
        write_html(path, scenes, replace(plans, infos=scenes.infos[:2]))
    with pytest.raises(ValueError, match="index is 12; the set has 12"):
        write_html(path, scenes, plans, index=12)
    assert path.read_text(encoding="utf-8") == page
    assert [p.name for p in tmp_path.iterdir()] == ["scenes.html"]


def test_show_writes_a_file_outside_notebooks(
    scenes: ScenarioSet, plans: PlanSet, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = show(scenes, plans, 3)
    assert path is not None and tmp_path in path.parents
    assert data_of(path.read_text(encoding="utf-8"))["index"] == 3


def test_show_displays_inline_in_notebooks(
    scenes: ScenarioSet, plans: PlanSet, monkeypatch: pytest.MonkeyPatch
):
    shown: list[str] = []
    shell = types.SimpleNamespace(kernel=object())
    notebook: Any = types.ModuleType("IPython")
    notebook.get_ipython = lambda: shell
    inside: Any = types.ModuleType("IPython.display")
    inside.HTML, inside.display = str, shown.append
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    monkeypatch.setitem(sys.modules, "IPython.display", inside)
    assert show(scenes, plans, 2) is None
    (frame,) = shown
    source = re.search(r'srcdoc="([^"]*)"', frame)
    assert source and html.unescape(source[1]) == render(scenes, plans, index=2)


# ---- in a browser ----

ACTIONS = """<script>
const told = [];
const ask = (id) => document.getElementById(id);
const fire = (node, name, more) => node.dispatchEvent(new Event(name, { bubbles: true, ...more }));
const rowsNow = () => [...document.querySelectorAll("#rows tbody tr")];
data.scenes.forEach((_, i) => {
  ask("scene").value = String(i);
  fire(ask("scene"), "change");
  told.push(rowsNow().map((row) => Number(row.cells[4].textContent)));
});
const report = { told };
ask("compare").checked = true;
fire(ask("compare"), "change");
report.panels = document.querySelectorAll("#panels canvas").length;
const panel = panels[1], at = 7, place = proposalPaths(planOf(1))[at].points[38];
const frame = panel.canvas.getBoundingClientRect();
const spot = {
  clientX: frame.left + frame.width / 2 + (place[0] - state.view.x) * state.view.scale,
  clientY: frame.top + frame.height / 2 - (place[1] - state.view.y) * state.view.scale,
  bubbles: true, cancelable: true, pointerId: 1,
};
panel.canvas.setPointerCapture = () => {};
panel.canvas.dispatchEvent(new PointerEvent("pointermove", spot));
report.hover = state.hover;
panel.canvas.dispatchEvent(new PointerEvent("pointerdown", spot));
panel.canvas.dispatchEvent(new PointerEvent("pointerup", spot));
report.pinned = [...state.pinned];
report.focus = state.planner;
const before = { ...state.view };
panel.canvas.dispatchEvent(new WheelEvent("wheel", { ...spot, deltaY: -200 }));
report.zoom = state.view.scale / before.scale;
const drag = (x) => ({ ...spot, clientX: spot.clientX + x });
const x = state.view.x;
panel.canvas.dispatchEvent(new PointerEvent("pointerdown", spot));
panel.canvas.dispatchEvent(new PointerEvent("pointermove", drag(50)));
panel.canvas.dispatchEvent(new PointerEvent("pointerup", drag(50)));
report.pan = (x - state.view.x) * state.view.scale;
report.stillPinned = [...state.pinned];
const failing = rowsNow().find((row) => planOf(1).moments[Number(row.dataset.proposal)]);
failing.click();
report.why = [...document.querySelectorAll("#why li")].map((item) => item.textContent);
report.failing = Number(failing.dataset.proposal);
ask("mark").click();
report.step = state.step;
report.clock = ask("clock").textContent;
report.rear = pose(planOf(1).states[pinnedOr(1)], state.step);
document.body.append(Object.assign(document.createElement("pre"), {
  id: "report", textContent: JSON.stringify(report),
}));
</script></body>"""


def test_picture_is_not_blank(tmp_path: Path, scenes: ScenarioSet, plans: PlanSet):
    image = pytest.importorskip("matplotlib.image")
    file, shot = tmp_path / "scenes.html", tmp_path / "shot.png"
    index = [info.scenario_type for info in scenes.infos].index("straight")
    write_html(file, scenes, plans, index=index)
    _, console = browse(tmp_path, file, f"--screenshot={shot}")
    assert console == []
    pixels = (255 * image.imread(shot)[130:780, 60:800, :3]).astype(int)  # inside the canvas
    colors, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    assert len(colors) > 100
    share = {tuple(c): n / counts.sum() for c, n in zip(colors, counts, strict=True)}
    route, vehicle = (0xC9, 0xDE, 0xF2), (0x7D, 0x94, 0xAC)
    assert share.get(route, 0) > 0.05 and share.get(vehicle, 0) > 0.002


def test_page_answers_to_pointer_and_table(tmp_path: Path, scenes: ScenarioSet, plans: PlanSet):
    file = tmp_path / "scenes.html"
    page = render(scenes, [plans, replace(plans, name="Again")])
    file.write_text(page.replace("</body>", ACTIONS), encoding="utf-8")
    output, console = browse(tmp_path, file, "--dump-dom")
    assert console == []
    found = re.search(r'<pre id="report">(.*?)</pre>', output, re.DOTALL)
    assert found, output[-500:]
    report = json.loads(html.unescape(found[1]))
    real = [r for r in range(NUM) if r not in PADDED]
    for index, totals in enumerate(report["told"]):
        expected = np.sort(plans.scores.total[index, real])[::-1]
        np.testing.assert_allclose(totals, expected, atol=0.0006)
    assert report["panels"] == 2
    assert report["hover"] == {"planner": 1, "proposal": 7} and report["focus"] == 1
    assert report["pinned"] == [None, 7] == report["stillPinned"]
    assert report["zoom"] == pytest.approx(np.exp(0.3), rel=1e-6)
    assert report["pan"] == pytest.approx(50, abs=1e-6)
    last, failing = len(scenes) - 1, real[report["failing"]]
    assert report["why"] == list(plans.explain(last, failing).lost)
    assert report["step"] == plans.explain(last, failing).step == 11 and report["clock"] == "1.1 s"
    rear = [getattr(plans.tracked, n)[last, failing, 11] for n in ("x", "y", "heading")]
    np.testing.assert_allclose(report["rear"], rear, atol=0.006)


def test_scripts_run_without_a_browser(page: str, tmp_path: Path):
    path = tmp_path / "page.html"
    path.write_text(page, encoding="utf-8")
    told = run_scripts(
        path,
        """
        showScene(1);
        for (let i = 0; i <= LAST; i += 1) setStep(i);
        hoverAt(0, 1);
        pin(0, 2);
        nodes.fit.fire("click");
        return { why: nodes.why.text(), clock: nodes.clock.textContent, drawn: drawn.fill > 40 };
        """,
    )
    assert "pinned" in told["why"] or "proposal" in told["why"]
    assert told["clock"] == "4.0 s" and told["drawn"]
