// The player of drives: what `drive_page.py` writes into #data, with the help of canvas.js.

const state = {
  scene: 0,
  drive: 0,
  step: 0,
  follow: true,
  view: { x: 0, y: 0, scale: 8 }, // centre in m, pixels per m
  timer: null,
};

const sceneNow = () => data.scenes[state.scene];
const driveNow = () => sceneNow().drives[state.drive];
const lastStep = () => driveNow().speed.length - 1;
const PLAN = "#1f78d1", WAY = "#14213d";

// ---- drawing ------------------------------------------------------------------------------------

function line(ctx, flat, from, to, style, width, px, center = (p) => p) {
  ctx.beginPath();
  for (let i = from; i <= to; i += 1) {
    const p = pose(flat, i);
    if (p) ctx.lineTo(...center(p).slice(0, 2));
  }
  ctx.strokeStyle = style;
  ctx.lineWidth = width * px;
  ctx.lineJoin = "round";
  ctx.stroke();
}

function drawLights(ctx, scene, drive, px) {
  // Statuses come as [first step, lanes that are red from then on].
  let red = [];
  scene.lit ??= [];
  for (const [from, lanes] of drive.lights) if (from <= state.step) red = lanes;
  for (const i of red) {
    scene.lit[i] ??= scene.connectors[i].map((flat) => trace(new Path2D(), flat, false));
    const [center, bar] = scene.lit[i];
    ctx.strokeStyle = ink.red;
    ctx.globalAlpha = 0.5;
    ctx.lineWidth = 1.5 * px;
    ctx.stroke(center);
    ctx.globalAlpha = 1;
    ctx.lineWidth = 4 * px;
    ctx.stroke(bar);
  }
}

function drawObjects(ctx, drive, blamed, px) {
  drive.objects.forEach((object, i) => {
    const here = pose(object.pose, state.step - object.first);
    if (!here || state.step < object.first) return;
    box(ctx, here, object.size[0] / 100, object.size[1] / 100);
    ctx.fillStyle = data.kinds[object.kind].color;
    ctx.fill();
    ctx.strokeStyle = blamed.has(object.id) ? ink.failure : ink.ink;
    ctx.lineWidth = (blamed.has(object.id) ? 2.5 : 0.9) * px;
    ctx.stroke();
  });
}

function draw() {
  const scene = sceneNow(), drive = driveNow(), ego = egoCenter(pose(drive.ego, state.step));
  if (state.follow) [state.view.x, state.view.y] = ego;
  const sheet = openSheet($("canvas"), state.view);
  if (!sheet) return;
  const { ctx, h, px, dpr } = sheet;
  const lost = drive.lost.filter((l) => l.step !== null && Math.abs(l.step - state.step) <= 3);
  drawMap(ctx, scene, px);
  drawLights(ctx, scene, drive, px);
  line(ctx, drive.ego, 0, lastStep(), "#14213d50", 1.5, px, egoCenter);
  line(ctx, drive.ego, 0, state.step, WAY, 2.5, px, egoCenter);
  const plan = drive.plans?.[state.step];
  if (plan) line(ctx, plan, 0, plan.length / 3 - 1, PLAN, 3, px, egoCenter);
  drawObjects(ctx, drive, new Set(lost.map((l) => l.object)), px);
  drawEgo(ctx, ego, px);
  for (const { step } of drive.lost) {
    if (step === null) continue;
    box(ctx, egoCenter(pose(drive.ego, step)), car.length, car.width);
    ctx.strokeStyle = ink.failure;
    ctx.lineWidth = 1.5 * px;
    ctx.setLineDash([4 * px, 3 * px]);
    ctx.stroke();
    ctx.setLineDash([]);
  }
  ctx.setTransform(dpr, 0, 0, dpr, 0, 0);
  drawScaleBar(ctx, state.view.scale, h);
}

// ---- text ---------------------------------------------------------------------------------------

