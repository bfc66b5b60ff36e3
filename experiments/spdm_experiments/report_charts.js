"use strict";
// Charts as SVG: lines with bands, stacked bars, dots. Nothing here knows of runs or planners.

const MARGIN = { left: 58, right: 16, top: 14, bottom: 46 };

function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// Round numbers that span a range: steps of 1, 2 or 5 times a power of ten.
function ticks(low, high, count) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

// Axes around a plot: scales from values to pixels, and the drawing so far.
function frame({ width, height, x, y, xTitle, yTitle, xTicks, square, label }) {
  const right = width - MARGIN.right, bottom = height - MARGIN.bottom;
  const sx = (v) => MARGIN.left + ((v - x[0]) / (x[1] - x[0])) * (right - MARGIN.left);
  const sy = (v) => bottom - ((v - y[0]) / (y[1] - y[0])) * (bottom - MARGIN.top);
  const root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": label });
  const rows = ticks(y[0], y[1], Math.max(3, Math.round(height / 70)));
  for (const v of rows.found) {
    root.append(svg("line", { class: "grid", x1: MARGIN.left, x2: right, y1: sy(v), y2: sy(v) }));
    root.append(svg("text", { x: MARGIN.left - 7, y: sy(v) + 4, "text-anchor": "end" }, v.toFixed(rows.digits)));
  }
  const columns = ticks(x[0], x[1], Math.max(2, Math.round(width / 110)));
  const marks = xTicks ?? columns.found.map((v) => [v, v.toFixed(columns.digits)]);
  let free = -Infinity;
  for (const [v, text] of marks) {
    const at = sx(v), half = 4 * text.length;
    root.append(svg("line", { class: "axis", x1: at, x2: at, y1: bottom, y2: bottom + 4 }));
    if (square) root.append(svg("line", { class: "grid", x1: at, x2: at, y1: MARGIN.top, y2: bottom }));
    if (at - half < free) continue; // no room for this label
    free = at + half + 4;
    root.append(svg("text", { x: at, y: bottom + 18, "text-anchor": "middle" }, text));
  }
  root.append(svg("path", { class: "axis", fill: "none", d: `M${MARGIN.left},${MARGIN.top}V${bottom}H${right}` }));
  root.append(svg("text", { x: (MARGIN.left + right) / 2, y: height - 8, "text-anchor": "middle" }, xTitle));
  const middle = (MARGIN.top + bottom) / 2;
  root.append(svg("text", { x: 14, y: middle, "text-anchor": "middle", transform: `rotate(-90 14 ${middle})` }, yTitle));
  return { root, sx, sy };
}

const SHAPES = [
  (r) => `M${-r},0a${r},${r} 0 1,0 ${2 * r},0a${r},${r} 0 1,0 ${-2 * r},0Z`,
  (r) => `M${-r},${-r}H${r}V${r}H${-r}Z`,
  (r) => `M0,${-1.3 * r}L${1.2 * r},${r}H${-1.2 * r}Z`,
  (r) => `M0,${-1.4 * r}L${1.4 * r},0L0,${1.4 * r}L${-1.4 * r},0Z`,
];

function marker(line, x, y, size = 4.5) {
  return svg("path", {
    d: SHAPES[line.shape % SHAPES.length](size), transform: `translate(${x} ${y})`,
    fill: line.hollow ? "#fff" : line.color, stroke: line.color, "stroke-width": 2,
  });
}

function swatch(line) {
  const root = svg("svg", { width: 34, height: 14, viewBox: "0 0 34 14", "aria-hidden": "true" });
  root.append(svg("path", { d: "M1,7H33", stroke: line.color, "stroke-width": 2.2, "stroke-dasharray": line.hollow ? "5 4" : "none" }));
  root.append(marker(line, 17, 7));
  return root;
}

// Padded range of some numbers.
function span(values) {
  const known = values.filter((v) => v !== null && Number.isFinite(v));
  if (!known.length) return [0, 1];
  const low = Math.min(...known), high = Math.max(...known);
  const pad = (high - low) * 0.08 || Math.abs(high) * 0.05 || 0.5;
  return [low - pad, high + pad];
}

