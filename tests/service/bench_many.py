"""Many legs of one robot.toml through the whole service, for minutes; a script, not a test.

    make many LEGS=N MINUTES=M [MANY_OPTIONS=--realtime]

Two processes: `serve` with its own learners, its state and its refits, and this one, which walks N
legs at 50 Hz each and times their events.  The legs are copies of the shipped hexapod's, with its
baseline; a minute of a simulated walk is walked again and again, each time with a new `run`.

A line every ten seconds, and at the end: samples lost and whether they were counted, latency of
events from the put of the deciding sample on, memory and its slope over the last half, and which
thread took which share of a core.  The exit code is 1 where a sample was lost that nobody counted,
an event was lost, a leg has no learner, or memory still grows by more than 0.17 MB/min at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from adaptive_contact.model import shipped_baseline
from adaptive_contact.model.model_file import dump_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    MSGPACK,
    ContactEvent,
    LearnerStatus,
    Message,
    decode,
    encode,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import Program, children_of, resident_mb
from soak.memory import slope_of

PERIOD_S = 0.02
WALK_S = 60.0
SHIFT_TICKS = 17
# A service that has just started reports every leg free, and does everything for the first time.
START_S = 2.0
SLOPE_S = 330.0  # ten minutes have a slope, too
REPORT_S = 10.0
WARM_UP_S = 120.0
# As the soak has it: 5 MB in half an hour.
MOST_SLOPE_MB_MIN = 5.0 / 30.0
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
M = TypeVar("M", bound=Message)


def described(folder: Path, legs: int) -> tuple[Path, Path, list[str]]:
    """robot.toml and baseline of so many legs, and of which shipped leg each is a copy."""
    robot = shipped_robot()
    baseline = json.loads(dump_baseline(shipped_baseline(robot.name)))
    lines = [f'[robot]\nname = "{robot.name}"\nperiod_s = {robot.period_s}']
    lines += [f"quantum_rad = {robot.quantum_rad}", f"[servo]\nslope_rad = {robot.servo.slope_rad}"]
    known, copies = baseline["legs"], []
    baseline["legs"] = {}
    for at in range(legs):
        leg = robot.legs[at % len(robot.legs)]
        copies.append(leg.id)
        lines += [
            f'[[leg]]\nid = "{leg.id}{at}"',
            f"joints = {json.dumps(list(leg.joints))}",
            f"axes = {json.dumps(list(leg.axes or ()))}",
            f"lengths_m = {json.dumps(list(leg.lengths_m or ()))}",
        ]
        baseline["legs"][f"{leg.id}{at}"] = known[leg.id]
    config, file = folder / "robot.toml", folder / "baseline.json"
    config.write_text("\n".join(lines) + "\n")
    file.write_text(json.dumps(baseline))
    return config, file, copies


class Feeder(threading.Thread):
    """Walks the legs at 50 Hz.

    Attributes:
        sent: samples put, of each leg.
        behind_s: the furthest that the schedule was missed by.
    """

    def __init__(self, link: Link, copies: list[str], seconds: float) -> None:
        from adaptive_contact_sim import (
            Simulation,
            SimulationSettings,
            TerrainSettings,
            WalkSettings,
        )

        super().__init__(daemon=True)
        settings = SimulationSettings(
            motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=2901
        )
        self._walk = [dict(tick.samples) for tick in Simulation(settings).run(WALK_S)]
        self._legs = [(leg, f"{leg}{at}") for at, leg in enumerate(copies)]
        self._publishers = [link.publisher(servo_key(own)) for _, own in self._legs]
        self._ticks = int(seconds / PERIOD_S)
        self.sent = 0
        self.behind_s = 0.0
        self.put_ns = np.zeros((self._ticks, len(copies)), dtype=np.int64)
        self._began_s = time.time_ns() // 1_000_000_000

    def run(self) -> None:
        due = time.monotonic()
        for seq in range(self._ticks):
            for number, (leg, _) in enumerate(self._legs):
                # Copies of a leg are not in step: a robot's legs do not touch all at once.
                lap, at = divmod(seq + SHIFT_TICKS * number, len(self._walk))
                stamped = msgspec.structs.replace(
                    self._walk[at][leg], t_ns=seq * 20_000_000, seq=seq, run=self._began_s + lap
                )
                payload = encode(stamped)
                self.put_ns[seq, number] = time.monotonic_ns()
                self._publishers[number].put_raw(payload, MSGPACK)
            self.sent = seq + 1
            due += PERIOD_S
            self.behind_s = max(self.behind_s, time.monotonic() - due)
            time.sleep(max(0.0, due - time.monotonic()))


class Collected:
    """What the service says; callbacks only keep it."""

    def __init__(self, link: Link) -> None:
        self.events: list[Received] = []
        self.legs: dict[str, LearnerStatus] = {}
        self.service: ServiceStatus | None = None
        link.subscribe(ALL_CONTACT, self.events.append)
        link.subscribe(ALL_LEARNER, lambda got: self._leg(_read(got, LearnerStatus)))
        link.subscribe(SERVICE_STATUS, self._service, history=True)

    def _leg(self, status: LearnerStatus) -> None:
        self.legs[status.leg] = status

    def _service(self, got: Received) -> None:
        self.service = _read(got, ServiceStatus)

    def rejects(self) -> Counter[str]:
        """Of all legs and of none, but for silent ones."""
        found: Counter[str] = Counter()
        for status in list(self.legs.values()):
            found.update(status.rejects)
        if self.service is not None:
            found.update(self.service.rejects)
        return found


def _read(got: Received, kind: type[M]) -> M:
    message = decode(got.payload, kind, got.encoding)
    assert isinstance(message, kind), message
    return message


class Used(NamedTuple):
    """Processor time of a process, s, by its threads' names, and its memory, MB."""

    threads: Counter[str]
    memory_mb: float

    @property
    def total_s(self) -> float:
        return sum(self.threads.values())


