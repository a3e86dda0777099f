// The plots of the opened leg, with one cursor over all of them: test ratio, and each joint's angles.

import { state } from "./data.js";
import { make, setText } from "./dom.js";
import { DEG, drawChanges, drawMarked } from "./plots.js";
import { colour } from "./theme.js";

const uPlot = globalThis.uPlot; // vendored: uPlot.js, MIT licence beside it
const LEFT = 56; // px of every plot, so that times lie above each other
const RATIO = { least: 0.03, most: 30 };

export let charts = []; // the test ratio first, then the joints
let shown = ""; // leg and joints that they are of
let leg = null;

const line = (label, name, more = {}) => ({
  label,
  stroke: () => colour[name],
  width: 1.4,
  points: { show: false },
  spanGaps: false,
  ...more,
});

const figure = (_, value) => (value === null ? "–" : value.toFixed(2));
const degrees = (_, value) => (value === null ? "–" : `${value.toFixed(2)}°`);

/** An axis with ticks in the page's colours. */
const axis = (more) => ({
  stroke: () => colour.dim,
  grid: { stroke: () => colour.grid, width: 1 },
  ticks: { stroke: () => colour.grid, width: 1, size: 4 },
  font: "11px system-ui, sans-serif",
  ...more,
});

const times = axis({
  size: 22,
  space: 60,
  values: (_, splits) => splits.map((value) => (value ? `${value} s` : "now")),
});

const spansOf = (u) => ({
  x: (time) => u.valToPos((time - state.now) / 1000, "x", true),
  begin: state.now + u.scales.x.min * 1000,
  end: state.now + u.scales.x.max * 1000,
  left: u.bbox.left,
  right: u.bbox.left + u.bbox.width,
});

function drawOwn(u) {
  const ratio = u.bbox.width / u.over.clientWidth;
  drawMarked(u.ctx, spansOf(u), u.bbox.top, u.bbox.top + u.bbox.height, u.bbox.top + 9 * ratio, ratio);
}

/** Contacts, withheld contacts and missing samples behind the lines. */
function drawSpans(u) {
  const { left, top, width, height } = u.bbox;
  const pen = u.ctx;
  const spans = spansOf(u);
  const { x, right } = spans;
  pen.save();
  pen.beginPath();
  pen.rect(left, top, width, height);
  pen.clip();
  const gaps = leg.ticks.gaps(...range(leg.ticks, spans));
  pen.fillStyle = colour.grid;
  for (const [since, until] of gaps) pen.fillRect(x(since), top, x(until) - x(since), height);
  pen.globalAlpha = 0.22;
  drawChanges(pen, spans, leg.contacts, gaps, top, height, colour.contact);
  pen.globalAlpha = 1;
  pen.fillStyle = colour.withheld;
  for (const [time, , , withheld] of leg.contacts) {
    if (withheld) pen.fillRect(x(time) - 1.5, top, 3, height);
  }
  if (u.scales.y.distr === 3) {
    pen.strokeStyle = colour.threshold;
    pen.setLineDash([4, 5]);
    pen.beginPath();
    pen.moveTo(left, u.valToPos(1, "y", true));
    pen.lineTo(right, u.valToPos(1, "y", true));
    pen.stroke();
  }
  pen.restore();
}

const range = (ticks, spans) => [Math.max(ticks.since(spans.begin) - 1, 0), ticks.since(spans.end + 1)];

function chart(box, height, y, series) {
  const made = new uPlot(
    {
      width: Math.max(box.clientWidth, 100),
      height,
      legend: { live: true, markers: { width: 2 } },
      cursor: { sync: { key: "leg", setSeries: false, scales: ["x", null] }, y: false, points: { show: false }, drag: { x: false, y: false } },
      scales: { x: { time: false, auto: false }, y: y.scale, p: { range: [0, 1] } },
      axes: [times, y.axis],
      series: [
        { label: "time", value: (_, value) => (value === null ? "–" : `${value.toFixed(2)} s`) },
        ...series,
      ],
      hooks: { drawClear: [drawSpans], draw: [drawOwn] },
    },
    null,
    box,
  );
  charts.push(made);
}

