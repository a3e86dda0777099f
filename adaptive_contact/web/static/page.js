// The live page.  Everything that is shown goes in as text; nothing is ever parsed as HTML.
// Memory is bounded: ticks live in ring buffers of five minutes, marks in lists that are trimmed.
"use strict";

const KEPT_MS = 5 * 60 * 1000;
const MOST_TICKS = 60000; // of a leg: five minutes at 200 Hz
const MOST_MARKS = 2000; // of a leg and kind
const MOST_LEGS = 64;
const LATE_MS = 500; // a leg without ticks for so long is silent
const SILENT_MS = 2500; // the server sends ten frames a second
const GUTTER = 62; // px, left of the plots
const RAD = 1e-4; // angles come in 0.1 mrad
const DEG = 180 / Math.PI;

const $ = (id) => document.getElementById(id);

/** Make an element with text. */
function make(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

/** Set text only where it has changed: a change costs the browser a layout. */
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function setClass(element, className) {
  if (element.className !== className) element.className = className;
}

// -- data ------------------------------------------------------------------------------------

/** Ticks of one leg in a ring: time, swing, test ratio, and J commands, readings, predictions. */
class Ticks {
  constructor(joints, capacity) {
    this.joints = joints;
    this.capacity = capacity;
    this.time = new Float64Array(capacity);
    this.swing = new Int8Array(capacity);
    this.ratio = new Float32Array(capacity);
    this.angles = new Float32Array(capacity * joints * 3);
    this.first = 0;
    this.count = 0;
  }

  at(i) {
    return (this.first + i) % this.capacity;
  }

  push(row) {
    const width = this.joints;
    const given = row.length - 3;
    if (given !== 2 * width && given !== 3 * width) return;
    if (this.count && row[0] <= this.time[this.at(this.count - 1)]) return;
    let at;
    if (this.count < this.capacity) {
      at = this.at(this.count);
      this.count += 1;
    } else {
      at = this.first;
      this.first = (this.first + 1) % this.capacity;
    }
    this.time[at] = row[0];
    this.swing[at] = row[1];
    this.ratio[at] = row[2] === null ? NaN : row[2] / 100;
    for (let j = 0; j < 3 * width; j += 1) {
      const value = j < given ? row[3 + j] : null;
      this.angles[at * width * 3 + j] = value === null ? NaN : value * RAD;
    }
  }

  /** Index of the first tick at or after a time. */
  since(time) {
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[this.at(middle)] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}

/** What is kept of a leg. */
class Leg {
  constructor(name) {
    this.name = name;
    this.ticks = null;
    this.contacts = []; // [time, contact, score, withheld]
    this.truth = []; // [time, contact]
    this.marks = []; // [time, kind]
    this.row = null;
    this.card = null;
  }

  take(rows) {
    if (this.ticks === null) {
      const values = rows[0].length - 3;
      // Three values of a joint, or two before there is a model.
      const named = this.row && this.row.joints ? this.row.joints.length : 0;
      const joints = named || (values % 3 ? values / 2 : values / 3);
      if (!Number.isInteger(joints) || joints < 1 || joints > 64) return;
      const step = rows.length > 1 ? rows[1][0] - rows[0][0] : state.periodMs;
      const period = Math.max(Math.min(state.periodMs || step, 100), 2);
      const capacity = Math.min(Math.ceil(KEPT_MS / period), MOST_TICKS);
      this.ticks = new Ticks(joints, capacity);
    }
    for (const row of rows) this.ticks.push(row);
  }

  /** Time up to which the newest change holds: a leg that is silent may do anything since. */
  knownUntil() {
    const { ticks } = this;
    if (!ticks || !ticks.count) return state.now;
    const newest = ticks.time[ticks.at(ticks.count - 1)];
    return state.now - newest < LATE_MS ? state.now : newest;
  }

  trim(oldest) {
    for (const list of [this.contacts, this.truth, this.marks]) {
      let gone = Math.max(list.length - MOST_MARKS, 0);
      // One older change is kept: it says how the oldest time was.
      while (gone + 1 < list.length && list[gone + 1][0] < oldest) gone += 1;
      if (gone) list.splice(0, gone);
    }
  }
}

const state = {
  legs: new Map(),
  service: null,
  banner: [],
  now: 0, // ms of the server's clock, of the newest frame
  begin: null, // ms, of the oldest frame
  end: null, // ms, right edge while an earlier time is shown; null while live
  span: 10000,
  joint: 1,
  periodMs: 20,
  heardAt: 0,
  opened: null, // name of the leg in the panel
  truth: false,
  trouble: null, // of this page and its server
  over: null, // last words of the server, which will not come back
};

function legOf(name) {
  let leg = state.legs.get(name);
  if (!leg && state.legs.size < MOST_LEGS) {
    leg = new Leg(name);
    state.legs.set(name, leg);
  }
  return leg;
}

/** Put into a list ordered by time; what comes late is a few places from its end. */
function insert(list, entry) {
  let at = list.length;
  while (at > 0 && list[at - 1][0] > entry[0]) at -= 1;
  list.splice(at, 0, entry);
}

function takeFrame(frame) {
  state.now = frame.t;
  if (state.begin === null) state.begin = frame.t;
  state.begin = Math.max(state.begin, frame.t - KEPT_MS);
  for (const [name, rows] of Object.entries(frame.k || {})) legOf(name)?.take(rows);
  for (const [name, t, , contact, score, withheld] of frame.e || []) {
    const leg = legOf(name);
    if (leg) insert(leg.contacts, [t, contact, score, withheld]);
  }
  for (const [name, t, contact] of frame.g || []) {
    const leg = legOf(name);
    if (leg) insert(leg.truth, [t, contact]);
    state.truth = true;
  }
  for (const [name, kind, t] of frame.v || []) {
    const leg = legOf(name);
    if (leg && kind !== "seen") insert(leg.marks, [t, kind]);
  }
  for (const leg of state.legs.values()) leg.trim(state.begin);
}

function takeView(view) {
  state.banner = view.banner;
  state.service = view.service || null;
  if (state.service && state.service.period_ms) state.periodMs = state.service.period_ms;
  const order = view.legs.map((row) => row.leg);
  for (const row of view.legs) {
    const leg = legOf(row.leg);
    if (leg) leg.row = row;
  }
  if (order.length) {
    for (const name of [...state.legs.keys()]) {
      if (!order.includes(name)) removeLeg(name);
    }
    state.legs = new Map([...state.legs].sort((a, b) => order.indexOf(a[0]) - order.indexOf(b[0])));
  }
}

function removeLeg(name) {
  state.legs.get(name).card?.root.remove();
  state.legs.delete(name);
}

// -- stream ----------------------------------------------------------------------------------

let source = null;
let last = "";

function connect() {
  if (source) source.close();
  source = new EventSource(`stream?after=${encodeURIComponent(last)}`);
  source.onmessage = (event) => {
    const session = event.lastEventId.split(".")[0];
    if (last && last.split(".")[0] !== session) forget();
    last = event.lastEventId;
    state.heardAt = performance.now();
    state.trouble = null;
    takeFrame(JSON.parse(event.data));
    schedule();
  };
  source.addEventListener("view", (event) => {
    takeView(JSON.parse(event.data));
    drawTable();
  });
  source.addEventListener("end", (event) => {
    source.close();
    state.over = JSON.parse(event.data);
    drawTable();
  });
  source.onerror = () => {
    if (source.readyState === EventSource.CLOSED) refused();
  };
}

/** The server has begun again: its clock, and so all times, are others. */
function forget() {
  for (const name of [...state.legs.keys()]) removeLeg(name);
  state.begin = null;
  state.end = null;
}

/** An answer that is no stream ends it: say why, and try again. */
async function refused() {
  try {
    const answer = await fetch(`stream?after=${encodeURIComponent(last)}`, { cache: "no-store" });
    if (answer.ok) answer.body.cancel();
    else state.trouble = (await answer.text()).trim();
  } catch {
    // The server is gone; `silence` says so.
  }
  setTimeout(() => {
    if (!document.hidden) connect();
  }, 2000);
}

// A hidden tab takes none of the few connections that a browser has for one server.
document.addEventListener("visibilitychange", () => {
  if (state.over) return;
  if (document.hidden) source?.close();
  else {
    state.heardAt = performance.now();
    connect();
  }
});

function silence() {
  if (state.over) return { level: "note", legs: [], what: state.over, do: "" };
  const quietMs = performance.now() - state.heardAt;
  if (document.hidden || quietMs < SILENT_MS) return null;
  return {
    level: "error",
    legs: [],
    what: state.trouble || `no word of this page's server for ${(quietMs / 1000).toFixed(0)} s`,
    do: state.trouble
      ? "This page tries again by itself."
      : "Start `adaptive-contact watch --web` again. What is shown is the last that came.",
  };
}

// -- colours ---------------------------------------------------------------------------------

let colour = {};
const COLOURS = [
  "stance", "contact", "truth", "command", "reading", "predicted", "ratio", "threshold", "grid",
  "dim", "bad",
];

function readColours() {
  const style = getComputedStyle(document.documentElement);
  colour = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

const dark = matchMedia("(prefers-color-scheme: dark)");
const THEMES = ["auto", "light", "dark"];

function applyTheme() {
  let wanted = "auto";
  try {
    wanted = localStorage.getItem("theme") || "auto";
  } catch {
    // Storage may be forbidden; then the choice lasts for this visit.
  }
  if (!THEMES.includes(wanted)) wanted = "auto";
  const used = wanted === "auto" ? (dark.matches ? "dark" : "light") : wanted;
  document.documentElement.dataset.theme = used;
  setText($("theme"), `◐ ${wanted}`);
  readColours();
  schedule();
}

// -- plots -----------------------------------------------------------------------------------

/** A canvas at the size it has on the screen. */
function prepared(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (!width || !height) return null;
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  pen.textBaseline = "middle";
  return { pen, width: canvas.clientWidth, height: canvas.clientHeight };
}

/** From time to pixels, for the window that is shown. */
function scale(width) {
  const end = state.end === null ? state.now : state.end;
  const begin = end - state.span;
  const per = (width - GUTTER - 4) / state.span;
  return { begin, end, right: width - 4, x: (time) => GUTTER + (time - begin) * per };
}

function gridStep() {
  return [500, 1000, 2000, 5000, 10000, 20000].find((step) => state.span / step <= 7);
}

function drawTime(pen, axis, top, bottom) {
  const step = gridStep();
  pen.strokeStyle = colour.grid;
  pen.fillStyle = colour.dim;
  pen.lineWidth = 1;
  pen.textAlign = "center";
  for (let back = 0; back <= state.now - axis.begin; back += step) {
    const time = state.now - back;
    if (time > axis.end) continue;
    const x = Math.round(axis.x(time)) + 0.5;
    pen.beginPath();
    pen.moveTo(x, top);
    pen.lineTo(x, bottom);
    pen.stroke();
    if (x < axis.right - 12 && x > GUTTER + 14) {
      pen.fillText(back ? `−${back / 1000} s` : "now", x, bottom + 8);
    }
  }
}

function label(pen, text, y) {
  pen.fillStyle = colour.dim;
  pen.textAlign = "left";
  pen.fillText(text, 0, y, GUTTER - 6);
}

/** Blocks where a list of changes says yes; the last goes on until nothing is known any more. */
function drawChanges(pen, axis, list, until, top, height, fill, yes) {
  let since = null;
  const block = (from, to) => {
    const left = Math.max(axis.x(from), GUTTER);
    const right = Math.min(axis.x(to), axis.right);
    if (right > left) pen.fillRect(left, top, Math.max(right - left, 1), height);
  };
  pen.fillStyle = fill;
  for (const entry of list) {
    if (entry[0] > axis.end) break;
    if (yes(entry) && since === null) since = entry[0];
    else if (!yes(entry) && since !== null) {
      block(since, entry[0]);
      since = null;
    }
  }
  if (since !== null) block(since, Math.min(axis.end, until));
}

function drawStance(pen, axis, ticks, from, to, top, height) {
  pen.fillStyle = colour.stance;
  let since = null;
  let before = 0;
  for (let i = from; i < to; i += 1) {
    const at = ticks.at(i);
    const time = ticks.time[at];
    const stands = ticks.swing[at] === 0 && (since === null || time - before < 500);
    if (stands && since === null) since = time;
    if (!stands && since !== null) {
      const left = Math.max(axis.x(since), GUTTER);
      pen.fillRect(left, top, Math.max(axis.x(before) - left, 1), height);
      since = ticks.swing[at] === 0 ? time : null;
    }
    before = time;
  }
  if (since !== null) {
    const left = Math.max(axis.x(since), GUTTER);
    pen.fillRect(left, top, Math.max(Math.min(axis.x(before), axis.right) - left, 1), height);
  }
}

/**
 * A line through one value of each tick.  Where ticks are closer than pixels, a column of pixels
 * spans the lowest and the highest of its ticks: a tick of one contact is never out of sight.
 */
function drawLine(pen, axis, ticks, from, to, value, y) {
  const gap = Math.max(6 * state.periodMs, 150);
  let before = -Infinity;
  let column = -1;
  let low = 0;
  let high = 0;
  let open = false;
  pen.beginPath();
  const flush = () => {
    if (column >= 0 && low !== high) {
      pen.lineTo(column, low);
      pen.lineTo(column, high);
    }
  };
  for (let i = from; i < to; i += 1) {
    const at = ticks.at(i);
    const found = value(at);
    if (Number.isNaN(found)) {
      open = false;
      continue;
    }
    const time = ticks.time[at];
    const x = Math.max(axis.x(time), GUTTER);
    const h = y(found);
    if (!open || time - before > gap) {
      flush();
      pen.moveTo(x, h);
      column = x;
      low = high = h;
      open = true;
    } else if (x - column < 0.7) {
      low = Math.min(low, h);
      high = Math.max(high, h);
    } else {
      flush();
      pen.lineTo(x, h);
      column = x;
      low = high = h;
    }
    before = time;
  }
  flush();
  pen.stroke();
}

/** Command, reading and prediction of one joint. */
function drawJoint(pen, axis, ticks, from, to, joint, top, height) {
  const width = ticks.joints;
  const values = [0, 1, 2].map((row) => (at) => ticks.angles[at * width * 3 + row * width + joint]);
  let least = Infinity;
  let most = -Infinity;
  for (let i = from; i < to; i += 1) {
    const at = ticks.at(i);
    for (const value of values) {
      const found = value(at);
      if (found < least) least = found;
      if (found > most) most = found;
    }
  }
  if (least > most) return;
  const room = Math.max((most - least) * 0.08, (0.04 - (most - least)) / 2, 0.002);
  const bottom = least - room;
  const per = height / (most + room - bottom);
  const y = (angle) => top + height - (angle - bottom) * per;
  pen.fillStyle = colour.dim;
  pen.textAlign = "left";
  pen.fillText(`${(most * DEG).toFixed(1)}°`, 0, top + 6, GUTTER - 6);
  pen.fillText(`${(least * DEG).toFixed(1)}°`, 0, top + height - 5, GUTTER - 6);
  pen.lineJoin = "round";
  // The prediction lies under the reading, and wider: where it is right it frames it.
  pen.lineWidth = 4;
  pen.strokeStyle = colour.predicted;
  drawLine(pen, axis, ticks, from, to, values[2], y);
  pen.lineWidth = 1.2;
  pen.setLineDash([4, 3]);
  pen.strokeStyle = colour.command;
  drawLine(pen, axis, ticks, from, to, values[0], y);
  pen.setLineDash([]);
  pen.lineWidth = 1.4;
  pen.strokeStyle = colour.reading;
  drawLine(pen, axis, ticks, from, to, values[1], y);
}

const RATIO_LOW = 0.03;
const RATIO_HIGH = 30;

/** Test ratio against its threshold, in logarithms: a soft touch and a hard one both show. */
function drawRatio(pen, axis, ticks, from, to, top, height) {
  const log = Math.log(RATIO_HIGH / RATIO_LOW);
  const y = (ratio) => {
    const held = Math.min(Math.max(ratio, RATIO_LOW), RATIO_HIGH);
    return top + height - (Math.log(held / RATIO_LOW) / log) * height;
  };
  pen.strokeStyle = colour.threshold;
  pen.lineWidth = 1;
  pen.setLineDash([2, 3]);
  pen.beginPath();
  pen.moveTo(GUTTER, y(1));
  pen.lineTo(axis.right, y(1));
  pen.stroke();
  pen.setLineDash([]);
  pen.fillStyle = colour.dim;
  pen.textAlign = "right";
  pen.fillText("1", GUTTER - 4, y(1));
  pen.strokeStyle = colour.ratio;
  pen.lineWidth = 1.4;
  drawLine(pen, axis, ticks, from, to, (at) => ticks.ratio[at], y);
}

function drawMarks(pen, axis, marks, y, truthY) {
  for (const [time, kind] of marks) {
    if (time < axis.begin || time > axis.end) continue;
    const x = axis.x(time);
    pen.fillStyle = colour.bad;
    pen.strokeStyle = colour.bad;
    pen.lineWidth = 1.8;
    pen.beginPath();
    if (kind === "false") {
      pen.moveTo(x - 5, y - 5);
      pen.lineTo(x + 5, y - 5);
      pen.lineTo(x, y + 4);
      pen.closePath();
      pen.fill();
    } else {
      pen.arc(x, truthY, 4.5, 0, 2 * Math.PI);
      pen.stroke();
    }
  }
}

function drawLeg(leg) {
  const drawn = prepared(leg.card.canvas);
  if (!drawn) return;
  const { pen, width, height } = drawn;
  const axis = scale(width);
  const bottom = height - 16;
  drawTime(pen, axis, 0, bottom);
  const ticks = leg.ticks;
  const from = ticks ? Math.max(ticks.since(axis.begin) - 1, 0) : 0;
  const to = ticks ? ticks.since(axis.end + 1) : 0;
  const joint = ticks ? Math.min(state.joint, ticks.joints - 1) : 0;
  label(pen, "stance", 8);
  if (ticks) drawStance(pen, axis, ticks, from, to, 3, 10);
  label(pen, "contact", 22);
  const until = leg.knownUntil();
  drawChanges(pen, axis, leg.contacts, until, 17, 10, colour.contact, (entry) => entry[1]);
  if (state.truth) {
    label(pen, "truth", 35);
    drawChanges(pen, axis, leg.truth, until, 32, 6, colour.truth, (entry) => entry[1]);
  }
  drawMarks(pen, axis, leg.marks, 22, 35);
  const names = leg.row && leg.row.joints.length ? leg.row.joints : [];
  const top = state.truth ? 48 : 34;
  const ratioTop = bottom - 44;
  if (ticks) {
    label(pen, names[joint] || `joint ${joint + 1}`, (top + ratioTop - 8) / 2);
    drawJoint(pen, axis, ticks, from, to, joint, top, ratioTop - 8 - top);
    drawRatio(pen, axis, ticks, from, to, ratioTop, 42);
  }
  label(pen, "test ratio", ratioTop + 36);
}

function drawPanel() {
  const leg = state.legs.get(state.opened);
  if (!leg || !$("detail").open) return;
  const plots = $("detail-plots");
  const joints = leg.ticks ? leg.ticks.joints : 0;
  while (plots.children.length > joints) plots.lastChild.remove();
  while (plots.children.length < joints) {
    const box = make("section");
    const head = make("h3");
    head.append(make("b"), make("span"));
    const canvas = make("canvas");
    canvas.height = 120;
    box.append(head, canvas);
    plots.append(box);
    dragged(canvas);
  }
  for (let joint = 0; joint < joints; joint += 1) {
    const [head, canvas] = plots.children[joint].children;
    const row = leg.row || {};
    setText(head.children[0], (row.joints || [])[joint] || `joint ${joint + 1}`);
    const rms = (row.rms || [])[joint];
    const noise = (row.noise || [])[joint];
    setText(
      head.children[1],
      noise ? `residual ${(rms * DEG).toFixed(2)}°, at the start ${(noise * DEG).toFixed(2)}°` : "",
    );
    const drawn = prepared(canvas);
    if (!drawn) continue;
    const { pen, width, height } = drawn;
    const axis = scale(width);
    const ticks = leg.ticks;
    const from = Math.max(ticks.since(axis.begin) - 1, 0);
    const to = ticks.since(axis.end + 1);
    drawTime(pen, axis, 0, height - 16);
    pen.globalAlpha = 0.25;
    drawChanges(pen, axis, leg.contacts, leg.knownUntil(), 0, height - 16, colour.contact, (entry) => entry[1]);
    pen.globalAlpha = 1;
    drawJoint(pen, axis, ticks, from, to, joint, 4, height - 24);
  }
}

let scheduled = false;

function schedule() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    draw();
  });
}