def used(process: int) -> Used:
    """What a process has used so far; of threads that have ended, nothing."""
    threads: Counter[str] = Counter()
    for task in Path(f"/proc/{process}/task").iterdir():
        try:
            name, _, rest = (task / "stat").read_text().rpartition(")")
        except OSError:  # ended since
            continue
        fields = rest.split()
        label = "main" if task.name == str(process) else name.split("(", 1)[1].rstrip("0123456789-")
        threads[label] += (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
    return Used(threads, resident_mb(process))


def latencies_ms(heard: Collected, feeder: Feeder, copies: list[str]) -> np.ndarray:
    """``(n, 2)``: number of the deciding sample, and ms from its put to the event's arrival."""
    at = {f"{leg}{number}": number for number, leg in enumerate(copies)}
    found = []
    for got in heard.events:
        event = _read(got, ContactEvent)
        took_ns = got.arrival_ns - feeder.put_ns[event.seq, at[event.leg]]
        found.append((event.seq, took_ns / 1e6))
    return np.array(found).reshape(-1, 2)


def quantiles(late: np.ndarray) -> dict[str, float]:
    """Of latencies, ms."""
    if not len(late):
        return {}
    return {
        name: round(float(np.quantile(late[:, 1], at)), 2)
        for name, at in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0))
    }


def slope_mb_min(rows: list[tuple[float, float]]) -> float | None:
    """Of memory over the last half, or 330 s where that is longer; None in a shorter run."""
    last_s = rows[-1][0] if rows else 0.0
    half_s = min(last_s / 2.0, last_s - SLOPE_S)
    return slope_of([row for row in rows if row[0] >= half_s])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--legs", type=int, default=64)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--realtime", action="store_true", help="serve --realtime")
    parser.add_argument("--out", type=Path, default=Path("out/many"))
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as state:
        return served(chosen, state)


def served(chosen: argparse.Namespace, state: str) -> int:
    """Start the service, walk its legs, and end it."""
    config, baseline, copies = described(chosen.out, chosen.legs)
    words = (
        *("-m", "adaptive_contact", "serve", "--listen", "127.0.0.1:0"),
        *("--config", config, "--baseline", baseline, "--state", state),
        *(["--realtime"] if chosen.realtime else []),
    )
    began = time.monotonic()
    with (
        (chosen.out / "serve.log").open("w") as log,
        contextlib.closing(Program(*words, stderr=log)) as serve,
    ):
        endpoint = serve.wait_line("listening on ([^;]+);", 600.0)[1]
        print(f"the service was ready after {time.monotonic() - began:.1f} s", flush=True)
        with Link.open(client_settings([endpoint], wait=False)) as link:
            service = serve.process.pid
            return walked(link, service, copies, chosen.minutes * 60.0, chosen.out)