function writeDrive() {
  const drive = driveNow();
  const rows = element("table");
  for (const { title, value } of drive.scores) {
    const row = element("tr", undefined, value !== null && value < 1 ? { class: "lost" } : {});
    row.append(element("td", title), element("td", fixed(value, 3)));
    rows.append(row);
  }
  $("scores").replaceChildren(element("h2", `${sceneNow().drives[state.drive].name}: ${fixed(drive.score, 3)}`), rows);
  const list = element("ul");
  for (const { step, title, detail } of drive.lost) {
    const item = element("li");
    const text = `${title}: ${detail}`;
    if (step === null) item.textContent = text;
    else {
      const button = element("button", `${(step / 10).toFixed(1)} s  ${text}`, { type: "button" });
      button.addEventListener("click", () => { play(false); setStep(step); });
      item.append(button);
    }
    list.append(item);
  }
  $("lost").replaceChildren(element("h2", drive.lost.length ? "Lost points" : "No points lost"), list);
  $("marks").replaceChildren(...drive.lost.filter((l) => l.step !== null).map(({ step, title, detail }) => {
    const mark = element("button", undefined, { type: "button", title: `${title}: ${detail}`, "aria-label": `${title} at ${step / 10} s` });
    mark.style.left = `${(100 * step) / Math.max(lastStep(), 1)}%`;
    mark.addEventListener("click", () => { play(false); setStep(step); });
    return mark;
  }));
  $("time").max = String(lastStep());
  const samples = [["the way so far", WAY], ...(drive.plans ? [["the plan now", PLAN]] : [])];
  $("legend").replaceChildren(...samples.map(([text, style]) => {
    const node = element("span"), sample = element("i", undefined, { class: "line" });
    sample.style.background = style;
    node.append(sample, text);
    return node;
  }), ...data.kinds.filter((_, k) => drive.objects.some((o) => o.kind === k)).map((kind) => {
    const node = element("span"), sample = element("i");
    sample.style.background = kind.color;
    node.append(sample, kind.name);
    return node;
  }));
}

function setStep(step) {
  state.step = Math.min(Math.max(step, 0), lastStep());
  $("time").value = String(state.step);
  $("clock").textContent = `${(state.step / 10).toFixed(1)} s  ${driveNow().speed[state.step].toFixed(1)} m/s`;
  draw();
}

function play(on) {
  clearInterval(state.timer);
  state.timer = null;
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  if (state.step === lastStep()) setStep(0);
  state.timer = setInterval(() => {
    if (state.step < lastStep()) setStep(state.step + 1);
    else play(false);
  }, 100);
}

function fitView() {
  let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (let i = 0; i <= lastStep(); i += 1) {
    const p = pose(driveNow().ego, i);
    low = low.map((v, k) => Math.min(v, p[k]));
    high = high.map((v, k) => Math.max(v, p[k]));
  }
  const canvas = $("canvas"), room = [0, 1].map((k) => Math.max(high[k] - low[k] + 30, 60));
  state.view = {
    x: (low[0] + high[0]) / 2,
    y: (low[1] + high[1]) / 2,
    scale: Math.min(canvas.clientWidth / room[0], canvas.clientHeight / room[1]) || 8,
  };
}

function follow(on) {
  state.follow = on;
  $("follow").checked = on;
}

function showDrive(drive) {
  state.drive = drive;
  $("drive").value = String(drive);
  writeDrive();
  setStep(state.step);
}

function showScene(index) {
  play(false);
  state.scene = (index + data.scenes.length) % data.scenes.length;
  state.step = 0;
  $("scene").value = String(state.scene);
  fill("drive", sceneNow().drives.map((d, i) => [i, d.name]));
  const drive = Math.min(state.drive, sceneNow().drives.length - 1);
  state.view.scale = 6;
  follow(true);
  showDrive(drive);
}

function fill(id, labels) {
  $(id).replaceChildren(...labels.map(([value, text]) => element("option", text, { value })));
}

// ---- input --------------------------------------------------------------------------------------

function listen(canvas) {
  let grip = null;
  canvas.addEventListener("pointerdown", (event) => {
    grip = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!grip) return;
    follow(false);
    state.view.x -= (event.clientX - grip[0]) / state.view.scale;
    state.view.y += (event.clientY - grip[1]) / state.view.scale;
    grip = [event.clientX, event.clientY];
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { grip = null; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    state.view.scale = Math.min(Math.max(state.view.scale * Math.exp(-0.0015 * lines * event.deltaY), 1), 200);
    draw();
  }, { passive: false });
}

fill("scene", data.scenes.map((s, i) => [i, `${i + 1}. ${s.type} (${s.token})`]));
listen($("canvas"));
$("scene").addEventListener("change", (e) => showScene(Number(e.target.value)));
$("before").addEventListener("click", () => showScene(state.scene - 1));
$("after").addEventListener("click", () => showScene(state.scene + 1));
$("drive").addEventListener("change", (e) => showDrive(Number(e.target.value)));
$("follow").addEventListener("change", (e) => { follow(e.target.checked); draw(); });
$("fit").addEventListener("click", () => { follow(false); fitView(); draw(); });
$("time").addEventListener("input", (e) => { play(false); setStep(Number(e.target.value)); });
$("play").addEventListener("click", () => play(state.timer === null));
document.addEventListener("keydown", (event) => {
  if (event.target.closest("select, input, button")) return;
  const actions = {
    ArrowLeft: () => setStep(state.step - 1),
    ArrowRight: () => setStep(state.step + 1),
    " ": () => play(state.timer === null),
    n: () => showScene(state.scene + 1),
    p: () => showScene(state.scene - 1),
  };
  const action = actions[event.key];
  if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  action();
});
showScene(0);
new ResizeObserver(draw).observe($("canvas"));
