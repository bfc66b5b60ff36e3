"use strict";
// Text, state and input; the pictures themselves are drawn by `draw.js`, which runs first.

// ---- text beside the pictures -------------------------------------------------------------------

function describe(plan, i) {
  const parts = [`proposal ${plan.row[i]}`];
  if (plan.stage[i] >= 0) parts.push(`stage ${plan.stage[i]}, path ${plan.path[i]}`);
  if (plan.speed[i] !== null) parts.push(`target ${plan.speed[i].toFixed(1)} m/s`);
  if (plan.lane[i]) parts.push(`onto lane ${plan.lane[i]}`);
  return parts.join(" · ");
}

function writeWhy() {
  const plan = planOf(state.planner), shown = shownProposal(state.planner);
  const role = [];
  if (shown === plan.best) role.push(plan.braking ? "best, but the emergency brake acts" : "chosen");
  if (shown === state.pinned[state.planner]) role.push("pinned");
  const lines = plan.lost[shown].length ? plan.lost[shown] : ["nothing lost"];
  const list = element("ul");
  for (const line of lines) list.append(element("li", line));
  $("why").replaceChildren(
    element("h2", `${fixed(plan.scores.total[shown], 3)}${role.length ? ` (${role.join(", ")})` : ""}`),
    element("p", `${data.planners[state.planner].name}: ${describe(plan, shown)}`),
    list,
  );
}

function writeTable() {
  const plan = planOf(state.planner);
  const body = document.querySelector("#rows tbody");
  const rank = plan.row.map((_, i) => i)
    .sort((a, b) => (plan.scores.total[b] ?? -1) - (plan.scores.total[a] ?? -1)
      || (b === plan.best) - (a === plan.best) || a - b); // scores are rounded, so the best may tie
  body.replaceChildren(...rank.map((i) => {
    const row = element("tr", undefined, { tabindex: "0", "data-proposal": String(i) });
    const first = element("td");
    const dot = element("b");
    dot.style.background = color(plan.scores[state.term][i]);
    first.append(dot, String(plan.row[i]) + (i === plan.best ? " ★" : ""));
    row.append(first);
    const known = (value) => (value < 0 ? "–" : String(value));
    row.append(element("td", known(plan.stage[i])), element("td", known(plan.path[i])));
    row.append(element("td", fixed(plan.speed[i], 1)));
    for (const term of data.terms) {
      const value = plan.scores[term.key][i];
      const smooth = { total: 3, progress: 2 }[term.key];
      const text = smooth || value === null ? fixed(value, smooth) : String(value);
      row.append(element("td", text, !smooth && value < 1 ? { class: "lost" } : {}));
    }
    row.append(element("td", fixed(plan.scores.progress_raw[i], 1)));
    return row;
  }));
}

function writeMark() {
  const moment = planOf(state.planner).moments[shownProposal(state.planner)];
  const mark = $("mark");
  mark.hidden = !moment;
  if (!moment) return;
  mark.textContent = `▾ ${(moment.step / 10).toFixed(1)} s`;
  mark.title = moment.label;
  // The thumb of the slider is about 16 px wide and stays inside the track.
  mark.style.left = `calc(8px + (100% - 16px) * ${moment.step / LAST})`;
}

function markRows() {
  const shown = pinnedOr(state.planner);
  for (const row of document.querySelectorAll("#rows tbody tr")) {
    const i = Number(row.dataset.proposal);
    row.classList.toggle("shown", i === shown);
    const hovered = state.hover?.planner === state.planner && state.hover.proposal === i;
    row.classList.toggle("hover", hovered);
  }
}

function writeLegend() {
  const item = (style, text, kind = "") => {
    const sample = element("i", undefined, { class: kind });
    sample.style.background = style;
    const node = element("span");
    node.append(sample, text);
    return node;
  };
  const scale = element("span");
  const bar = element("i", undefined, { class: "scale" });
  bar.style.background = `linear-gradient(90deg, ${data.scale.join(",")})`;
  scale.append("0", bar, `1 ${data.terms.find((t) => t.key === state.term).title}`);
  const scene = data.scenes[state.scene];
  const kinds = [...new Set(scene.objects.map((o) => o.kind))].sort((a, b) => a - b);
  $("legend").replaceChildren(
    scale,
    item(ink.ego, "ego"),
    item(ink.route, "route"),
    ...kinds.map((k) => item(data.kinds[k].color, data.kinds[k].name)),
    ...(scene.map.crosswalks.length ? [item(ink.crosswalk, "crosswalk")] : []),
    ...(scene.map.red.length ? [item(ink.red, "red light", "line")] : []),
    item(ink.ink, "chosen", "line"),
    item("#1f78d1", "hovered or pinned", "line"),
    item("", "where a rule is broken", "ghost"),
  );
}

