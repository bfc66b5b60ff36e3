// Runs the scripts of a page without a browser: elements remember what they are given, drawing
// calls check their numbers. Prints what the given script returns, as JSON.
//
//   node fake_page.js PAGE SCRIPT

const fs = require("fs");

const [page, script] = process.argv.slice(2);
const text = fs.readFileSync(page, "utf8");
const json = [...text.matchAll(/<script type="application\/json" id="([^"]*)">([\s\S]*?)<\/script>/g)];
const code = [...text.matchAll(/<script>\n([\s\S]*?)<\/script>/g)].map((m) => m[1]).join("\n");
const drawn = {};

const context = new Proxy({}, {
  get: (target, name) => (name in target ? target[name] : (...given) => {
    for (const v of given) {
      if (typeof v === "number" && !Number.isFinite(v)) throw new Error(`${String(name)}(${given})`);
    }
    drawn[name] = (drawn[name] ?? 0) + 1;
    return { width: 10 };
  }),
});

class Element {
  constructor(tag) {
    Object.assign(this, { tag, children: [], style: {}, attributes: {}, listeners: {}, dataset: {}, hidden: false });
    Object.assign(this, { clientWidth: 800, clientHeight: 500, textContent: "", value: "", checked: false });
    this.classList = { toggle() {}, add() {}, remove() {} };
  }

  append(...nodes) { this.children.push(...nodes); }

  replaceChildren(...nodes) { this.children = nodes; }

  setAttribute(name, value) { this.attributes[name] = value; }

  addEventListener(name, listener) { this.listeners[name] = listener; }

  querySelector() { return new Element("any"); }

  querySelectorAll() { return []; }

  getContext() { return context; }

  getBoundingClientRect() { return { left: 0, top: 0, width: 800, height: 500 }; }

  setPointerCapture() {}

  fire(name, event = {}) { this.listeners[name]({ target: this, preventDefault() {}, ...event }); }

  text() {
    return [this.textContent, ...this.children.map((c) => (c.text ? c.text() : c))].filter((t) => t !== "").join(" ");
  }
}

const nodes = Object.fromEntries(json.map(([, id, content]) => [id, Object.assign(new Element("script"), { textContent: content })]));
const find = (name) => (nodes[name] ??= new Element("any"));
global.document = { getElementById: find, createElement: (tag) => new Element(tag), addEventListener() {}, querySelector: find, querySelectorAll: () => [] };
global.window = { devicePixelRatio: 1 };
global.Path2D = class { lineTo() {} moveTo() {} closePath() {} };
global.ResizeObserver = class {
  constructor(listener) { this.listener = listener; }

  observe() { this.listener(); }

  unobserve() {}
};
global.nodes = nodes;
global.drawn = drawn;
console.log(JSON.stringify(eval(`${code}\n;(() => { ${script} })()`)));
