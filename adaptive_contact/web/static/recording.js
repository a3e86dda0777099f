// Start and stop of a recording on the computer of this page's server, where its owner allows it.

import { state } from "./data.js";
import { $, setClass, setText } from "./dom.js";

let refusal = "";

/** Ask the server to do something; what it refuses is said beside the button. */
export async function act(path, query = {}) {
  try {
    const answer = await fetch(`${path}?${new URLSearchParams(query)}`, {
      method: "POST",
      headers: { "X-Adaptive-Contact": "page" }, // no other site can send it
    });
    if (answer.ok) state.recording = await answer.json();
    refusal = answer.ok ? "" : (await answer.text()).trim();
  } catch {
    refusal = "this page's server does not answer";
  }
  drawRecording();
}

const size = (bytes) => (bytes < 1e6 ? `${Math.round(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);

export function drawRecording() {
  const { recording } = state;
  $("recording").hidden = !recording;
  if (!recording) return;
  setText($("record"), recording.running ? "■ stop" : "● record");
  setClass($("record"), recording.running ? "on" : "");
  const made = recording.file ? `${recording.file}, ${size(recording.bytes)}, ${recording.seconds} s` : "";
  setText($("recorded"), refusal || recording.error || made);
}

export function listenForRecording() {
  $("record").addEventListener("click", () => act(state.recording?.running ? "record/stop" : "record/start"));
}
