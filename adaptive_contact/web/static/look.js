// Which time is shown: now, or what was.

import { state } from "./data.js";
import { $, schedule, setText } from "./dom.js";
import { GUTTER } from "./plots.js";

export function drawScrub() {
  const scrub = $("scrub");
  const begin = Math.min((state.begin ?? 0) + state.span, state.now);
  scrub.min = String(Math.round(begin - state.now));
  scrub.max = "0";
  const back = state.end === null ? 0 : state.end - state.now;
  if (document.activeElement !== scrub || state.end === null) scrub.value = String(Math.round(back));
  setText($("when"), state.end === null ? "now" : `${(-back / 1000).toFixed(1)} s ago`);
  $("live").setAttribute("aria-pressed", String(state.end === null));
}

export function lookAt(end) {
  state.end = end >= state.now - 50 ? null : end;
  schedule();
}

/** Drag a plot to look back. */
export function dragged(canvas) {
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
