// The robot from above: its legs as they stand by what is measured, and which feet touch.

import { LATE_MS, state } from "./data.js";
import { $, setText } from "./dom.js";
import { prepared } from "./plots.js";
import { framesStopped } from "./stream.js";
import { colour } from "./theme.js";

const SCHEME = "a scheme: mounts or geometry are not described";
export const feet = new Map(); // where each was drawn last, px
let extent = 0; // mm, of what has been drawn: the picture does not breathe with the gait

/** What is known of a foot: "on", "free" or "withheld"; "unknown" where nothing is. */
function footOf(leg, time) {
  const live = state.end === null;
  if (live && (!leg.row || leg.row.contact === null || framesStopped())) return "unknown";
  if (!live) {
    const i = leg.ticks ? leg.ticks.since(time + 1) - 1 : -1;
    if (i < 0 || time - leg.ticks.time[leg.ticks.at(i)] >= LATE_MS) return "unknown";
  }
  const last = leg.contacts.findLast((change) => change[0] <= time);
  if (!last && !live) return "unknown";
  if (last ? last[1] : leg.row.contact) return "on";
  return last && last[3] ? "withheld" : "free";
}

/** When a leg was measured last, and [x, y, x, y, …] of its joints and foot: mm, x forward, y left. */
const placeOf = (leg, time) => leg.places.findLast((place) => place[0] <= time);

/** Where legs most likely are, by their names (lf, FL, front_left); else in a ring. */
export function schematic(names) {
  const parts = names.map((name) => {
    const words = name.toLowerCase().split(/[_.-]/);
    return words.length > 1 ? words.map((word) => word[0]) : [...words[0].slice(0, 2)];
  });
  const sideSecond = parts.some(([first]) => "fhbm".includes(first));
  const sides = parts.map((part) => ({ l: 1, r: -1 })[part[sideSecond ? 1 : 0]]);
  if (sides.includes(undefined)) {
    return names.map((_, i) => {
      const angle = (2 * Math.PI * (i + 0.5)) / names.length;
      return [60, 200].flatMap((r) => [r * Math.cos(angle), r * Math.sin(angle)]);
    });
  }
  const rank = parts.map((part) => ({ f: 0, m: 1, c: 1 })[part[sideSecond ? 0 : 1]] ?? 2);
  return names.map((_, i) => {
    const row = names.map((_, k) => k).filter((k) => sides[k] === sides[i]);
    row.sort((a, b) => rank[a] - rank[b]);
    const along = row.length > 1 ? 1 - (2 * row.indexOf(i)) / (row.length - 1) : 0;
    return [110 * along, 60 * sides[i], 160 * along, 190 * sides[i]];
  });
}

function drawFoot(pen, x, y, foot) {
  pen.beginPath();
  pen.arc(x, y, 6.5, 0, 2 * Math.PI);
  pen.fillStyle = { on: colour.bad, withheld: colour.withheld, unknown: colour.stance }[foot] || colour.card;
  pen.strokeStyle = foot === "free" ? colour.reading : pen.fillStyle;
  pen.lineWidth = 1.5;
  pen.fill();
  pen.stroke();
}

export function drawAbove() {
  const legs = [...state.legs.values()];
  $("above").hidden = !legs.length;
  const drawn = legs.length ? prepared($("above-canvas")) : null;
  if (!drawn) return;
  const { pen, width, height } = drawn;
  const time = state.end === null ? state.now : state.end;
  const places = legs.map((leg) => placeOf(leg, time));
  const measured = !places.includes(undefined);
  const late = measured && places.some(([since]) => time - since >= LATE_MS);
  const outlines = measured ? places.map((place) => place[1]) : schematic(legs.map((leg) => leg.name));
  const most = Math.max(...outlines.flat().map(Math.abs), 1);
  extent = most > extent || most < extent / 2 ? most : extent;
  const scale = (Math.min(width, height) / 2 - 26) / extent;
  const at = (x, y) => [width / 2 - y * scale, height / 2 - x * scale];
  const body = outlines.map(([x, y]) => [x, y]).sort((a, b) => Math.atan2(a[1], a[0]) - Math.atan2(b[1], b[0]));
  pen.lineJoin = "round";
  pen.lineWidth = 2;
  pen.fillStyle = colour.grid;
  pen.strokeStyle = colour.dim;
  pen.beginPath();
  for (const [x, y] of body) pen.lineTo(...at(x, y));
  pen.closePath();
  pen.fill();
  pen.stroke();
  const [tip, nose] = at(Math.max(...body.map(([x]) => x)), 0);
  pen.fillStyle = colour.dim; // the front
  pen.beginPath();
  pen.moveTo(tip - 6, nose - 5);
  pen.lineTo(tip + 6, nose - 5);
  pen.lineTo(tip, nose - 14);
  pen.fill();
  pen.textAlign = "center";
  outlines.forEach((outline, i) => {
    pen.strokeStyle = colour.dim;
    pen.lineWidth = 2.5;
    pen.beginPath();
    for (let k = 0; k < outline.length; k += 2) pen.lineTo(...at(outline[k], outline[k + 1]));
    pen.stroke();
    const [x, y] = at(outline.at(-2), outline.at(-1));
    feet.set(legs[i].name, [x, y]);
    drawFoot(pen, x, y, footOf(legs[i], time));
    const [dx, dy] = [x - width / 2, y - height / 2];
    const out = 15 / Math.max(Math.hypot(dx, dy), 1);
    pen.fillStyle = colour.reading;
    pen.fillText(legs[i].name, x + dx * out, y + dy * out);
  });
  setText($("above-note"), late ? "as measured last" : measured ? "by measured angles" : SCHEME);
}
