"""The bridge's figures on three virtual ports with 18 AX-12A: `make bench-bridge`; no test.

    python tests/bridge/bench_bridge.py [NAME ...] [--minutes N] [--no-realtime] [--workers]

Everything runs as a user runs it: a virtual robot (packets take their time on the wire, physics
in real time), the bridge with a process per port and the real DynamixelSDK, Zenoh, a router, and a
controller that commands all legs at 50 Hz.  Names are permanent:

- ``bridge_cycle``: cycle time, jitter of publication, and missed cycles, for N minutes;
- ``bridge_silent_servo``: the same for a minute in which a servo does not answer;
- ``bridge_reconnect``: from the cable put back to the first sample, five times.

Cycle time and jitter come as quantiles of ten seconds and a port; the verdict is on a bound for
the p99 of the whole run, put together from all of them.  Missed cycles are counted twice: by the
bridge, and as gaps in ``seq`` of what arrives here; both have to be 0.  A virtual computer stands
still now and then, for everybody; so the figures of a bare bus (:mod:`bare`) that ran all along
stand beside: the bridge's over those is what the bridge is answerable for.

The bytes of a pseudo-terminal pass through workers of the kernel, which have no priority: on a
computer with other work each of a cycle's 24 passages may wait for it, by milliseconds.  With
``--workers`` those that exist run before ordinary processes too, while this runs (as root); that
is the nearest to an idle computer that a busy one gives.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import queue
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bare import BareBus  # beside this file

from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.wire import (
    BridgeStatus,
    Command,
    Quantiles,
    Rejected,
    ServoSample,
    command_key,
    decode,
    leg_of_key,
    servo_key,
)
from programs import Program

PERIOD_S = 0.02
# Of a status' quantiles; after so long they are of what is to be measured alone.
WINDOW_S = 10.0
SILENT = 3
# Of different lengths, so that they end at different moments of the tries to open the port again.
OUTAGES_S = (1.5, 1.63, 1.76, 1.89, 2.02)
LEGS = shipped_robot().leg_ids

CYCLE_MS, SILENT_MS, JITTER_MS, RECONNECT_S = 12.0, 20.0, 2.0, 2.0


class Options(NamedTuple):
    """How the benchmarks run."""

    seconds: float
    realtime: bool
    workers: bool


class Verdict(NamedTuple):
    """One figure against what it has to be."""

    what: str
    got: float
    wanted: float
    unit: str

    def __str__(self) -> str:
        word = "ok" if self.got <= self.wanted else "MISSED"
        return f"  {self.what:<44} {self.got:8.2f} {self.unit:<6} <= {self.wanted:g}  {word}"


class Workers:
    """The kernel's workers for terminals, before ordinary processes for a while."""

    def __init__(self) -> None:
        self._raised: set[int] = set()

    def raise_all(self) -> None:
        """Raise those that there are now; they come and go."""
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) in self._raised:
                continue
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                if (entry / "comm").read_text().startswith("kworker/u"):
                    os.sched_setscheduler(int(entry.name), os.SCHED_RR, os.sched_param(30))
                    self._raised.add(int(entry.name))

    def lower_all(self) -> None:
        """As they were."""
        for number in self._raised:
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(number, os.SCHED_OTHER, os.sched_param(0))
        self._raised.clear()