function draw() {
  const oldest = (state.begin ?? 0) + state.span;
  if (state.end !== null && state.end < oldest) state.end = Math.min(oldest, state.now);
  const panel = $("detail").open;
  const covered = panel && innerWidth < 640;
  if (!covered) {
    for (const leg of state.legs.values()) {
      if (!leg.card) addCard(leg);
      if (visible(leg.card.root)) drawLeg(leg);
    }
  }
  if (panel) drawPanel();
  drawScrub();
}

function visible(element) {
  const box = element.getBoundingClientRect();
  return box.bottom > 0 && box.top < innerHeight;
}

function drawScrub() {
  const scrub = $("scrub");
  const begin = Math.min((state.begin ?? 0) + state.span, state.now);
  scrub.min = String(Math.round(begin - state.now));
  scrub.max = "0";
  const back = state.end === null ? 0 : state.end - state.now;
  if (document.activeElement !== scrub || state.end === null) scrub.value = String(Math.round(back));
  setText($("when"), state.end === null ? "now" : `${(-back / 1000).toFixed(1)} s ago`);
  $("live").setAttribute("aria-pressed", String(state.end === null));
}

function lookAt(end) {
  state.end = end >= state.now - 50 ? null : end;
  schedule();
}

/** Drag a plot to look back. */
function dragged(canvas) {
  let held = null;
  let moved = false;
  canvas.addEventListener("pointerdown", (event) => {
    held = { x: event.clientX, end: state.end === null ? state.now : state.end };
    moved = false;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const by = event.clientX - held.x;
    if (Math.abs(by) > 6 && !moved) {
      moved = true;
      canvas.setPointerCapture(event.pointerId);
    }
    if (moved) lookAt(held.end - (by * state.span) / (canvas.clientWidth - GUTTER));
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, () => {
      held = null;
    });
  }
  canvas.addEventListener("click", (event) => {
    if (moved) event.stopPropagation(); // a drag opens no panel
  });
}