// ---- state --------------------------------------------------------------------------------------

function redraw() {
  panels.forEach(draw);
  writeWhy();
  writeMark();
  markRows();
  $("clock").textContent = `${(state.step / 10).toFixed(1)} s`;
}

function shownPlanners() {
  return state.compare ? data.planners.map((_, i) => i) : [state.planner];
}

function fitView() {
  let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const planner of shownPlanners()) {
    for (const { points } of proposalPaths(planOf(planner))) {
      for (const p of points) {
        low = low.map((v, i) => Math.min(v, p[i]));
        high = high.map((v, i) => Math.max(v, p[i]));
      }
    }
  }
  if (!Number.isFinite(low[0])) {
    low = high = pose(data.scenes[state.scene].ego, 0).slice(0, 2);
  }
  const canvas = panels[0].canvas;
  const room = [0, 1].map((i) => Math.max(high[i] - low[i] + 24, 50));
  state.view = {
    x: (low[0] + high[0]) / 2,
    y: (low[1] + high[1]) / 2,
    scale: Math.min(canvas.clientWidth / room[0], canvas.clientHeight / room[1]) || 8,
  };
}

function showScene(index) {
  state.scene = (index + data.scenes.length) % data.scenes.length;
  state.pinned.fill(null);
  state.hover = null;
  state.step = 0;
  $("time").value = "0";
  $("scene").value = String(state.scene);
  layout();
}