def walked(link: Link, service: int, copies: list[str], seconds: float, out: Path) -> int:
    """Walk, report every ten seconds, and judge."""
    heard = Collected(link)
    feeder = Feeder(link, copies, seconds)
    started = time.monotonic()
    before, before_s = used(service), time.monotonic()
    first = before
    memory: list[tuple[float, float]] = []
    feeder.start()
    while feeder.is_alive():
        feeder.join(REPORT_S)
        now, now_s = used(service), time.monotonic()
        memory.append((now_s - started, now.memory_mb))
        share = (now.total_s - before.total_s) / (now_s - before_s)
        before, before_s = now, now_s
        status = heard.service
        tick = None if status is None else status.tick_latency
        ticks = sum(leg.ticks for leg in list(heard.legs.values()))
        missed = sum(leg.missed for leg in list(heard.legs.values()))
        print(
            f"{now_s - started:5.0f} s  {feeder.sent * len(copies)} sent, {ticks} used, "
            f"{missed} missed, {len(heard.events)} events, {now.memory_mb:.0f} MB, "
            f"{share:.2f} cores, tick p99 {'-' if tick is None else f'{tick.p99:.1f}'} ms, "
            f"load {os.getloadavg()[0]:.1f}",
            flush=True,
        )
    took_s = time.monotonic() - started
    end_ns = (feeder.sent - 1) * 20_000_000
    until = time.monotonic() + 20
    # Two seconds after its last sample a leg has told of it, or never will.
    while time.monotonic() < until and any(leg.t_ns < end_ns for leg in heard.legs.values()):
        time.sleep(0.1)
    time.sleep(2.5)
    return judged(heard, feeder, copies, memory, first, used(service), took_s, service, out)


def judged(
    heard: Collected,
    feeder: Feeder,
    copies: list[str],
    memory: list[tuple[float, float]],
    first: Used,
    last: Used,
    took_s: float,
    service: int,
    out: Path,
) -> int:
    sent = feeder.sent * len(copies)
    legs = list(heard.legs.values())
    used_ = sum(leg.ticks for leg in legs)
    missed = sum(leg.missed for leg in legs)
    # Each lap is a start of the source: a sample lost just before it is in no gap.
    edges = int(feeder.sent * PERIOD_S / WALK_S) + 1
    late = latencies_ms(heard, feeder, copies)
    slope = slope_mb_min(memory)
    status = heard.service
    told = sum(leg.contacts for leg in legs)
    arrived = sum(_read(got, ContactEvent).contact for got in heard.events)
    found = {
        "legs": len(copies),
        "minutes": took_s / 60.0,
        "load": os.getloadavg()[1],
        "samples_sent": sent,
        "samples_used": used_,
        "samples_missed_and_counted": missed,
        "samples_uncounted": sent - used_ - missed,
        "feeder_behind_s": feeder.behind_s,
        "rejects": dict(heard.rejects()),
        "statuses": dict(Counter(leg.status for leg in legs)),
        "contacts_told": told,
        "contacts_arrived": arrived,
        "events_lost": status.events_lost,
        "refits": {
            name: sum(getattr(leg.refits, name) for leg in legs)
            for name in ("promoted", "refused", "rolled_back")
        },
        "event_ms": quantiles(late[late[:, 0] >= START_S / PERIOD_S]),
        "event_ms_of_the_start": quantiles(late[late[:, 0] < START_S / PERIOD_S]),
        "service_event_ms": msgspec.to_builtins(status.event_latency),
        "service_tick_ms": msgspec.to_builtins(status.tick_latency),
        "memory_mb": {
            "after_warm_up": next((mb for at, mb in memory if at >= WARM_UP_S), None),
            "last": last.memory_mb,
            "slope_mb_min": slope,
            "workers": sum(map(resident_mb, children_of(service))),
        },
        "cores": {
            name: (seconds - first.threads[name]) / took_s
            for name, seconds in last.threads.most_common(8)
        },
        "cores_in_all": (last.total_s - first.total_s) / took_s,
    }
    (out / "many.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1))
    wrong = [
        f"{len(legs)} of {len(copies)} legs have a learner" if len(legs) != len(copies) else "",
        f"{sent - used_ - missed} samples lost that nobody counted"
        if not 0 <= sent - used_ - missed <= edges * len(copies)
        else "",
        f"{status.events_lost} events lost" if status.events_lost else "",
        f"{told - arrived} contacts told that did not come" if told != arrived else "",
        f"memory still grows by {slope:.2f} MB/min"
        if slope is not None and slope > MOST_SLOPE_MB_MIN
        else "",
    ]
    for line in filter(None, wrong):
        print(f"not well: {line}")
    return 1 if any(wrong) else 0


if __name__ == "__main__":
    sys.exit(main())