class Ears:
    """What arrives; Zenoh's threads only append."""

    def __init__(self, link: Link, workers: Workers | None) -> None:
        self.workers = workers
        self.samples: list[tuple[float, str, bytes, str]] = []
        self.statuses: queue.Queue[BridgeStatus] = queue.Queue()
        link.subscribe(servo_key("*"), self._sample)
        link.subscribe("robot/bridge/*/status", self._status)

    def _sample(self, received) -> None:
        self.samples.append(
            (time.monotonic(), leg_of_key(received.key), received.payload, received.encoding)
        )

    def _status(self, received) -> None:
        status = decode(received.payload, BridgeStatus, received.encoding)
        if not isinstance(status, Rejected):
            self.statuses.put(status)

    def until(self, true: Callable[[BridgeStatus], bool], timeout_s: float = 60.0) -> BridgeStatus:
        """Wait for a status."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = self.statuses.get(timeout=max(deadline - time.monotonic(), 0.01))
            if true(status):
                return status

    def gaps(self, begin_s: float, end_s: float) -> tuple[int, float]:
        """Ticks of all legs that never came, and p99 of the arrivals' jitter in ms.

        Only of that time: what this process does afterwards holds up its own subscriber.
        """
        lost, off = 0, []
        for leg in LEGS:
            rows = [
                (at, decode(payload, ServoSample, encoding).seq)
                for at, name, payload, encoding in self.samples
                if name == leg and begin_s <= at < end_s
            ]
            at, seq = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
            rest = at - seq * PERIOD_S
            off.append(np.abs(rest - np.median(rest)))
            lost += int(seq[-1] - seq[0]) + 1 - len(set(seq.tolist()))
        return lost, 1000 * float(np.quantile(np.concatenate(off), 0.99))


class Windows:
    """Statuses of all ports, one in ten seconds of each, so that no cycle counts twice."""

    def __init__(self) -> None:
        self.kept: list[BridgeStatus] = []
        self.first: dict[str, BridgeStatus] = {}
        self.last: dict[str, BridgeStatus] = {}
        self._next: dict[str, int] = {}

    def take(self, status: BridgeStatus) -> None:
        self.first.setdefault(status.port, status)
        self.last[status.port] = status
        due = self._next.setdefault(status.port, self.first[status.port].t_ns + WINDOW_NS)
        if status.t_ns >= due:
            self._next[status.port] = status.t_ns + WINDOW_NS
            self.kept.append(status)

    def count(self, name: str) -> int:
        return sum(getattr(self.last[p], name) - getattr(self.first[p], name) for p in self.last)

    def told(self, what: str) -> tuple[float, float, float, float]:
        """Of a time, over the whole run: p50, p99, the worst window's p99, max; ms."""
        rows: list[Quantiles] = [getattr(status, what) for status in self.kept]
        worst, top = max(row.p99 for row in rows), max(row.max for row in rows)
        return pooled(rows, 0.5), pooled(rows, 0.99), worst, top


def pooled(rows: list[Quantiles], share: float) -> float:
    """A bound that a quantile of all the windows' values together does not pass.

    Of each window it is known how many values at least are below each quantile it tells; the bound
    is the least value below which there are enough of all of them.  The true quantile is no larger,
    and the worst window's is no smaller.
    """
    levels = np.array([0.0, 0.5, 0.9, 0.99, 1.0])
    known = np.array([(row.p50, row.p90, row.p99, row.max) for row in rows])
    for value in np.unique(known):
        below = levels[(known <= value).sum(axis=1)].mean()
        if below >= share - 1e-9:
            return float(value)
    return float(known.max())


WINDOW_NS = round(WINDOW_S * 1e9)


def watch(ears: Ears, seconds: float) -> tuple[Windows, float]:
    """Follow the ports for some time; when it began, monotonic."""
    began, windows = time.monotonic(), Windows()
    while (left := began + seconds - time.monotonic()) > 0:
        with contextlib.suppress(queue.Empty):
            windows.take(ears.statuses.get(timeout=left))
        if ears.workers is not None:
            ears.workers.raise_all()
    return windows, began


def report(ears: Ears, options: Options, seconds: float, most_ms: float) -> list[Verdict]:
    bare_bus = BareBus(realtime=options.realtime)
    windows, began = watch(ears, seconds)
    bare = bare_bus.end()
    if not windows.kept:
        raise SystemExit("no status of any port; is the bridge running?")
    lost, heard_ms = ears.gaps(began, began + seconds)
    for what in ("cycle_ms", "jitter_ms"):
        p50, p99, worst, top = windows.told(what)
        print(
            f"  {what}: p50 {p50:.2f}, p99 {p99:.2f} of the run; worst ten seconds' p99 "
            f"{worst:.2f}, max {top:.2f}"
        )
    print(f"  {windows.count('cycles')} cycles on {len(windows.last)} ports in {seconds:.0f} s")
    print(
        f"  {windows.count('missed')} missed, as the bridge counts; {lost} ticks of "
        f"{len(LEGS)} legs did not come"
    )
    print(f"  jitter of arrival here, through the router: p99 {heard_ms:.2f} ms")
    cycle, jitter = windows.told("cycle_ms")[1], windows.told("jitter_ms")[1]
    print(
        f"  {bare}\n  over the bare bus: cycle p99 {cycle / bare.cycle_p99:.2f} times, jitter p99 "
        f"{jitter / bare.jitter_p99:.2f} times"
    )
    return [
        Verdict("cycle, p99 of the run", cycle, most_ms, "ms"),
        Verdict("jitter of publication, p99 of the run", jitter, JITTER_MS, "ms"),
        Verdict("cycles missed, as the bridge counts", windows.count("missed"), 0, "cycles"),
        Verdict("ticks that did not come", lost, 0, "ticks"),
    ]


def bridge_cycle(options: Options) -> list[Verdict]:
    with chain(options) as ears:
        settle(ears)
        return report(ears, options, options.seconds, CYCLE_MS)