function build(root, names) {
  for (const made of charts) made.destroy();
  charts = [];
  root.replaceChildren();
  const section = (name) => {
    const box = make("section");
    const head = make("h3");
    head.append(make("b", "", name), make("span"));
    box.append(head);
    root.append(box);
    return box;
  };
  chart(
    section("test ratio"),
    150,
    {
      scale: { distr: 3, range: [RATIO.least, RATIO.most] },
      axis: axis({
        size: LEFT,
        values: (_, splits) => splits.map((value) => ([0.1, 1, 10].includes(value) ? String(value) : "")),
      }),
    },
    [line("test ratio", "ratio", { value: figure }), line("p", "carries", { scale: "p", value: figure })],
  );
  const room = (_, least, most) => {
    const around = Math.max((most - least) * 0.08, (2.4 - (most - least)) / 2, 0.1);
    return [least - around, most + around];
  };
  for (const name of names) {
    chart(
      section(name),
      170,
      {
        scale: { range: (u, least, most) => (least === null ? [-1, 1] : room(u, least, most)) },
        axis: axis({ size: LEFT, values: (_, splits) => splits.map((value) => `${value}°`) }),
      },
      [
        line("prediction", "predicted", { width: 4, value: degrees }),
        line("command", "command", { width: 1.2, dash: [4, 3], value: degrees }),
        line("reading", "reading", { value: degrees }),
      ],
    );
  }
}

/** Columns of the ticks that are shown; where ticks are missing, a row of nulls. */
function columns(ticks, from, to) {
  const width = ticks.joints;
  const gap = Math.max(6 * state.periodMs, 150);
  const found = Array.from({ length: 3 + 3 * width }, () => []);
  let before = null;
  const known = (value) => (Number.isNaN(value) ? null : value);
  for (let i = from; i < to; i += 1) {
    const at = ticks.at(i);
    const time = ticks.time[at];
    if (before !== null && time - before > gap) {
      found[0].push(((time + before) / 2 - state.now) / 1000);
      for (const column of found.slice(1)) column.push(null);
    }
    before = time;
    found[0].push((time - state.now) / 1000);
    const ratio = known(ticks.ratio[at]);
    found[1].push(ratio === null ? null : Math.min(Math.max(ratio, RATIO.least), RATIO.most));
    for (let k = 0; k < 3 * width; k += 1) {
      const value = known(ticks.angles[at * width * 3 + k]);
      found[2 + k].push(value === null ? null : value * DEG);
    }
    found[2 + 3 * width].push(known(ticks.p[at]));
  }
  return found;
}

export function drawCharts(root, of) {
  leg = of;
  const ticks = leg.ticks;
  const names = (leg.row && leg.row.joints) || [];
  const wanted = ticks ? `${leg.name} ${ticks.joints} ${names.join(" ")}` : "";
  if (wanted !== shown) {
    shown = wanted;
    build(root, ticks ? Array.from({ length: ticks.joints }, (_, j) => names[j] || `joint ${j + 1}`) : []);
  }
  if (!ticks) return;
  const end = state.end === null ? state.now : state.end;
  const [from, to] = range(ticks, { begin: end - state.span, end });
  const found = columns(ticks, from, to);
  const width = ticks.joints;
  charts.forEach((made, i) => {
    const box = root.children[i];
    if (i) {
      const row = leg.row || {};
      const [rms, noise] = [(row.rms || [])[i - 1], (row.noise || [])[i - 1]];
      const words = `residual ${(rms * DEG).toFixed(2)}°, at the start ${(noise * DEG).toFixed(2)}°`;
      setText(box.firstChild.children[1], noise ? words : "");
    } else setText(box.firstChild.children[1], "a contact is above 1; p, that the foot carries: 0 to 1");
    if (box.clientWidth && box.clientWidth !== made.width) made.setSize({ width: box.clientWidth, height: made.height });
    const lines = i ? [2, 0, 1].map((row) => found[2 + row * width + i - 1]) : [found[1], found[2 + 3 * width]];
    made.batch(() => {
      made.setData([found[0], ...lines], false);
      made.setScale("x", { min: (end - state.span - state.now) / 1000, max: (end - state.now) / 1000 });
    });
    // The pointer rests, and the lines go on under it: say what is there now.
    const { left, top } = made.cursor;
    if (left >= 0) {
      made.setCursor({ left, top }, false, false);
      made.setLegend({ idx: made.cursor.idx }, false); // the same place of other data, often
    }
  });
}