// -- table -----------------------------------------------------------------------------------

function addCard(leg) {
  const root = make("section", "leg");
  root.tabIndex = 0;
  root.setAttribute("role", "button");
  const head = make("div", "leg-head");
  const name = make("span", "name", leg.name);
  const contact = make("span", "chip state dim", "unknown");
  const status = make("span", "chip", "?");
  const figures = make("span", "figures");
  head.append(name, contact, status, figures);
  const canvas = make("canvas");
  root.append(head, canvas);
  root.addEventListener("click", () => openPanel(leg.name));
  root.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      openPanel(leg.name);
    }
  });
  dragged(canvas);
  leg.card = { root, contact, status, figures, canvas };
  place();
  fillCard(leg);
}

/** Cards in the order of the legs. */
function place() {
  let before = null;
  for (const leg of state.legs.values()) {
    if (!leg.card) continue;
    const wanted = before ? before.nextSibling : $("legs").firstChild;
    if (wanted !== leg.card.root) $("legs").insertBefore(leg.card.root, wanted);
    before = leg.card.root;
  }
}

const STATUS_CLASS = {
  valid: "good", learning: "warn", adapting: "warn", ambiguous: "bad", silent: "bad",
};

function sum(counts) {
  return Object.values(counts || {}).reduce((all, count) => all + count, 0);
}

