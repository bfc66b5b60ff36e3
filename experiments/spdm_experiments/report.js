"use strict";
// Fills the parts of the report from #data, which `report_page.py` writes; charts come from
// `report_charts.js`, which runs first. Numbers that are not known are null.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const two = data.runs.length > 1;

function element(tag, text, attributes = {}, ...children) {
  const node = document.createElement(tag);
  if (text !== undefined && text !== null) node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const signed = (value, digits) => {
  const text = fixed(value, digits), zero = Number(text) === 0;
  return zero ? text.replace("-", "") : (value > 0 ? "+" : "") + text.replace("-", "−");
};
const between = (ends, digits, write = fixed) => (ends[0] === null ? "–" : `${write(ends[0], digits)} … ${write(ends[1], digits)}`);
const pointName = (i) => (two ? `${"AB"[data.points[i].run]}: ` : "") + data.points[i].title;
const titleOf = (key) => data.terms.find((t) => t.key === key)?.title ?? "Progress, m";
const roomFor = (node) => Math.max(280, (node.clientWidth || $("tabs").clientWidth || 900) - 20);

// columns: {title, text, hint, value(row) for sorting}; cells(row) gives nodes or strings
function table(columns, rows, cells, { sortable = false, mark } = {}) {
  const head = element("tr"), body = element("tbody");
  const fill = (ordered) => body.replaceChildren(...ordered.map((row) => {
    const line = element("tr");
    cells(row).forEach((cell, i) => {
      const box = element("td", null, { class: columns[i].text ?? "" });
      box.append(cell);
      line.append(box);
    });
    mark?.(line, row);
    return line;
  }));
  columns.forEach((column, i) => {
    const cell = element("th", null, { scope: "col", class: column.text ? "text" : "", title: column.hint ?? "" });
    if (sortable && column.value) {
      const button = element("button", column.title, { type: "button" });
      button.addEventListener("click", () => {
        const down = cell.getAttribute("aria-sort") === "ascending";
        head.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
        cell.setAttribute("aria-sort", down ? "descending" : "ascending");
        fill([...rows].sort((a, b) => (down ? -1 : 1) * compare(column.value(a), column.value(b))));
      });
      cell.append(button);
    } else cell.append(column.title);
    head.append(cell);
  });
  fill(rows);
  return element("div", null, { class: "wide" }, element("table", null, {}, element("thead", null, {}, head), body));
}

// Unknown values come last in rising order.
function compare(a, b) {
  if (typeof a === "string") return a.localeCompare(b);
  return (a ?? Infinity) - (b ?? Infinity);
}

function choose(label, options, onChange, chosen = 0) {
  const list = element("select");
  options.forEach((text, i) => list.append(element("option", text, { value: i })));
  list.value = String(chosen);
  list.addEventListener("change", () => onChange(Number(list.value)));
  return element("label", label, {}, list);
}

const tools = (...nodes) => element("div", null, { class: "tools" }, ...nodes);

// ---- summary ------------------------------------------------------------------------------------

function drawSummary(part) {
  for (const note of data.notes) part.append(element("p", note, { class: "note" }));
  data.runs.forEach((run, i) => {
    part.append(element("h2", two ? `Run ${run.name}` : run.name));
    for (const note of run.notes) part.append(element("p", note, { class: "note" }));
    const list = element("dl");
    for (const [name, value] of run.about) {
      list.append(element("div", null, {}, element("dt", name), element("dd", value)));
    }
    const points = data.points.filter((p) => p.run === i);
    part.append(list, pointTable(points));
    if (data.types[i].length) part.append(element("h3", "Mean score by scenario type"), typeTable(points, data.types[i]));
  });
  part.append(element("p", "Means over the scenarios with scores; the interval is a bootstrap over scenarios. Failed scenarios are "
    + `counted and not averaged in. ${data.terms.slice(1).map((t) => `${t.short} ${t.title.toLowerCase()}`).join(", ")}, ${data.words.summary}`,
  { class: "quiet" }));
  if (two) part.append(element("h2", "Total score, A minus B, scenario by scenario"), pairedTable());
}

function pointTable(points) {
  const [{ key: total, ...first }, ...rest] = data.terms;
  const best = Math.max(...points.map((p) => p.means.total ?? -Infinity));
  const columns = [
    ...data.parameters.map((p) => ({ title: p.title, text: p.key === "planner" ? "text" : "" })),
    { title: "scenarios" }, { title: "failed" },
    { title: first.short, hint: first.title }, { title: "95 % interval" },
    ...rest.map((t) => ({ title: t.short, hint: t.title })),
    { title: "m", hint: "progress, m" }, ...(data.braking ? [{ title: "brake" }] : []), { title: "ms", hint: "per scenario" },
  ];
  return table(columns, points, (p) => [
    ...data.parameters.map((k) => p.parameters[k.key]),
    String(p.scenarios), String(p.failed),
    fixed(p.means[total], 4), between(p.intervals[total], 4), ...rest.map((t) => fixed(p.means[t.key], 3)),
    fixed(p.means[data.metres], 1),
    ...(data.braking ? [p.braking === null ? "–" : `${(100 * p.braking).toFixed(1)} %`] : []), fixed(p.ms, 1),
  ], { mark: (line, p) => line.classList.toggle("best", p.means.total === best) });
}

function typeTable(points, types) {
  const columns = [{ title: "Type", text: "text", value: (t) => t.type }, { title: "scenarios", value: (t) => t.scenarios },
    ...points.map((p, k) => ({ title: p.title, value: (t) => t.means[k] }))];
  return table(columns, types, (t) => [t.type, String(t.scenarios), ...t.means.map((mean) => fixed(mean, 3))], { sortable: true });
}

function pairedTable() {
  if (!data.paired.length) {
    return element("p", "The runs have no grid point in common: planner, N_p and every varied setting must agree.", { class: "note" });
  }
  const columns = [
    { title: "Grid point", text: "text" }, { title: "scenarios in both" }, { title: "mean difference" },
    { title: "95 % interval" }, { title: "A better" }, { title: "equal" }, { title: "B better" },
  ];
  return table(columns, data.paired, (p) => [
    data.points[p.points[0]].title, String(p.scenarios), signed(p.mean, 4), between(p.interval, 4, signed),
    String(p.wins), String(p.ties), String(p.losses),
  ]);
}

// ---- lines over a parameter ---------------------------------------------------------------------

const hidden = new Set(); // names of lines that are switched off

function drawLines(part, { heading, keys, value, interval, digits, zero, yTitle, from }) {
  const state = { axis: 0, key: keys[0] }, title = element("h2");
  const box = element("div", null, { class: "chart" });
  const draw = () => {
    const axis = data.axes[state.axis];
    title.textContent = `${heading} over ${axis.key === "num_proposals" ? "N_p" : axis.title}`;
    const lines = axis.lines.map((line) => ({
      ...line,
      shape: [...new Set(axis.lines.map((l) => l.color))].indexOf(line.color),
      hollow: line.run === 1,
      dots: line.points.map((i, k) => {
        const p = data.points[i], ends = interval(p, state.key);
        const text = [pointName(i), `${yTitle(state.key)} ${fixed(value(p, state.key), digits)}`];
        if (ends[0] !== null) text.push(`95 % interval ${between(ends, digits)}`);
        text.push(`${p.scenarios} scenarios`);
        return { x: line.values[k], y: value(p, state.key), low: ends[0], high: ends[1], tip: text.join("\n") };
      }),
    }));
    const width = Math.min(roomFor(part), 920);
    const shown = lines.filter((line) => !hidden.has(line.name));
    const known = shown.some((line) => line.dots.some((d) => d.y !== null));
    box.replaceChildren(
      known ? lineChart({
        lines: shown, zero, width, height: Math.round(Math.min(430, Math.max(280, width * 0.55))),
        xTitle: axis.title, yTitle: yTitle(state.key), label: `${yTitle(state.key)} over ${axis.title}`,
      }) : element("p", shown.length ? "No scenario has scores yet." : "All lines are switched off.", { class: "quiet" }),
      legend(lines, draw),
    );
  };
  const picks = [];
  if (data.axes.length > 1) picks.push(choose("over", data.axes.map((a) => a.title), (i) => { state.axis = i; draw(); }));
  if (keys.length > 1) picks.push(choose("show", keys.map(yTitle), (i) => { state.key = keys[i]; draw(); }));
  part.append(title, ...(picks.length ? [tools(...picks)] : []), box, element("p", from, { class: "quiet" }));
  redraws.push(draw);
  draw();
}

function legend(lines, onChange) {
  const box = element("div", null, { class: "legend" });
  for (const line of lines) {
    const tick = element("input", null, { type: "checkbox" });
    tick.checked = !hidden.has(line.name);
    tick.addEventListener("change", () => {
      if (tick.checked) hidden.delete(line.name);
      else hidden.add(line.name);
      onChange();
      // The legend is new now; whoever uses the keyboard stays at the same box.
      [...box.parentNode?.querySelectorAll("input") ?? []][lines.indexOf(line)]?.focus();
    });
    box.append(element("label", null, {}, tick, swatch(line), line.name));
  }
  return box;
}

function drawScore(part) {
  drawLines(part, {
    heading: "Score",
    keys: [...data.terms.map((t) => t.key), data.metres],
    value: (p, key) => p.means[key],
    interval: (p, key) => p.intervals[key],
    digits: 4,
    yTitle: titleOf,
    from: data.words.score,
  });
}

// ---- runtime ------------------------------------------------------------------------------------

function drawRuntime(part) {
  if (data.stages.length) {
    drawStages(part);
    return;
  }
  drawLines(part, {
    heading: "Runtime per scenario",
    keys: ["ms"],
    value: (p) => p.ms,
    interval: () => [null, null],
    digits: 2,
    zero: true,
    yTitle: () => "ms per scenario",
    from: "Run time of a device call divided by its scenarios, without compilation. Grid points that are scored together, "
      + "as nested numbers of proposals are, share one time. For proposal generation, tracking and scoring "
      + "apart at every N_p, sweep with --stage-times.",
  });
}

function drawStages(part) {
  const box = element("div", null, { class: "charts" });
  const groups = new Map();
  for (const row of data.stages) {
    const name = (two ? `${"AB"[row.run]}: ` : "") + row.planner;
    groups.set(name, [...(groups.get(name) ?? []), row]);
  }
  const sum = (row) => data.stageNames.reduce((all, s) => all + (row[s.key] ?? 0), 0);
  const top = Math.max(...data.stages.map((row) => Math.max(sum(row), row.total ?? 0))) * 1.08 || 1;
  const draw = () => {
    const all = roomFor(part), width = Math.min(all, Math.max(380, all / groups.size - 30), 620);
    box.replaceChildren(...[...groups].map(([name, rows]) => element("div", null, { class: "chart" },
      element("h3", name),
      barChart({
        bars: rows.map((row) => ({
          x: String(row.num_proposals), total: row.total,
          parts: data.stageNames.map((s) => ({ value: row[s.key] ?? 0, color: s.color })),
          tip: [`${name}, N_p ${row.num_proposals}`, ...data.stageNames.map((s) => `${s.title} ${fixed(row[s.key], 2)} ms`),
            `Whole step ${fixed(row.total, 2)} ms`, `${row.scenes} scenes`].join("\n"),
        })),
        top, width, height: 320, xTitle: "Number of proposals N_p", yTitle: "ms per step", label: `Runtime of ${name} over N_p`,
      }))));
  };
  const names = element("div", null, { class: "legend" }, ...data.stageNames.map((s) => {
    const sample = element("i");
    sample.style.background = s.color;
    return element("span", null, {}, sample, s.title);
  }), element("span", null, {}, swatch({ color: "#1b1f24", shape: 3 }), "whole step as one program"));
  const columns = [...(two ? [{ title: "Run" }] : []), { title: "Planner", text: "text" }, { title: "N_p" },
    ...data.stageNames.map((s) => ({ title: s.title })), { title: "Whole step" }, { title: "scenes" }];
  const bare = data.runs.filter((_, i) => !data.stages.some((row) => row.run === i));
  const lacking = bare.map((run) => element("p", `Run ${run.name} has no times of stages; sweep with --stage-times.`, { class: "note" }));
  part.append(element("h2", "Runtime over N_p"), ...lacking, names, box, element("h2", "The same in ms"),
    table(columns, data.stages, (row) => [...(two ? ["AB"[row.run]] : []), row.planner, String(row.num_proposals),
      ...data.stageNames.map((s) => fixed(row[s.key], 2)), fixed(row.total, 2), String(row.scenes)]),
    element("p", "Medians of repeated calls of one planning step, averaged over the timed scenes. Each stage is timed as a program of "
      + "its own; the whole step is another, which also looks up lanes and extends the chosen plan.", { class: "quiet" }));
  redraws.push(draw);
  draw();
}

// ---- two grid points, scenario by scenario ------------------------------------------------------

function drawCompare(part) {
  const count = data.points.length, last = data.paired.length - 1;
  const state = { x: 0, y: count - 1, term: 0 };
  if (last >= 0) [state.y, state.x] = data.paired[last].points;
  const box = element("div", null, { class: "chart" }), words = element("p"), list = element("div", null, { class: "beside" });
  const draw = () => {
    const rows = data.scenes
      .map((s) => ({ scene: s, x: s.values[state.x][state.term], y: s.values[state.y][state.term] }))
      .filter((r) => r.x !== null && r.y !== null);
    const term = data.terms[state.term].title, nameX = pointName(state.x), nameY = pointName(state.y);
    for (const r of rows) r.tip = `${r.scene.token}\n${r.scene.type}\n${nameX} ${fixed(r.x, 3)}\n${nameY} ${fixed(r.y, 3)}`;
    const size = Math.min(roomFor(part), 560), tie = 1e-4;
    const better = rows.filter((r) => r.y > r.x + tie).length, worse = rows.filter((r) => r.x > r.y + tie).length;
    const mean = rows.reduce((sum, r) => sum + r.y - r.x, 0) / (rows.length || 1);
    words.textContent = rows.length
      ? `${term}: ${nameY} is better in ${better} scenarios, ${nameX} in ${worse}, equal in ${rows.length - better - worse}; `
        + `mean difference ${signed(mean, 4)}.`
      : "No scenario has scores at both grid points.";
    box.hidden = !rows.length;
    box.replaceChildren(scatterChart({
      dots: rows, range: [-0.1, 1.1], width: size, height: size,
      xTitle: nameX, yTitle: nameY, label: `${term} of every scenario`,
      color: (r) => (r.y > r.x + tie ? "#0072b2" : r.x > r.y + tie ? "#d55e00" : "#6b7480"),
      onPick: (r) => openScene(r.scene.token),
    }));
    const far = [...rows].filter((r) => Math.abs(r.y - r.x) > tie).sort((a, b) => Math.abs(b.y - b.x) - Math.abs(a.y - a.x)).slice(0, 30);
    list.replaceChildren(element("h3", "Largest differences"), far.length ? table(
      [{ title: "Scene", text: "text", value: (r) => r.scene.token }, { title: nameX, value: (r) => r.x }, { title: nameY, value: (r) => r.y }, { title: "difference", value: (r) => r.y - r.x }],
      far, (r) => [sceneLink(r.scene.token), fixed(r.x, 3), fixed(r.y, 3), signed(r.y - r.x, 3)], { sortable: true },
    ) : element("p", "None: all scenarios score the same.", { class: "quiet" }));
  };
  const names = data.points.map((_, i) => pointName(i));
  part.append(element("h2", "Scenario by scenario"), tools(
    choose("across", names, (i) => { state.x = i; draw(); }, state.x),
    choose("upward", names, (i) => { state.y = i; draw(); }, state.y),
    choose("score", data.terms.map((t) => t.title), (i) => { state.term = i; draw(); }),
  ), words, element("div", null, { class: "charts" }, box, list), element("p", "One dot per scenario; above the line, in blue, the upward one is better, below it, in orange, the other. Equal dots lie in a spiral around their place. "
    + "A click opens the scene in the player, if it is there."
    + (data.sampled > data.scenes.length ? ` ${data.scenes.length} of ${data.sampled} scenarios are shown, drawn at random; the numbers above are theirs.` : ""),
  { class: "quiet" }));
  redraws.push(draw);
  draw();
}

// ---- worst scenes and the player ----------------------------------------------------------------

const playable = new Map(data.player.tokens.map((token, i) => [token, i]));

function sceneLink(token) {
  if (!playable.has(token)) return token;
  const button = element("button", `▶ ${token}`, { class: "plain", type: "button", title: "open in the player" });
  button.addEventListener("click", () => openScene(token));
  return button;
}

function drawWorst(part) {
  const box = element("div"), player = element("div", null, { id: "player" });
  const draw = (i) => {
    const found = data.lists[i], old = found.compared;
    const columns = [
      { title: "Scene", text: "text", value: (r) => r.token }, { title: "Type", text: "text", value: (r) => r.type },
      { title: old ? "A" : "Score", value: (r) => r.total },
      ...(old ? [{ title: "B", value: (r) => r.other }, { title: "difference", value: (r) => r.difference }] : []),
      { title: "First lost", text: "text", value: (r) => r.term }, { title: "Reason", text: "long" },
    ];
    const content = found.rows.length ? table(columns, found.rows, (r) => [
      sceneLink(r.token), r.type, fixed(r.total, 3), ...(old ? [fixed(r.other, 3), signed(r.difference, 3)] : []),
      r.term || "nothing", r.reason + (r.braking ? " (emergency brake)" : ""),
    ], { sortable: true, mark: (line, r) => { line.dataset.token = r.token; } })
      : element("p", old ? "None: A is nowhere behind B here." : "No scenario has scores here.", { class: "note" });
    content.classList.add("tall");
    box.replaceChildren(content);
  };
  const first = Math.max(0, data.lists.findIndex((l) => l.rows.length));
  part.append(element("h2", "Worst scenes"), tools(choose("list", data.lists.map((l) => l.name), draw, first)), box);
  part.append(element("h2", "Player"));
  for (const note of data.player.notes) part.append(element("p", note, { class: playable.size ? "quiet" : "note" }));
  if (playable.size) {
    const open = element("button", "Open the player", { class: "plain", type: "button" });
    open.addEventListener("click", () => openScene(data.player.tokens[0]));
    player.append(open);
    part.append(player);
  }
  draw(first);
}

function openScene(token) {
  if (!playable.has(token)) return;
  showTab("worst");
  const scene = playable.get(token);
  let view = document.querySelector("#player iframe");
  const show = () => view.contentWindow.showScene(scene);
  if (view) show();
  else {
    view = element("iframe", null, { title: "player: map, objects and proposals of a scene" });
    view.addEventListener("load", show);
    view.srcdoc = JSON.parse($("player-page").textContent);
    $("player").replaceChildren(view);
  }
  history.replaceState(null, "", `#worst/${encodeURIComponent(token)}`);
  for (const row of document.querySelectorAll("#part-worst tr")) row.classList.toggle("shown", row.dataset.token === token);
  $("player").scrollIntoView({ block: "start" });
}

// ---- failures -----------------------------------------------------------------------------------

function drawFailures(part) {
  data.runs.forEach((run, i) => {
    const { rows, total } = data.failures[i];
    part.append(element("h2", two ? `Run ${run.name}` : "Failed scenarios"));
    if (!rows.length) {
      part.append(element("p", "None: every scenario that was run has scores at every grid point."));
      return;
    }
    const columns = [{ title: "Scene", text: "text", value: (r) => r.token }, { title: "Status", text: "text", value: (r) => r.status },
      { title: "Grid points", value: (r) => r.points }, { title: "Reason", text: "long", value: (r) => r.reason }];
    part.append(element("p", `${total} scenarios failed; they are in no mean.`),
      table(columns, rows, (r) => [r.token, r.status, r.points === r.of ? "all" : `${r.points} of ${r.of}`, r.reason], { sortable: true }));
  });
}

// ---- tabs ---------------------------------------------------------------------------------------

const redraws = []; // what depends on the width of the window
const parts = [...document.querySelectorAll("main > section")];
const nameOf = (part) => part.id.slice("part-".length); // an anchor of its own, so that nothing scrolls

function showTab(id, focus = false) {
  for (const part of parts) {
    const tab = $(`tab-${nameOf(part)}`), here = nameOf(part) === id;
    part.hidden = !here;
    tab.setAttribute("aria-selected", String(here));
    tab.tabIndex = here ? 0 : -1;
    if (here && focus) tab.focus();
  }
  history.replaceState(null, "", `#${id}`);
}

for (const part of parts) {
  const tab = element("button", part.dataset.title, { role: "tab", id: `tab-${nameOf(part)}`, "aria-controls": part.id, type: "button" });
  tab.addEventListener("click", () => showTab(nameOf(part)));
  $("tabs").append(tab);
  part.setAttribute("role", "tabpanel");
  part.setAttribute("aria-labelledby", tab.id);
}
$("tabs").addEventListener("keydown", (event) => {
  const at = parts.findIndex((part) => !part.hidden), end = parts.length - 1;
  const to = { ArrowLeft: at ? at - 1 : end, ArrowRight: at === end ? 0 : at + 1, Home: 0, End: end }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  showTab(nameOf(parts[to]), true);
});
const writers = { summary: drawSummary, score: drawScore, runtime: drawRuntime, compare: drawCompare, worst: drawWorst, failures: drawFailures };
for (const part of parts) writers[nameOf(part)](part);
// A link may name a part, and a scene: report.html#worst/TOKEN.
const [wanted, scene] = decodeURIComponent(location.hash.slice(1)).split("/");
showTab(Object.hasOwn(writers, wanted) ? wanted : "summary");
if (scene) openScene(scene);
let pause;
window.addEventListener("resize", () => {
  clearTimeout(pause);
  pause = setTimeout(() => redraws.forEach((draw) => draw()), 120);
});
document.addEventListener("keydown", (event) => { if (event.key === "Escape") $("tip").hidden = true; });
