// Plots over time on canvases: stance, contacts, angles, test ratio.

import { state } from "./data.js";
import { colour } from "./theme.js";

export const GUTTER = 62; // px, left of the plots
export const DEG = 180 / Math.PI;

/** A canvas at the size it has on the screen. */
export function prepared(canvas) {
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
export function scale(width) {
  const end = state.end === null ? state.now : state.end;
  const begin = end - state.span;
  const per = (width - GUTTER - 4) / state.span;
  return { begin, end, right: width - 4, x: (time) => GUTTER + (time - begin) * per };
}

function gridStep() {
  return [500, 1000, 2000, 5000, 10000, 20000].find((step) => state.span / step <= 7);
}

export function drawTime(pen, axis, top, bottom) {
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

/** Times without ticks: nothing is known of the leg. */
export function drawGaps(pen, axis, gaps, height) {
  pen.textAlign = "center";
  for (const [since, until] of gaps) {
    const left = Math.max(axis.x(since), GUTTER);
    const width = Math.min(axis.x(until), axis.right) - left;
    pen.fillStyle = colour.grid;
    if (width > 0) pen.fillRect(left, 0, width, height);
    pen.fillStyle = colour.dim;
    if (width > 70) pen.fillText("no samples", left + width / 2, height / 2);
  }
}

/** Blocks where changes [time, yes] say yes; what they say ends in a gap, until the next change. */
export function drawChanges(pen, axis, list, gaps, top, height, fill) {
  let since = null;
  const block = (from, to) => {
    const left = Math.max(axis.x(from), axis.left ?? GUTTER);
    const right = Math.min(axis.x(to), axis.right);
    if (right >= left) pen.fillRect(left, top, Math.max(right - left, 1), height);
  };
  const ends = gaps.map((gap) => [gap[0], false]);
  pen.fillStyle = fill;
  for (const [time, yes] of [...list, ...ends].sort((a, b) => a[0] - b[0])) {
    if (time > axis.end) break;
    if (yes && since === null) since = time;
    else if (!yes && since !== null) {
      block(since, time);
      since = null;
    }
  }
  if (since !== null) block(since, Math.min(axis.end, state.now));
}

function drawStance(pen, axis, ticks, from, to, gaps, top, height) {
  const changes = [];
  for (let i = from; i < to; i += 1) {
    const at = ticks.at(i);
    changes.push([ticks.time[at], ticks.swing[at] === 0]);
  }
  drawChanges(pen, axis, changes, gaps, top, height, colour.stance);
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
export function drawJoint(pen, axis, ticks, from, to, joint, top, height) {
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
  for (const value of height > 90 ? [0.1, 1, 10] : [1]) pen.fillText(String(value), GUTTER - 4, y(value));
  pen.strokeStyle = colour.ratio;
  pen.lineWidth = 1.4;
  drawLine(pen, axis, ticks, from, to, (at) => ticks.ratio[at], y);
  // The probability that the foot carries, from 0 at the bottom to 1 at the top.
  pen.strokeStyle = colour.carries;
  pen.lineWidth = 1;
  drawLine(pen, axis, ticks, from, to, (at) => ticks.p[at], (p) => top + height * (1 - p));
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

/** One's own marks, with their labels; `left` to `right` are times from `begin` to `end`. */
export function drawMarked(pen, { begin, end, x }, top, bottom, labelY, ratio = 1) {
  pen.save();
  pen.font = `${11 * ratio}px system-ui, sans-serif`;
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  for (const [wall, , text] of state.marked) {
    const time = wall - state.clockMs;
    if (time < begin || time > end) continue;
    const at = x(time);
    pen.fillStyle = colour.card;
    pen.globalAlpha = 0.7; // what is under the label is seen
    const wide = pen.measureText(text).width + 6 * ratio;
    pen.fillRect(at + 2 * ratio, labelY - 7 * ratio, wide, 14 * ratio);
    pen.globalAlpha = 1;
    pen.fillStyle = colour.accent;
    pen.fillRect(at - ratio / 2, top, 1.5 * ratio, bottom - top);
    pen.fillText(text, at + 5 * ratio, labelY);
  }
  pen.restore();
}

export function drawLeg(leg) {
  const drawn = prepared(leg.card.canvas);
  if (!drawn) return;
  const { pen, width, height } = drawn;
  const axis = scale(width);
  const bottom = height - 16;
  const ticks = leg.ticks;
  const from = ticks ? Math.max(ticks.since(axis.begin) - 1, 0) : 0;
  const to = ticks ? ticks.since(axis.end + 1) : 0;
  const gaps = ticks ? ticks.gaps(from, to) : [];
  drawGaps(pen, axis, gaps, bottom);
  drawTime(pen, axis, 0, bottom);
  const joint = ticks ? Math.min(state.joint, ticks.joints - 1) : 0;
  label(pen, "stance", 8);
  if (ticks) drawStance(pen, axis, ticks, from, to, gaps, 3, 10);
  label(pen, "contact", 22);
  drawChanges(pen, axis, leg.contacts, gaps, 17, 10, colour.contact);
  if (state.truth) {
    label(pen, "truth", 35);
    drawChanges(pen, axis, leg.truth, gaps, 32, 6, colour.truth);
  }
  pen.fillStyle = colour.withheld;
  for (const [time, , , withheld] of leg.contacts) {
    if (withheld && time >= axis.begin && time <= axis.end) pen.fillRect(axis.x(time) - 1.5, 16, 3, 12);
  }
  drawMarks(pen, axis, leg.marks, 22, 35);
  const names = leg.row && leg.row.joints.length ? leg.row.joints : [];
  const top = state.truth ? 48 : 34;
  const tall = Math.max(42, (bottom - top) * 0.35); // of the test ratio
  const ratioTop = bottom - tall - 2;
  if (ticks) {
    label(pen, names[joint] || `joint ${joint + 1}`, (top + ratioTop - 8) / 2);
    drawJoint(pen, axis, ticks, from, to, joint, top, ratioTop - 8 - top);
    drawRatio(pen, axis, ticks, from, to, ratioTop, tall);
  }
  label(pen, "test ratio", ratioTop + tall - 6);
  drawMarked(pen, axis, 0, bottom, top + 6);
}