function layout() {
  panels.forEach((panel) => sizes.unobserve(panel.canvas));
  panels = shownPlanners().map((planner) => {
    const plan = planOf(planner), figure = element("figure"), canvas = element("canvas");
    const name = data.planners[planner].name;
    const notes = [`${plan.row.length} proposals`, `best ${fixed(plan.scores.total[plan.best], 3)}`];
    if (plan.braking) notes.push("emergency brake");
    if (plan.status !== "ok") notes.push(plan.status);
    const caption = element("figcaption");
    caption.append(element("strong", name), ` · ${notes.join(" · ")}`);
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${name}: map, objects and proposals, listed in the table`);
    figure.append(caption, canvas);
    return { planner, canvas, figure };
  });
  $("panels").replaceChildren(...panels.map((panel) => panel.figure));
  panels.forEach(listen);
  panels.forEach((panel) => sizes.observe(panel.canvas));
  fitView();
  focusPlanner(state.planner);
  writeLegend();
}

function focusPlanner(planner) {
  state.planner = planner;
  $("planner").value = String(planner);
  panels.forEach((p) => p.figure.classList.toggle("focus", state.compare && p.planner === planner));
  writeTable();
  redraw();
}

function hoverAt(planner, proposal) {
  const before = state.hover;
  if (before?.planner === planner && before?.proposal === proposal) return;
  if (!before && proposal === null) return;
  state.hover = proposal === null ? null : { planner, proposal };
  redraw();
}

function pin(planner, proposal) {
  state.pinned[planner] = state.pinned[planner] === proposal ? null : proposal;
  redraw();
}

function setStep(step) {
  state.step = Math.min(Math.max(step, 0), LAST);
  $("time").value = String(state.step);
  redraw();
}

function play(on) {
  clearInterval(state.timer);
  state.timer = null;
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  if (state.step === LAST) setStep(0);
  state.timer = setInterval(() => {
    if (state.step < LAST) setStep(state.step + 1);
    else play(false);
  }, 100);
}

// ---- pointer ------------------------------------------------------------------------------------

function nearest(plan, x, y) {
  const lines = proposalPaths(plan), limit = 9 / state.view.scale;
  let found = null, best = Infinity;
  lines.forEach(({ points, length }, i) => {
    let gap = Infinity;
    for (let k = 0; k < points.length; k += 1) {
      const [ax, ay] = points[k], [bx, by] = points[Math.min(k + 1, points.length - 1)];
      const ux = bx - ax, uy = by - ay, square = ux * ux + uy * uy;
      const t = square ? Math.min(Math.max(((x - ax) * ux + (y - ay) * uy) / square, 0), 1) : 0;
      gap = Math.min(gap, Math.hypot(x - ax - t * ux, y - ay - t * uy));
    }
    // Of proposals on one path the shortest lies on top there, so it is the one meant.
    const cost = Math.round((4 * gap) / limit) * 1e4 + length;
    if (gap < limit && cost < best) [found, best] = [i, cost];
  });
  return found;
}

function listen({ planner, canvas }) {
  let grip = null;
  const place = (event) => {
    const r = canvas.getBoundingClientRect(), view = state.view;
    const dx = event.clientX - r.left - r.width / 2, dy = event.clientY - r.top - r.height / 2;
    return [view.x + dx / view.scale, view.y - dy / view.scale];
  };
  canvas.addEventListener("pointerdown", (event) => {
    grip = { x: event.clientX, y: event.clientY, moved: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (grip) {
      const dx = event.clientX - grip.x, dy = event.clientY - grip.y;
      if (!grip.moved && Math.hypot(dx, dy) < 4) return;
      grip = { x: event.clientX, y: event.clientY, moved: true };
      state.view.x -= dx / state.view.scale;
      state.view.y += dy / state.view.scale;
      panels.forEach(draw);
      return;
    }
    const found = nearest(planOf(planner), ...place(event));
    canvas.classList.toggle("hit", found !== null);
    if (state.planner !== planner) focusPlanner(planner);
    hoverAt(planner, found);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (grip && !grip.moved) {
      if (state.planner !== planner) focusPlanner(planner);
      pin(planner, nearest(planOf(planner), ...place(event)));
    }
    grip = null;
  });
  canvas.addEventListener("pointercancel", () => { grip = null; });
  canvas.addEventListener("pointerleave", () => hoverAt(planner, null));
  canvas.addEventListener("dblclick", () => { fitView(); redraw(); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const [x, y] = place(event), view = state.view;
    const lines = event.deltaMode === 1 ? 30 : 1;
    const scale = Math.min(Math.max(view.scale * Math.exp(-0.0015 * lines * event.deltaY), 1), 200);
    view.x = x + ((view.x - x) * view.scale) / scale;
    view.y = y + ((view.y - y) * view.scale) / scale;
    view.scale = scale;
    panels.forEach(draw);
  }, { passive: false });
}

// ---- start --------------------------------------------------------------------------------------

const sizes = new ResizeObserver(() => panels.forEach(draw));

function fill(id, labels) {
  $(id).replaceChildren(...labels.map(([value, text]) => element("option", text, { value })));
}

for (const [name, value] of data.about) {
  const pair = element("div");
  pair.append(element("dt", name), element("dd", value));
  $("about").append(pair);
}
fill("scene", data.scenes.map((s, i) => [i, `${i + 1}. ${s.type} (${s.token})`]));
fill("planner", data.planners.map((p, i) => [i, p.name]));
fill("term", data.terms.map((t) => [t.key, t.title]));
const columns = [["#", "proposal"], ["Stage", "1: IDM along the centreline, 2: route lanes"], ["Path", ""],
  ["m/s", "target speed"], ...data.terms.map((t) => [t.short, t.title]), ["m", "progress, m"]];
const titles = element("tr");
for (const [text, title] of columns) titles.append(element("th", text, { scope: "col", title }));
document.querySelector("#rows thead").append(titles);
$("beside").hidden = data.planners.length < 2;

const rows = document.querySelector("#rows tbody");
const rowAt = (event) => event.target.closest("tr");
rows.addEventListener("pointerover", (e) => hoverAt(state.planner, Number(rowAt(e).dataset.proposal)));
rows.addEventListener("pointerleave", () => hoverAt(state.planner, null));
rows.addEventListener("click", (e) => {
  const proposal = Number(rowAt(e).dataset.proposal);
  hoverAt(state.planner, proposal);  // a tap comes without a pointer over the row before
  pin(state.planner, proposal);
});
rows.addEventListener("keydown", (e) => {
  if (e.key === "Enter") pin(state.planner, Number(rowAt(e).dataset.proposal));
});
$("scene").addEventListener("change", (e) => showScene(Number(e.target.value)));
$("before").addEventListener("click", () => showScene(state.scene - 1));
$("after").addEventListener("click", () => showScene(state.scene + 1));
$("planner").addEventListener("change", (e) => {
  state.hover = null;
  if (state.compare) return focusPlanner(Number(e.target.value));
  state.planner = Number(e.target.value);
  return layout();
});
$("compare").addEventListener("change", (e) => { state.compare = e.target.checked; layout(); });
$("term").addEventListener("change", (e) => {
  state.term = e.target.value;
  writeTable();
  writeLegend();
  redraw();
});
$("fit").addEventListener("click", () => { fitView(); redraw(); });
$("time").addEventListener("input", (e) => { play(false); setStep(Number(e.target.value)); });
$("mark").addEventListener("click", () => {
  play(false);
  const moment = planOf(state.planner).moments[shownProposal(state.planner)];
  if (moment) setStep(moment.step);
});
$("play").addEventListener("click", () => play(state.timer === null));
document.addEventListener("keydown", (event) => {
  if (event.target.closest("select, input, button")) return;
  const actions = {
    ArrowLeft: () => setStep(state.step - 1),
    ArrowRight: () => setStep(state.step + 1),
    " ": () => play(state.timer === null),
    Escape: () => { state.pinned.fill(null); redraw(); },
    n: () => showScene(state.scene + 1),
    p: () => showScene(state.scene - 1),
  };
  const action = actions[event.key];
  if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  action();
});
showScene(state.scene);