function listed(counts) {
  const entries = Object.entries(counts || {}).sort((a, b) => b[1] - a[1]);
  return entries.map(([reason, count]) => `${reason} ${count}`).join(", ");
}

function fillCard(leg) {
  const { row, card } = leg;
  if (!row || !card) return;
  card.root.classList.toggle("stale", Boolean(row.stale));
  card.root.setAttribute("aria-label", `leg ${row.leg}: ${row.status || "unknown"}`);
  const unknown = row.contact === null || row.stale || row.status === "silent";
  const withheld = row.status === "ambiguous" && row.withheld > 0 && !row.contact;
  const free = withheld ? `${row.withheld} withheld` : "free";
  setText(card.contact, unknown ? "unknown" : row.contact ? "CONTACT" : free);
  setClass(
    card.contact,
    `chip state ${unknown ? "dim" : row.contact ? "on" : withheld ? "warn" : ""}`,
  );
  setText(card.status, row.stale ? `${row.status}, stale` : row.status || "?");
  setClass(card.status, `chip ${row.stale ? "bad" : STATUS_CLASS[row.status] || ""}`);
  const figures = [];
  if (row.drift !== undefined) {
    figures.push([`drift ${row.drift.toFixed(1)}`, row.drift > 6 ? "bad" : row.drift > 2.25 ? "warn" : ""]);
    if (row.changed_s !== null) figures.push([`${row.kind || "changed"} ${row.changed_s} s ago`, ""]);
    figures.push([`model v${row.model}`, ""]);
  }
  if (row.touches !== null && row.touches !== undefined) {
    const missed = row.touches - row.seen;
    figures.push([`found ${row.seen}/${row.touches}`, missed ? "warn" : ""]);
    figures.push([`false ${row.false}`, row.false ? "bad" : ""]);
  }
  const lost = row.missed || 0;
  figures.push([`lost ${lost}`, lost ? "warn" : ""]);
  const rejects = sum(row.rejects);
  if (rejects) figures.push([`refused ${rejects}`, "warn"]);
  while (card.figures.children.length > figures.length) card.figures.lastChild.remove();
  figures.forEach(([text, className], i) => {
    if (!card.figures.children[i]) card.figures.append(make("span"));
    setText(card.figures.children[i], text);
    setClass(card.figures.children[i], className);
  });
}

