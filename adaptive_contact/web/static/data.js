// What is kept of each leg.  Memory is bounded: ticks live in ring buffers of five minutes, marks in
// lists that are trimmed.

const KEPT_MS = 5 * 60 * 1000;
const MOST_TICKS = 60000; // of a leg: five minutes at 200 Hz
const MOST_MARKS = 3000; // of a leg and kind: five minutes of ten a second
const MOST_LEGS = 64;
export const LATE_MS = 500; // what is older says nothing of now: a leg's ticks, the server's frames
const RAD = 1e-4; // angles come in 0.1 mrad

/** Ticks of one leg in a ring: time, swing, test ratio, p, and J commands, readings, predictions. */
class Ticks {
  constructor(joints, capacity) {
    this.joints = joints;
    this.capacity = capacity;
    this.time = new Float64Array(capacity);
    this.swing = new Int8Array(capacity);
    this.ratio = new Float32Array(capacity);
    this.p = new Float32Array(capacity); // probability that the foot carries
    this.angles = new Float32Array(capacity * joints * 3);
    this.first = 0;
    this.count = 0;
  }

  at(i) {
    return (this.first + i) % this.capacity;
  }

  push(row) {
    const width = this.joints;
    const given = row.length - 4;
    if (given !== 2 * width && given !== 3 * width) return;
    if (this.count && row[0] <= this.time[this.at(this.count - 1)]) return;
    let at;
    if (this.count < this.capacity) {
      at = this.at(this.count);
      this.count += 1;
    } else {
      at = this.first;
      this.first = (this.first + 1) % this.capacity;
    }
    this.time[at] = row[0];
    this.swing[at] = row[1];
    this.ratio[at] = row[2] === null ? NaN : row[2] / 100;
    this.p[at] = row[3] === null ? NaN : row[3] / 100;
    for (let j = 0; j < 3 * width; j += 1) {
      const value = j < given ? row[4 + j] : null;
      this.angles[at * width * 3 + j] = value === null ? NaN : value * RAD;
    }
  }

  /** Index of the first tick at or after a time. */
  since(time) {
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[this.at(middle)] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Times between which ticks did not come, [since, until], among ticks from one to another. */
  gaps(from, to) {
    const found = [];
    for (let i = from; i < to; i += 1) {
      const since = this.time[this.at(i)];
      const until = i + 1 < this.count ? this.time[this.at(i + 1)] : state.now;
      if (until - since >= LATE_MS) found.push([since, until]);
    }
    return found;
  }
}

/** What is kept of a leg. */
class Leg {
  constructor(name) {
    this.name = name;
    this.ticks = null;
    this.contacts = []; // [time, contact, score, withheld]
    this.truth = []; // [time, contact]
    this.marks = []; // [time, kind]
    this.places = []; // [time, [x, y, …]] of its joints and its foot, mm
    this.row = null;
    this.card = null;
  }

  take(rows) {
    if (this.ticks === null) {
      const values = rows[0].length - 4;
      // Three values of a joint, or two before there is a model.
      const named = this.row && this.row.joints ? this.row.joints.length : 0;
      const joints = named || (values % 3 ? values / 2 : values / 3);
      if (!Number.isInteger(joints) || joints < 1 || joints > 64) return;
      const step = rows.length > 1 ? rows[1][0] - rows[0][0] : state.periodMs;
      const period = Math.max(Math.min(state.periodMs || step, 100), 2);
      const capacity = Math.min(Math.ceil(KEPT_MS / period), MOST_TICKS);
      this.ticks = new Ticks(joints, capacity);
    }
    for (const row of rows) this.ticks.push(row);
  }

  trim(oldest) {
    for (const list of [this.contacts, this.truth, this.marks, this.places]) {
      let gone = Math.max(list.length - MOST_MARKS, 0);
      // One older change is kept: it says how the oldest time was.
      while (gone + 1 < list.length && list[gone + 1][0] < oldest) gone += 1;
      if (gone) list.splice(0, gone);
    }
  }
}

export const state = {
  legs: new Map(),
  service: null,
  banner: [],
  now: 0, // ms of the server's clock, of the newest frame
  begin: null, // ms, of the oldest frame
  end: null, // ms, right edge while an earlier time is shown; null while live
  span: 10000,
  joint: 1,
  periodMs: 20,
  heardAt: 0,
  opened: null, // name of the leg in the panel
  truth: false,
  trouble: null, // of this page and its server
  clockMs: null, // wall clock at time 0
  marked: [], // [wall clock ms, label, text] of one's own marks
  recording: null, // the newest one; null where this page may make none
  over: null, // last words of the server, which will not come back
};

function legOf(name) {
  let leg = state.legs.get(name);
  if (!leg && state.legs.size < MOST_LEGS) {
    leg = new Leg(name);
    state.legs.set(name, leg);
  }
  return leg;
}

/** Put into a list ordered by time; what comes late is a few places from its end. */
function insert(list, entry) {
  let at = list.length;
  while (at > 0 && list[at - 1][0] > entry[0]) at -= 1;
  list.splice(at, 0, entry);
}

export function takeFrame(frame) {
  state.now = frame.t;
  if (state.begin === null) state.begin = frame.t;
  state.begin = Math.max(state.begin, frame.t - KEPT_MS);
  for (const [name, rows] of Object.entries(frame.k || {})) legOf(name)?.take(rows);
  for (const [name, places] of Object.entries(frame.f || {})) {
    const measured = frame.k?.[name]?.at(-1)[0] ?? frame.t;
    legOf(name)?.places.push([measured, places]);
  }
  for (const [name, t, , contact, score, withheld] of frame.e || []) {
    const leg = legOf(name);
    if (leg) insert(leg.contacts, [t, contact, score, withheld]);
  }
  for (const [name, t, contact] of frame.g || []) {
    const leg = legOf(name);
    if (leg) insert(leg.truth, [t, contact]);
    state.truth = true;
  }
  for (const [name, kind, t] of frame.v || []) {
    const leg = legOf(name);
    if (leg && kind !== "seen") insert(leg.marks, [t, kind]);
  }
  for (const leg of state.legs.values()) leg.trim(state.begin);
}

export function takeView(view) {
  state.banner = view.banner;
  state.clockMs = view.clock_ms;
  state.recording = view.recording;
  state.service = view.service || null;
  if (state.service && state.service.period_ms) state.periodMs = state.service.period_ms;
  const order = view.legs.map((row) => row.leg);
  for (const row of view.legs) {
    const leg = legOf(row.leg);
    if (leg) leg.row = row;
  }
  if (order.length) {
    for (const name of [...state.legs.keys()]) {
      if (!order.includes(name)) removeLeg(name);
    }
    state.legs = new Map([...state.legs].sort((a, b) => order.indexOf(a[0]) - order.indexOf(b[0])));
  }
}

function removeLeg(name) {
  state.legs.get(name).card?.root.remove();
  state.legs.delete(name);
}

/** The server has begun again: its clock, and so all times, are others. */
export function forget() {
  for (const name of [...state.legs.keys()]) removeLeg(name);
  state.begin = null;
  state.end = null;
}
