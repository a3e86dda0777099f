// The stream of frames from the server, and what is said where it stops.

import { LATE_MS, forget, state, takeFrame, takeView } from "./data.js";
import { schedule } from "./dom.js";

const SILENT_MS = 2500; // the server sends ten frames a second

export let source = null;
let last = "";
let drawView = () => {};

/** Take frames and views as they come; `drawing` draws what a view has changed. */
export function follow(drawing) {
  drawView = drawing;
  state.heardAt = performance.now();
  connect();
}

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
    drawView();
  });
  source.addEventListener("end", (event) => {
    source.close();
    state.over = JSON.parse(event.data);
    drawView();
  });
  source.onerror = () => {
    if (source.readyState === EventSource.CLOSED) refused();
  };
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

/** Whether nothing is known of any leg: the server's frames do not come. */
export function framesStopped() {
  return performance.now() - state.heardAt > LATE_MS;
}

export function silence() {
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