function drawBanner() {
  const quiet = silence();
  const entries = quiet ? [quiet] : state.banner;
  const box = $("banner");
  while (box.children.length > entries.length) box.lastChild.remove();
  entries.forEach((entry, i) => {
    if (!box.children[i]) {
      const made = make("div");
      made.append(make("b"), make("span"), make("span", "do"));
      box.append(made);
    }
    const shown = box.children[i];
    setClass(shown, `entry ${entry.level}`);
    const who = entry.legs.length ? `leg${entry.legs.length > 1 ? "s" : ""} ${entry.legs.join(", ")}` : "";
    setText(shown.children[0], who);
    setText(shown.children[1], entry.what);
    setText(shown.children[2], entry.do);
  });
}

function drawSummary() {
  const service = state.service;
  const quiet = silence();
  const well = !quiet && service && service.connected && service.alive;
  setClass($("dot"), `dot ${well ? "good" : "bad"}`);
  if (!service || service.robot === undefined) {
    setText($("summary"), quiet ? "not connected" : "no service yet");
    return;
  }
  setText($("robot"), service.robot);
  document.title = `${service.robot} – adaptive-contact`;
  const words = [`${service.events} contact events`];
  if (service.p50_ms !== null) words.push(`in to out ${service.p50_ms} ms (p99 ${service.p99_ms})`);
  if (service.events_lost) words.push(`${service.events_lost} events lost`);
  setText($("summary"), words.join(" · "));
}

