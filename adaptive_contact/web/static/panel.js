// The panel of one leg: plots of all its joints, figures, the equations of its model.

import { drawCharts } from "./charts.js";
import { state } from "./data.js";
import { $, make, schedule, setText } from "./dom.js";

let modelShown = "";

export function openPanel(name) {
  state.opened = name;
  modelShown = "";
  $("detail-equations").replaceChildren();
  setText($("detail-refit"), "");
  if (!$("detail").open) $("detail").show();
  $("detail").scrollTop = 0;
  fillPanel();
  schedule();
}

export function fillPanel() {
  const leg = state.legs.get(state.opened);
  if (!leg || !leg.row || !$("detail").open) return;
  const row = leg.row;
  setText($("detail-name"), `leg ${row.leg}: ${row.status || "waiting"}`);
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

export function closePanel() {
  $("detail").close();
  state.opened = null;
  schedule();
}

function listed(counts) {
  const entries = Object.entries(counts || {}).sort((a, b) => b[1] - a[1]);
  return entries.map(([reason, count]) => `${reason} ${count}`).join(", ");
}

export function drawPanel() {
  const leg = state.legs.get(state.opened);
  if (leg && $("detail").open) drawCharts($("detail-plots"), leg);
}
