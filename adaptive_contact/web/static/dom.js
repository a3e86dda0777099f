// Elements of the page, and when it draws.  Everything that is shown goes in as text; nothing is ever
// parsed as HTML.

export const $ = (id) => document.getElementById(id);

/** Make an element with text. */
export function make(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

/** Set text only where it has changed: a change costs the browser a layout. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setClass(element, className) {
  if (element.className !== className) element.className = className;
}

let draw = () => {};
let scheduled = false;

/** Name what draws the page. */
export function drawnBy(drawing) {
  draw = drawing;
}

/** Draw with the browser's next frame. */
export function schedule() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    draw();
  });
}