// lines: {name, color, shape, hollow, dots: [{x, y, low, high, tip}]}; `zero` starts the axis there
function lineChart({ lines, zero, ...titles }) {
  const dots = lines.flatMap((line) => line.dots);
  const places = [...new Set(dots.map((d) => d.x))].sort((a, b) => a - b);
  const x = span(places), y = span(dots.flatMap((d) => [d.y, d.low, d.high]));
  if (zero) y[0] = 0;
  const xTicks = places.length <= 12 ? places.map((v) => [v, String(+v.toFixed(4))]) : null;
  const { root, sx, sy } = frame({ x, y, xTicks, ...titles });
  // Lines over one place only stand side by side.
  const shift = (i) => (places.length > 1 ? 0 : (i - (lines.length - 1) / 2) * 22);
  lines.forEach((line, i) => {
    const at = (d) => sx(d.x) + shift(i);
    const known = line.dots.filter((d) => d.y !== null);
    const sure = known.filter((d) => d.low !== null && d.high !== null);
    if (sure.length > 1) {
      const upper = sure.map((d) => `${at(d)},${sy(d.high)}`);
      const lower = sure.map((d) => `${at(d)},${sy(d.low)}`).reverse();
      root.append(svg("polygon", { points: [...upper, ...lower].join(" "), fill: line.color, "fill-opacity": 0.13 }));
    }
    for (const d of sure) {
      root.append(svg("path", { d: `M${at(d)},${sy(d.low)}V${sy(d.high)}`, stroke: line.color, "stroke-opacity": 0.55 }));
    }
    root.append(svg("polyline", {
      points: known.map((d) => `${at(d)},${sy(d.y)}`).join(" "), fill: "none", stroke: line.color,
      "stroke-width": 2.2, "stroke-dasharray": line.hollow ? "5 4" : "none",
    }));
    for (const d of known) root.append(pickable(marker(line, at(d), sy(d.y)), d.tip, true));
  });
  return root;
}

// bars: {x: label, parts: [{value, color}], total, tip}, all from zero; `top` is the axis' end.
function barChart({ bars, top, ...titles }) {
  const xTicks = bars.map((bar, i) => [i, bar.x]);
  const { root, sx, sy } = frame({ x: [-0.6, bars.length - 0.4], y: [0, top], xTicks, ...titles });
  const half = Math.min(26, (sx(1) - sx(0)) * 0.36);
  bars.forEach((bar, i) => {
    const group = svg("g");
    let below = 0;
    for (const part of bar.parts) {
      const height = sy(below) - sy(below + part.value);
      group.append(svg("rect", { x: sx(i) - half, width: 2 * half, y: sy(below + part.value), height, fill: part.color, stroke: "#fff" }));
      below += part.value;
    }
    if (bar.total !== null) {
      group.append(marker({ color: "#1b1f24", shape: 3 }, sx(i), sy(bar.total)));
    }
    root.append(pickable(group, bar.tip, true));
  });
  return root;
}

// dots: {x, y, tip, name}; equal ones spiral around their place, so that each can be seen.
function scatterChart({ dots, range, color, onPick, ...titles }) {
  const fifths = [0, 0.2, 0.4, 0.6, 0.8, 1].map((v) => [v, v.toFixed(1)]);
  const { root, sx, sy } = frame({ x: range, y: range, xTicks: fifths, square: true, ...titles });
  root.append(svg("path", { d: `M${sx(range[0])},${sy(range[0])}L${sx(range[1])},${sy(range[1])}`, stroke: "#6b7480", "stroke-dasharray": "4 4" }));
  const seen = new Map();
  const key = (d) => `${d.x.toFixed(3)},${d.y.toFixed(3)}`;
  const most = dots.reduce((n, d) => {
    seen.set(key(d), (seen.get(key(d)) ?? 0) + 1);
    return Math.max(n, seen.get(key(d)));
  }, 1);
  const gap = Math.min(5.5, (0.065 * titles.width) / Math.sqrt(most));
  seen.clear();
  for (const d of dots) {
    const k = seen.get(key(d)) ?? 0, turn = 2.39996 * k; // the golden angle fills a disc evenly
    seen.set(key(d), k + 1);
    const cx = sx(d.x) + gap * Math.sqrt(k) * Math.cos(turn), cy = sy(d.y) + gap * Math.sqrt(k) * Math.sin(turn);
    const dot = svg("circle", { cx, cy, r: Math.min(4, Math.max(1.6, gap * 0.7)), fill: color(d), "fill-opacity": 0.75 });
    root.append(pickable(dot, d.tip, false, () => onPick(d)));
  }
  return root;
}

// ---- what a mark says when it is pointed at -----------------------------------------------------

function pickable(node, text, focusable, onPick) {
  const tip = document.getElementById("tip");
  const show = (x, y) => {
    tip.textContent = text;
    tip.hidden = false;
    tip.style.left = `${Math.max(6, Math.min(x + 12, window.innerWidth - tip.offsetWidth - 6))}px`;
    tip.style.top = `${Math.max(6, y + 14 + tip.offsetHeight > window.innerHeight ? y - 12 - tip.offsetHeight : y + 14)}px`;
  };
  const hide = () => { tip.hidden = true; };
  node.classList.add("mark");
  node.setAttribute("aria-label", text.replaceAll("\n", ", "));
  node.addEventListener("pointermove", (e) => show(e.clientX, e.clientY));
  node.addEventListener("pointerleave", hide);
  if (focusable) {
    node.setAttribute("tabindex", "0");
    node.setAttribute("role", onPick ? "button" : "img");
    node.addEventListener("focus", () => {
      const box = node.getBoundingClientRect();
      show(box.right, box.bottom);
    });
    node.addEventListener("blur", hide);
  }
  if (onPick) {
    node.addEventListener("click", () => { hide(); onPick(); });
    node.addEventListener("keydown", (e) => { if (e.key === "Enter") onPick(); });
  }
  return node;
}