def bridge_silent_servo(options: Options) -> list[Verdict]:
    # Silent from a moment on at which the bridge runs; the handshake would refuse it before.
    with chain(options, "--fault", f"silent:id={SILENT}@45") as ears:
        settle(ears)
        key = str(SILENT)
        ears.until(lambda status: key in status.servos and status.servos[key].silent, 90)
        settle(ears)
        cycle, _, missed, lost = report(ears, options, min(options.seconds, 60.0), SILENT_MS)
        return [cycle, missed, lost]  # each time it is asked, its time runs out: publication waits


def bridge_reconnect(options: Options) -> list[Verdict]:
    faults = []
    for k, out_s in enumerate(OUTAGES_S):
        faults += ["--fault", f"hangup:port=port1@{30 + 6 * k}+{out_s:g}"]
    with chain(options, *faults) as ears:
        ears.until(
            lambda s: s.port == "port1" and s.reconnects == len(OUTAGES_S) and s.state != "lost",
            120,
        )
        at = np.array([at for at, leg, *_ in ears.samples if leg == "lr"])
    gaps = np.diff(at)
    back = gaps[gaps > min(OUTAGES_S)][: len(OUTAGES_S)] - np.array(OUTAGES_S)
    print(f"  after each cable put back: {', '.join(f'{gap:.2f}' for gap in back)} s")
    return [Verdict("back after a cable is put back, worst", back.max(), RECONNECT_S, "s")]


def settle(ears: Ears) -> None:
    """Wait until handshakes, first imports and a full window of quantiles are behind."""
    begun: dict[str, int] = {}

    def settled(status: BridgeStatus) -> bool:
        begun.setdefault(status.port, status.t_ns)
        return len(begun) == 3 and all(status.t_ns - t > WINDOW_NS + 10**9 for t in begun.values())

    ears.until(settled, 120)


@contextlib.contextmanager
def chain(options: Options, *robot: str) -> Iterator[Ears]:
    """Router, controller, virtual robot and bridge in drive mode."""
    fast = ["--realtime"] if options.realtime else []
    workers = Workers() if options.workers else None
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        link = stack.enter_context(Link.open(router_settings(["tcp/127.0.0.1:0"])))
        ears = Ears(link, workers)
        controller = threading.Thread(target=command_all, args=(link, stop))
        start(
            stack, folder, "bridge", "virtual", "--dir", "bus", "--ports", "3", "--write-config",
            "rig.toml", *fast, *robot,
        )  # fmt: skip
        start(
            stack, folder, "bridge", "dynamixel", "--config", "rig.toml", "--drive", "--connect",
            link.endpoints[0], *fast,
        )  # fmt: skip
        controller.start()
        try:
            yield ears
        finally:
            if workers is not None:
                workers.lower_all()
            stop.set()
            controller.join()


def command_all(link: Link, stop: threading.Event) -> None:
    """Swing all legs a little at 50 Hz, so that goals are written in every cycle."""
    publishers = [link.publisher(command_key(leg)) for leg in LEGS]
    due, tick = time.monotonic(), 0
    while not stop.wait(max(due - time.monotonic(), 0.0)):
        for i, publisher in enumerate(publishers):
            swing = 0.25 * math.sin(2 * math.pi * (tick * PERIOD_S + i / len(LEGS)))
            publisher.put(Command(desired=[swing, 0.2 + swing, -0.4]))
        due, tick = due + PERIOD_S, tick + 1


def start(stack: contextlib.ExitStack, folder: str, *words: str) -> None:
    """A command of ours, ready; at its end it is told what it and its children took of a core."""
    program = Program("-m", "adaptive_contact", *words, cwd=folder)
    stack.callback(end, program, " ".join(words[:2]), time.monotonic())
    program.wait_line("stop with", 90.0)


def end(program: Program, name: str, began_s: float) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    program.close()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"  `{name}` took {100 * busy / (time.monotonic() - began_s):.0f} % of a core")


BENCHMARKS = (bridge_cycle, bridge_silent_servo, bridge_reconnect)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [benchmark.__name__ for benchmark in BENCHMARKS]
    parser.add_argument("names", nargs="*", default=names, help=", ".join(names))
    parser.add_argument("--minutes", type=float, default=10.0, help="of bridge_cycle")
    parser.add_argument("--no-realtime", action="store_true")
    parser.add_argument("--workers", action="store_true", help="raise the kernel's workers too")
    given = parser.parse_args()
    options = Options(60.0 * given.minutes, not given.no_realtime, given.workers)
    known = {benchmark.__name__: benchmark for benchmark in BENCHMARKS}
    verdicts = []
    for name in given.names:
        print(
            f"{name} (load before {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)", flush=True
        )
        found = known[name](options)
        print(*found, sep="\n", flush=True)
        verdicts += found
    return int(any(verdict.got > verdict.wanted for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
