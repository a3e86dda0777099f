"""The bridge's figures on three virtual ports with 18 AX-12A; a script, not a test.

    python tests/bridge/bench_bridge.py [NAME ...] [--seconds N] [--no-realtime]

Everything runs as a user runs it: a virtual robot (packets take their time on the wire, physics
in real time), the bridge with a process per port, Zenoh, a router.  Names are permanent:

- ``bridge_cycle``: cycle time and jitter of publication, and missed cycles;
- ``bridge_silent_servo``: the same with one silent servo;
- ``bridge_reconnect``: from the cable put back to the first sample;
- ``bridge_ten_minutes``: missed cycles in ten minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import queue
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from adaptive_contact.bridge.status import BridgeStatus
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.wire import ServoSample, decode, servo_key

# Settled: handshakes, first imports and the phase lock are behind.
SETTLE_S = 12.0


class Figures(NamedTuple):
    """Worst of the three ports over the run."""

    cycle_p50_ms: float
    cycle_p99_ms: float
    cycle_max_ms: float
    jitter_p99_ms: float
    missed: int
    cycles: int
    ports: int

    def __str__(self) -> str:
        return (
            f"cycle p50 {self.cycle_p50_ms:.2f} ms, p99 {self.cycle_p99_ms:.2f} ms, max "
            f"{self.cycle_max_ms:.2f} ms; jitter p99 {self.jitter_p99_ms:.2f} ms; missed "
            f"{self.missed} of {self.cycles} cycles on {self.ports} ports; load "
            f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        )


def bridge_cycle(seconds: float, realtime: bool) -> Figures:
    with chain(seconds + SETTLE_S + 30, realtime, "--drive") as (link, _):
        return watch(link, seconds)


def bridge_silent_servo(seconds: float, realtime: bool) -> Figures:
    # Silent from a moment on at which the bridge runs; the handshake would refuse it before.
    fault = ["--fault", "silent:id=3@25"]
    with chain(seconds + 80, realtime, "--drive", robot=fault) as (link, began):
        time.sleep(max(25 - (time.monotonic() - began), 0))
        return watch(link, seconds)


def bridge_reconnect(seconds: float, realtime: bool) -> str:
    with chain(60, realtime, "--drive", robot=["--fault", "hangup:port=port1@30+2"]) as (
        link,
        began,
    ):
        heard: queue.Queue[float] = queue.Queue()
        link.subscribe(servo_key("lr"), lambda _: heard.put(time.monotonic()))
        time.sleep(max(28 - (time.monotonic() - began), 0))
        last, gaps = None, []
        end = began + 40
        while time.monotonic() < end:
            with contextlib.suppress(queue.Empty):
                now = heard.get(timeout=0.5)
                gaps.append(0.0 if last is None else now - last)
                last = now
    return f"{max(gaps) - 2.0:.2f} s after the cable was put back (out for 2 s)"


def bridge_ten_minutes(seconds: float, realtime: bool) -> Figures:
    return bridge_cycle(600.0, realtime)


def watch(link: Link, seconds: float) -> Figures:
    """Follow the ports' status; quantiles are over ten seconds each, the worst of them count."""
    time.sleep(SETTLE_S)
    got: queue.Queue[BridgeStatus] = queue.Queue()
    link.subscribe(
        "robot/bridge/*/status", lambda r: got.put(decode(r.payload, BridgeStatus, r.encoding))
    )
    first: dict[str, BridgeStatus] = {}
    all_: list[BridgeStatus] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(queue.Empty):
            status = got.get(timeout=0.5)
            first.setdefault(status.port, status)
            all_.append(status)
    last = {status.port: status for status in all_}
    if not last:
        raise SystemExit("no status of any port; is the bridge running?")
    # One status in ten is of seconds of its own; of those the median p99 is steady state, and
    # the worst shows what happened at all.
    windows = [s for port in last for s in [x for x in all_ if x.port == port][::10]]
    p99 = sorted(s.cycle_ms.p99 for s in windows)
    jitter = sorted(s.jitter_ms.p99 for s in windows)
    print(f"  p99 of every ten seconds: cycle {p99}, jitter {jitter}")
    return Figures(
        cycle_p50_ms=max(s.cycle_ms.p50 for s in last.values()),
        cycle_p99_ms=p99[len(p99) // 2],
        cycle_max_ms=max(s.cycle_ms.max for s in windows),
        jitter_p99_ms=jitter[len(jitter) // 2],
        missed=sum(last[p].missed - first[p].missed for p in last),
        cycles=sum(last[p].cycles - first[p].cycles for p in last),
        ports=len(last),
    )


@contextlib.contextmanager
def chain(
    seconds: float, realtime: bool, *bridge: str, robot: list[str] | None = None
) -> Iterator[tuple[Link, float]]:
    """Router, virtual robot and bridge; gives a link, and when the robot began."""
    fast = ["--realtime"] if realtime else []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        link = stack.enter_context(Link.open(router_settings(["tcp/127.0.0.1:0"])))
        link.subscribe(servo_key("*"), lambda r: decode(r.payload, ServoSample, r.encoding))
        start(
            stack, folder, "bridge", "virtual", "--dir", "bus", "--ports", "3", "--write-config",
            "rig.toml", "--seconds", f"{seconds:.0f}", *fast, *(robot or []),
        )  # fmt: skip
        began = time.monotonic()
        start(
            stack, folder, "bridge", "dynamixel", "--config", "rig.toml", "--connect",
            link.endpoints[0], *fast, *bridge,
        )  # fmt: skip
        yield link, began


def start(stack: contextlib.ExitStack, folder: str, *words: str) -> None:
    log = Path(folder) / f"{words[1]}.log"
    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "adaptive_contact", *words],
            cwd=folder,
            stdout=out,
            stderr=subprocess.STDOUT,
        )
    stack.callback(end, process)
    deadline = time.monotonic() + 90
    while "stop with" not in log.read_text():
        if process.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(log.read_text())
        time.sleep(0.1)


def end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


BENCHMARKS = (bridge_cycle, bridge_silent_servo, bridge_reconnect, bridge_ten_minutes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["bridge_cycle", "bridge_silent_servo"])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-realtime", action="store_true")
    options = parser.parse_args()
    known = {benchmark.__name__: benchmark for benchmark in BENCHMARKS}
    for name in options.names:
        print(f"{name}: {known[name](options.seconds, not options.no_realtime)}", flush=True)


if __name__ == "__main__":
    main()
