"use strict";
// What the pages have in common: reading poses, the map, boxes, a canvas in metres. Pages write into
// #data: lengths in cm, angles in mrad, null where there is none.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const ink = data.colors;
const car = data.vehicle;

function element(tag, text, attributes = {}) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

const fixed = (value, digits) => (value === null ? "–" : value.toFixed(digits));

// ---- reading ------------------------------------------------------------------------------------

const pose = (flat, i) =>
  flat[3 * i] === null || flat[3 * i] === undefined
    ? null
    : [flat[3 * i] / 100, flat[3 * i + 1] / 100, flat[3 * i + 2] / 1000];

function mix(a, b, f) {
  if (!a || !b) return f < 0.5 ? a : b;
  const turn = Math.atan2(Math.sin(b[2] - a[2]), Math.cos(b[2] - a[2]));
  return [a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * turn];
}

function egoCenter(rear) {
  const [x, y, h] = rear;
  return [x + car.reach * Math.cos(h), y + car.reach * Math.sin(h), h];
}

// ---- the map, built once per scene ---------------------------------------------------------------

function trace(path, flat, close) {
  for (let i = 0; i < flat.length; i += 2) {
    if (i) path.lineTo(flat[i] / 100, flat[i + 1] / 100);
    else path.moveTo(flat[i] / 100, flat[i + 1] / 100);
  }
  if (close) path.closePath();
  return path;
}

function mapPaths(scene) {
  if (!scene.paths) {
    scene.paths = {};
    for (const [name, lines] of Object.entries(scene.map)) {
      const path = new Path2D();
      for (const line of lines) trace(path, line, data.areas.includes(name));
      scene.paths[name] = path;
    }
  }
  return scene.paths;
}

// ---- drawing ------------------------------------------------------------------------------------

// Clears a canvas and turns it to metres: y up, `view` holds centre and pixels per metre.
function openSheet(canvas, view) {
  const w = canvas.clientWidth, h = canvas.clientHeight, dpr = window.devicePixelRatio || 1;
  if (!w || !h) return null;
  if (canvas.width !== Math.round(w * dpr)) canvas.width = Math.round(w * dpr);
  if (canvas.height !== Math.round(h * dpr)) canvas.height = Math.round(h * dpr);
  const ctx = canvas.getContext("2d"), k = dpr * view.scale, px = 1 / view.scale;
  ctx.setTransform(1, 0, 0, 1, 0, 0);
  ctx.clearRect(0, 0, canvas.width, canvas.height);
  ctx.setTransform(k, 0, 0, -k, (dpr * w) / 2 - k * view.x, (dpr * h) / 2 + k * view.y);
  return { ctx, w, h, px, dpr };
}

function box(ctx, [x, y, h], length, width) {
  const c = Math.cos(h), s = Math.sin(h), a = length / 2, b = width / 2;
  ctx.beginPath();
  for (const [i, j] of [[a, b], [-a, b], [-a, -b], [a, -b]]) {
    ctx.lineTo(x + i * c - j * s, y + i * s + j * c);
  }
  ctx.closePath();
}

function drawMap(ctx, scene, px) {
  const paths = mapPaths(scene);
  const fill = (path, style) => { ctx.fillStyle = style; ctx.fill(path, "evenodd"); };
  const stroke = (path, style, width, dash = []) => {
    ctx.strokeStyle = style;
    ctx.lineWidth = width * px;
    ctx.setLineDash(dash.map((d) => d * px));
    ctx.stroke(path);
  };
  fill(paths.road, ink.road);
  stroke(paths.road, ink.road_edge, 1);
  fill(paths.route, ink.route);
  fill(paths.crosswalks, ink.crosswalk);
  stroke(paths.crosswalks, ink.road_edge, 1, [3, 3]);
  stroke(paths.lane_edges, ink.lane, 1.4);
  stroke(paths.centerlines, ink.centerline, 0.8, [5, 5]);
  ctx.globalAlpha = 0.5;
  stroke(paths.red, ink.red, 1.5);
  ctx.globalAlpha = 1;
  stroke(paths.stop_bars, ink.red, 4);
  ctx.setLineDash([]);
}

function drawEgo(ctx, center, px) {
  const c = Math.cos(center[2]), s = Math.sin(center[2]);
  box(ctx, center, car.length, car.width);
  ctx.fillStyle = ink.ego;
  ctx.fill();
  ctx.strokeStyle = "#fff";
  ctx.lineWidth = px;
  ctx.stroke();
  ctx.beginPath();
  for (const [a, b] of [[0.4, 0], [0.1, 0.3], [0.1, -0.3]]) {
    const i = a * car.length, j = b * car.width;
    ctx.lineTo(center[0] + i * c - j * s, center[1] + i * s + j * c);
  }
  ctx.fillStyle = "#fff";
  ctx.fill();
}

function drawScaleBar(ctx, scale, h) {
  const size = [5, 10, 20, 50, 100].find((m) => m * scale > 60) ?? 200;
  ctx.fillStyle = ink.ink;
  ctx.fillRect(14, h - 16, size * scale, 3);
  ctx.font = "12px system-ui, sans-serif";
  ctx.fillText(`${size} m`, 14, h - 21);
}
