// The live page: it draws what has come, and takes what is chosen.

import { drawAbove } from "./above.js";
import { state } from "./data.js";
import { $, drawnBy, schedule } from "./dom.js";
import { drawScrub, lookAt } from "./look.js";
import { listenForMarks } from "./marks.js";
import { closePanel, drawPanel } from "./panel.js";
import { drawLeg } from "./plots.js";
import { listenForRecording } from "./recording.js";
import { follow } from "./stream.js";
import { addCard, drawTable } from "./table.js";
import { applyTheme, nextTheme } from "./theme.js";

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
  if (!covered) drawAbove();
  if (panel) drawPanel();
  drawScrub();
}

function visible(element) {
  const box = element.getBoundingClientRect();
  return box.bottom > 0 && box.top < innerHeight;
}

$("span").addEventListener("change", (event) => {
  state.span = Number(event.target.value);
  schedule();
});
$("joint").addEventListener("change", (event) => {
  state.joint = Number(event.target.value);
  schedule();
});
$("theme").addEventListener("click", nextTheme);
$("live").addEventListener("click", () => lookAt(state.end === null ? state.now - 100 : state.now));
$("scrub").addEventListener("input", (event) => lookAt(state.now + Number(event.target.value)));
$("detail-close").addEventListener("click", closePanel);
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && $("detail").open) closePanel();
});
listenForMarks();
listenForRecording();
window.addEventListener("resize", schedule);
new ResizeObserver(schedule).observe($("legs")); // a banner comes, and plots have less room
window.addEventListener("scroll", schedule, { passive: true });
setInterval(drawTable, 100);
drawnBy(draw);
applyTheme();
follow(drawTable);