function drawJoints() {
  const first = [...state.legs.values()].find((leg) => leg.row && leg.row.joints.length);
  const names = first ? first.row.joints : [];
  const select = $("joint");
  const shown = [...select.options].map((option) => option.textContent);
  if (shown.join("\n") === names.join("\n")) return;
  select.replaceChildren(
    ...names.map((name, i) => {
      const option = make("option", "", name);
      option.value = String(i);
      return option;
    }),
  );
  state.joint = Math.min(state.joint, Math.max(names.length - 1, 0));
  select.value = String(state.joint);
}

function drawTable() {
  $("empty").hidden = state.legs.size > 0;
  for (const item of document.querySelectorAll(".truth-only")) item.hidden = !state.truth;
  for (const leg of state.legs.values()) {
    if (!leg.card) addCard(leg);
    fillCard(leg);
  }
  place();
  drawBanner();
  drawSummary();
  drawJoints();
  fillPanel();
}

// -- panel of a leg --------------------------------------------------------------------------

let modelShown = "";

function openPanel(name) {
  state.opened = name;
  modelShown = "";
  $("detail-equations").replaceChildren();
  setText($("detail-refit"), "");
  if (!$("detail").open) $("detail").show();
  $("detail").scrollTop = 0;
  fillPanel();
  schedule();
}

