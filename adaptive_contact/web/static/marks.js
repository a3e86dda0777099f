// Marks of one's own: a moment with a label, over all plots, while the page is open.

import { state } from "./data.js";
import { $, make, schedule } from "./dom.js";
import { lookAt } from "./look.js";
import { act } from "./recording.js";

const MOST = 200;
let count = 0;

const clock = (wall) => new Date(wall).toTimeString().slice(0, 8);

/** Mark now, or the right edge of what is looked at; a recording that runs gets it, too. */
export function addMark() {
  if (state.clockMs === null) return;
  const time = Math.round(state.end === null ? state.now : state.end);
  count += 1;
  const label = $("mark-label").value.trim() || `mark ${count}`;
  const wall = state.clockMs + time;
  state.marked = [...state.marked, [wall, label, `${clock(wall)} ${label}`]].slice(-MOST);
  list();
  schedule();
  if (state.recording?.running) act("mark", { t: time, label });
}

function list() {
  $("marks").replaceChildren(
    ...state.marked.toReversed().map(([wall, , text]) => {
      const item = make("li");
      const button = make("button", "", text);
      button.type = "button";
      button.addEventListener("click", () => lookAt(wall - state.clockMs + state.span / 2));
      item.append(button);
      return item;
    }),
  );
}

export function listenForMarks() {
  $("mark").addEventListener("click", addMark);
  document.addEventListener("keydown", (event) => {
    const label = event.target === $("mark-label");
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (label ? event.key !== "Enter" : event.key !== "m") return;
    if (label) event.target.blur();
    addMark();
  });
}
