// A card of each leg, the banner above them, and the line on top.

import { state } from "./data.js";
import { $, make, schedule, setClass, setText } from "./dom.js";
import { dragged } from "./look.js";
import { fillPanel, openPanel } from "./panel.js";
import { drawRecording } from "./recording.js";
import { framesStopped, silence } from "./stream.js";

export function addCard(leg) {
  const root = make("section", "leg");
  root.tabIndex = 0;
  root.setAttribute("role", "button");
  const head = make("div", "leg-head");
  const name = make("span", "name", leg.name);
  const contact = make("span", "chip state dim", "unknown");
  const status = make("span", "chip", "waiting");
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

function fillCard(leg) {
  const { row, card } = leg;
  if (!row || !card) return;
  card.root.classList.toggle("stale", Boolean(row.stale));
  card.root.setAttribute("aria-label", `leg ${row.leg}: ${row.status || "unknown"}`);
  const unknown = row.contact === null || framesStopped();
  const withheld = row.status === "ambiguous" && row.withheld > 0 && !row.contact;
  const free = withheld ? `${row.withheld} withheld` : "free";
  setText(card.contact, unknown ? "unknown" : row.contact ? "CONTACT" : free);
  setClass(
    card.contact,
    `chip state ${unknown ? "dim" : row.contact ? "on" : withheld ? "warn" : ""}`,
  );
  setText(card.status, row.stale ? `${row.status}, stale` : row.status || "waiting");
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

export function drawTable() {
  $("empty").hidden = state.legs.size > 0;
  for (const item of document.querySelectorAll(".truth-only")) item.hidden = !state.truth;
  for (const leg of state.legs.values()) {
    if (!leg.card) addCard(leg);
    fillCard(leg);
  }
  place();
  const count = state.legs.size;
  const columns = String(count === 4 ? 2 : Math.min(Math.max(count, 1), 3));
  if ($("legs").style.getPropertyValue("--columns") !== columns) {
    $("legs").style.setProperty("--columns", columns);
    schedule(); // plots have another size now
  }
  drawBanner();
  drawSummary();
  drawJoints();
  drawRecording();
  fillPanel();
}