function fillPanel() {
  const leg = state.legs.get(state.opened);
  if (!leg || !leg.row || !$("detail").open) return;
  const row = leg.row;
  setText($("detail-name"), `leg ${row.leg}: ${row.status || "?"}`);
  setText($("detail-note"), row.note || "");
  const facts = [
    ["contacts", `${row.contacts ?? 0}${row.withheld ? `, ${row.withheld} withheld` : ""}`],
    ["samples", `${row.hz ?? 0} per second, ${row.missed ?? 0} lost, ${row.restarts ?? 0} restarts of the source`],
    ["refused", listed(row.rejects) || "none"],
    ["drift", row.drift === undefined ? "–" : `${row.drift.toFixed(2)} (1 without drift)${row.kind ? `, ${row.kind}` : ""}${row.changed_s === null ? "" : `, changed ${row.changed_s} s ago`}`],
    ["residual", row.floor === null || row.floor === undefined ? "–" : `${row.floor.toFixed(2)} times that at the start, worst joint`],
    ["learned from", `${row.swings ?? 0} swings held`],
  ];
  if (row.touches !== null && row.touches !== undefined) {
    const late = row.latency_ms === null ? "" : `, after ${row.latency_ms} ms (median)`;
    facts.unshift(["by truth", `${row.seen} of ${row.touches} touches found${late}, ${row.false} false`]);
  }
  if (row.doubt) facts.unshift(["doubt", row.doubt]);
  const list = $("detail-facts");
  while (list.children.length > 2 * facts.length) list.lastChild.remove();
  facts.forEach(([term, text], i) => {
    if (!list.children[2 * i]) list.append(make("dt"), make("dd"));
    setText(list.children[2 * i], term);
    setText(list.children[2 * i + 1], text);
  });
  setText(
    $("detail-refit"),
    row.model === undefined
      ? "No model yet."
      : `Version ${row.model}. Refits: ${row.promoted} promoted, ${row.refused} refused, ` +
        `${row.rolled_back} rolled back. Last: ${row.reason || "none yet"}.`,
  );
  const wanted = `${row.leg} v${row.model}`;
  if (row.model !== undefined && wanted !== modelShown) {
    modelShown = wanted;
    fillModel(row.leg, wanted);
  }
}

