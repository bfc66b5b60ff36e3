// Draws what `html.py` writes into #data, with the help of canvas.js, which comes first.

const LAST = 40; // steps of 0.1 s

const state = {
  scene: data.index,
  planner: 0,
  compare: false,
  term: data.terms[0].key,
  step: 0,
  pinned: data.planners.map(() => null),
  hover: null, // {planner, proposal}
  view: { x: 0, y: 0, scale: 8 }, // centre in m, pixels per m
  timer: null,
};
let panels = [];

// ---- reading ------------------------------------------------------------------------------------

const planOf = (planner) => data.planners[planner].scenes[state.scene];
const pinnedOr = (planner) => state.pinned[planner] ?? planOf(planner).best;

function shownProposal(planner) {
  return state.hover && state.hover.planner === planner ? state.hover.proposal : pinnedOr(planner);
}

// The forecast has a sample every 0.2 s; in between the boxes move evenly.
function objectPose(plan, scene, i, step) {
  const future = plan.forecast[i];
  if (!future) return step === 0 ? pose(scene.objects[i].pose, 0) : null;
  const low = Math.floor(step / 2);
  return step % 2 ? mix(pose(future, low), pose(future, low + 1), 0.5) : pose(future, low);
}

function color(score) {
  if (score === null) return data.noScore;
  const stops = data.scale;
  const at = Math.min(Math.max(score, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const part = (hex, k) => parseInt(hex.slice(1 + 2 * k, 3 + 2 * k), 16);
  const channel = (k) => {
    const a = part(stops[low], k);
    return Math.round(a + (at - low) * (part(stops[low + 1], k) - a));
  };
  return `rgb(${channel(0)},${channel(1)},${channel(2)})`;
}

// ---- paths, built once per scene ----------------------------------------------------------------

function proposalPaths(plan) {
  if (!plan.paths) {
    plan.paths = plan.states.map((flat) => {
      const points = [];
      for (let i = 0; i <= LAST; i += 1) {
        const p = pose(flat, i);
        if (p) points.push(p);
      }
      const path = new Path2D();
      let length = 0;
      points.forEach(([x, y], i) => {
        if (!i) return path.moveTo(x, y);
        length += Math.hypot(x - points[i - 1][0], y - points[i - 1][1]);
        return path.lineTo(x, y);
      });
      return { path, points, length };
    });
    // Shorter ones on top: on a shared path each shows its own colour as far as it reaches alone.
    plan.order = plan.paths.map((_, i) => i).sort((a, b) => plan.paths[b].length - plan.paths[a].length);
  }
  return plan.paths;
}

// ---- drawing ------------------------------------------------------------------------------------

function drawObjects(ctx, scene, plan, px) {
  scene.objects.forEach((object, i) => {
    const look = data.kinds[object.kind];
    const future = plan.forecast[i];
    if (future) {
      ctx.beginPath();
      for (let k = 0; k <= LAST / 2; k += 1) {
        const p = pose(future, k);
        if (p) ctx.lineTo(p[0], p[1]);
      }
      ctx.strokeStyle = look.color;
      ctx.lineWidth = 1.2 * px;
      ctx.stroke();
    }
    const here = objectPose(plan, scene, i, state.step);
    const known = here || pose(object.pose, 0);
    box(ctx, known, object.size[0] / 100, object.size[1] / 100);
    ctx.globalAlpha = here ? 1 : 0.25;
    ctx.fillStyle = look.color;
    ctx.fill();
    ctx.strokeStyle = ink.ink;
    ctx.lineWidth = 0.9 * px;
    ctx.setLineDash(plan.ignored[i] ? [2 * px, 2 * px] : []);
    ctx.stroke();
    ctx.setLineDash([]);
    ctx.globalAlpha = 1;
  });
}

function drawProposals(ctx, plan, shown, px) {
  const lines = proposalPaths(plan);
  const values = plan.scores[state.term];
  ctx.lineCap = ctx.lineJoin = "round";
  const one = (i, width, casing) => {
    const { path, points } = lines[i];
    const end = points[points.length - 1];
    const dot = (radius, style) => {
      if (!end) return;
      ctx.fillStyle = style;
      ctx.beginPath();
      ctx.arc(end[0], end[1], radius * px, 0, 2 * Math.PI);
      ctx.fill();
    };
    if (casing) {
      ctx.strokeStyle = casing;
      ctx.lineWidth = (width + 3) * px;
      ctx.stroke(path);
      dot(width + 2.7, casing);
    }
    ctx.strokeStyle = color(values[i]);
    ctx.lineWidth = width * px;
    ctx.stroke(path);
    dot(width + 1.2, color(values[i]));
  };
  for (const i of plan.order) one(i, 1 + (values[i] ?? 0));
  one(plan.best, 3, ink.ink);
  if (shown !== plan.best) one(shown, 3.5, "#1f78d1");
}

function drawMoment(ctx, scene, moment, px) {
  const outline = (p, length, width, dash, fill) => {
    box(ctx, p, length, width);
    if (fill) { ctx.fillStyle = fill; ctx.fill(); }
    ctx.strokeStyle = ink.failure;
    ctx.lineWidth = 2 * px;
    ctx.setLineDash(dash.map((d) => d * px));
    ctx.stroke();
    ctx.setLineDash([]);
  };
  outline(pose(moment.ego, 0), car.length, car.width, [5, 3], "#ffffff60");
  if (moment.ahead) outline(pose(moment.ahead, 0), car.length, car.width, [1.5, 3], null);
  const there = moment.pose && pose(moment.pose, 0);
  if (there) {
    const object = scene.objects[moment.object];
    const fill = `${data.kinds[object.kind].color}c0`;
    outline(there, object.size[0] / 100, object.size[1] / 100, [5, 3], fill);
  }
}

function drawLabel(ctx, view, w, h, moment, scene) {
  const text = [moment.label];
  if (moment.object >= 0) {
    const object = scene.objects[moment.object];
    const id = object.id.length > 12 ? `${object.id.slice(0, 8)}…` : object.id;
    text.push(`${data.kinds[object.kind].name} ${id}`);
  }
  const at = pose(moment.pose ?? moment.ego, 0);
  const x = w / 2 + (at[0] - view.x) * view.scale;
  const y = h / 2 - (at[1] - view.y) * view.scale;
  ctx.font = "12.5px system-ui, sans-serif";
  const width = Math.max(...text.map((t) => ctx.measureText(t).width)) + 14;
  const height = 16 * text.length + 8;
  // In the nearest corner that does not hide the place itself; the scale bar has the fourth.
  const corners = [[6, 6], [w - width - 6, 6], [w - width - 6, h - height - 6]];
  const away = ([cx, cy]) => {
    const d = Math.hypot(cx + width / 2 - x, cy + height / 2 - y);
    return d > 150 ? d : 1e4 - d;
  };
  const [left, top] = corners.reduce((a, c) => (away(c) < away(a) ? c : a));
  ctx.strokeStyle = ink.failure;
  ctx.lineWidth = 1.2;
  ctx.beginPath();
  ctx.moveTo(x, y);
  ctx.lineTo(left + width / 2, top + height / 2);
  ctx.stroke();
  ctx.fillStyle = "#fff";
  ctx.fillRect(left, top, width, height);
  ctx.strokeRect(left, top, width, height);
  ctx.fillStyle = ink.ink;
  text.forEach((t, i) => ctx.fillText(t, left + 7, top + 17 + 16 * i));
}

function draw(panel) {
  const { canvas, planner } = panel;
  const scene = data.scenes[state.scene], plan = planOf(planner), view = state.view;
  const sheet = openSheet(canvas, view);
  if (!sheet) return;
  const { ctx, w, h, px, dpr } = sheet;
  const shown = shownProposal(planner), moving = pinnedOr(planner);
  drawMap(ctx, scene, px);
  drawObjects(ctx, scene, plan, px);
  drawProposals(ctx, plan, shown, px);
  const rear = pose(plan.states[moving], state.step);
  if (rear) drawEgo(ctx, egoCenter(rear), px);
  const moment = plan.moments[shown];
  if (moment) drawMoment(ctx, scene, moment, px);
  ctx.setTransform(dpr, 0, 0, dpr, 0, 0);
  if (moment) drawLabel(ctx, view, w, h, moment, scene);
  drawScaleBar(ctx, view.scale, h);
}