async function fillModel(name, wanted) {
  let lines;
  try {
    const answer = await fetch(`model?leg=${encodeURIComponent(name)}`);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const model = await answer.json();
    lines = model.equations.map((text) => make("div", "equation", text));
    const facts = [];
    if (model.origin) facts.push(`from ${model.origin}`);
    if (model.threshold !== null) facts.push(`threshold ${model.threshold.toFixed(1)}`);
    if (model.library) facts.push(`library ${model.library}`);
    lines.unshift(make("p", "", facts.join(" · ")));
  } catch (error) {
    lines = [make("p", "", `No equations: ${error.message}`)];
  }
  if (modelShown === wanted) $("detail-equations").replaceChildren(...lines);
}

function closePanel() {
  $("detail").close();
  state.opened = null;
  schedule();
}

// -- begin -----------------------------------------------------------------------------------

$("span").addEventListener("change", (event) => {
  state.span = Number(event.target.value);
  schedule();
});
$("joint").addEventListener("change", (event) => {
  state.joint = Number(event.target.value);
  schedule();
});
$("theme").addEventListener("click", () => {
  const now = $("theme").textContent.replace("◐ ", "");
  try {
    localStorage.setItem("theme", THEMES[(THEMES.indexOf(now) + 1) % THEMES.length]);
  } catch {
    // As in `applyTheme`.
  }
  applyTheme();
});
$("live").addEventListener("click", () => lookAt(state.end === null ? state.now - 100 : state.now));
$("scrub").addEventListener("input", (event) => lookAt(state.now + Number(event.target.value)));
$("detail-close").addEventListener("click", closePanel);
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && $("detail").open) closePanel();
});
window.addEventListener("resize", schedule);
window.addEventListener("scroll", schedule, { passive: true });
dark.addEventListener("change", applyTheme);
setInterval(() => {
  drawBanner();
  drawSummary();
}, 1000);
state.heardAt = performance.now();
applyTheme();
connect();
