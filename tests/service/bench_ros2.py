"""What the ROS 2 gateway adds: message in -> sample out, event in -> Bool out; a script, no test.

    python tests/service/bench_ros2.py [--seconds N] [--one-topic] [--realtime] [--assert]

Three processes: this one, which is the router of ROS 2, a controller of six legs (a topic a leg, or
one for all with ``--one-topic``) and a listener; a second one with the router of the service; and
the gateway, `adaptive-contact bridge ros2`.  Times are from the put of a message to the arrival of
what the gateway made of it, both here.  That holds both hops, so the same with an echo in place of
the gateway is measured first, in the same process layout; what is added is the difference of the
two distributions' quantiles.  A contact is put every sixth tick, for a leg in turn: some eight a
second, as a walk gives.

The gateway's share of a core is its CPU time over the measured seconds (user and system).  With
``--assert`` the exit code is 1 where the p99 that is added passes 3 ms, or the share 5 %.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from adaptive_contact.priority import take_priority
from adaptive_contact.ros2 import rmw
from adaptive_contact.ros2.rmw import RosType
from adaptive_contact.ros2.types import typestore
from adaptive_contact.service.link import Link, client_settings, router_settings
from adaptive_contact.wire import (
    ContactEvent,
    ServoSample,
    contact_key,
    decode,
    servo_key,
)

MOST_MS = 3.0
MOST_SHARE = 0.05
EVENT_TICKS = 6
LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")
STORE = typestore()


def robot_text(*, one_topic: bool) -> str:
    state = "/legs/state" if one_topic else "/{leg}/state"
    legs = "".join(
        f'[[leg]]\nid = "{leg}"\njoints = ["a", "b", "c"]\n'
        f'ros2 = {{ joints = ["{leg}_a", "{leg}_b", "{leg}_c"] }}\n'
        for leg in LEGS
    )
    head = '[robot]\nname = "b"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
    return f'{head}[ros2]\nstate = "{state}"\n{legs}'


def message(legs: tuple[str, ...], t_ns: int) -> bytes:
    types = STORE.types
    duration = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    nothing = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], duration)
    joints = [f"{leg}_{joint}" for leg in legs for joint in "abc"]
    values = np.linspace(0.0, 1.0, len(joints))
    point = types["trajectory_msgs/msg/JointTrajectoryPoint"](
        values, values, values, np.zeros(0), duration
    )
    stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    made = types[RosType.CONTROLLER_STATE](
        types["std_msgs/msg/Header"](stamp, ""), joints, point, point, point, point, [],
        nothing, nothing, nothing, nothing, 1.0,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(made, RosType.CONTROLLER_STATE))


def serve() -> None:
    """The service's router, alone."""
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        print(link.endpoints[0], flush=True)
        sys.stdin.read()


def echo(service: str, ros: str) -> None:
    """In place of the gateway: puts what it gets, and works on nothing."""
    with (
        Link.open(client_settings([service])) as inner,
        Link.open(client_settings([ros])) as outer,
    ):
        samples = {leg: inner.publisher(servo_key(leg)) for leg in LEGS}
        booleans = {leg: outer.publisher(f"0/echo/{leg}") for leg in LEGS}

        def inward(received: Any) -> None:
            leg = received.key.split("/")[1]
            for name in LEGS if leg == "legs" else (leg,):
                samples[name].put_raw(received.payload, received.encoding)

        outer.subscribe("0/*/state/*/*", inward)
        inner.subscribe(
            contact_key("*"),
            lambda got: booleans[got.key.split("/")[2]].put_raw(got.payload, got.encoding),
        )
        print("reading", flush=True)
        sys.stdin.read()


def cpu_s(pid: int) -> float:
    """CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def running(*command: str) -> Iterator[tuple[int, str]]:
    """A process, ended at the end; gives its id and its first line."""
    with subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield process.pid, process.stdout.readline().strip()
        finally:
            process.terminate()


class Times:
    """From put to arrival, ms."""

    def __init__(self) -> None:
        self.sent: dict[Any, int] = {}
        self.took: list[float] = []

    def arrive(self, what: Any) -> None:
        begun = self.sent.pop(what, None)
        if begun is not None:
            self.took.append((time.monotonic_ns() - begun) / 1e6)


def measure(
    session: zenoh.Session, service: Link, seconds: float, rate: float, pid: int, *, one_topic: bool
) -> tuple[Times, Times, float]:
    """Samples and contacts through whatever stands between, and its share of a core."""
    inward, outward = Times(), Times()
    waiting: dict[str, int] = {}

    def on_sample(received: Any) -> None:
        leg = received.key.split("/")[2]
        sample = decode(received.payload, ServoSample, received.encoding)
        if isinstance(sample, ServoSample):
            inward.arrive((leg, sample.t_ns))
        elif leg in waiting:  # the echo of a message, which is not read
            inward.arrive((leg, waiting[leg]))

    def on_bool(got: zenoh.Sample) -> None:
        outward.arrive(str(got.key_expr).split("/")[2])

    service.subscribe(servo_key("*"), on_sample)
    keep = [session.declare_subscriber(f"0/echo/{leg}", on_bool) for leg in LEGS]
    hash_ = STORE.hash_rihs01(RosType.BOOL)
    for leg in LEGS:
        address = rmw.Address(f"/adaptive_contact/{leg}/contact", RosType.BOOL, hash_)
        keep.append(session.declare_subscriber(rmw.topic_key(0, address), on_bool))
    groups = [LEGS] if one_topic else [(leg,) for leg in LEGS]
    state_hash = STORE.hash_rihs01(RosType.CONTROLLER_STATE)
    publishers = [
        session.declare_publisher(
            rmw.topic_key(
                0,
                rmw.Address(
                    "/legs/state" if one_topic else f"/{group[0]}/state",
                    RosType.CONTROLLER_STATE,
                    state_hash,
                ),
            )
        )
        for group in groups
    ]
    events = {leg: service.publisher(contact_key(leg), reliable=True) for leg in LEGS}
    time.sleep(1.0)  # a benchmark may: the declarations travel
    begun_s, cpu = time.monotonic(), cpu_s(pid)
    due = begun_s
    for tick in range(int(seconds * rate)):
        for group, publisher in zip(groups, publishers, strict=True):
            t_ns = time.time_ns()
            payload = message(group, t_ns)
            attached = rmw.encode_attachment(rmw.Attachment(tick + 1, t_ns, bytes(16)))
            now = time.monotonic_ns()
            for leg in group:
                inward.sent[leg, t_ns] = now
                waiting[leg] = t_ns
            publisher.put(payload, attachment=attached)
        if tick % EVENT_TICKS == 0:
            leg = LEGS[tick // EVENT_TICKS % len(LEGS)]
            outward.sent[leg] = time.monotonic_ns()
            events[leg].put(
                ContactEvent(
                    leg=leg, t_ns=tick, seq=tick, onset_ns=tick, contact=True, status="valid",
                    score=2.0, residual=[0.0, 0.0, 0.0], model_version=0,
                )
            )  # fmt: skip
        due += 1.0 / rate
        time.sleep(max(0.0, due - time.monotonic()))
    share = (cpu_s(pid) - cpu) / (time.monotonic() - begun_s)
    threading.Event().wait(0.5)
    for declared in keep:
        declared.undeclare()
    return inward, outward, share


def row(name: str, times: Times) -> dict[str, float]:
    """Print quantiles, and give them."""
    found = {f"p{q}": float(np.percentile(times.took, q)) for q in (50, 95, 99)}
    text = "  ".join(f"{key} {value:.2f}" for key, value in found.items())
    lost = len(times.sent)
    print(f"{name:38s} n {len(times.took):6d}  {text} ms  lost {lost}", flush=True)
    return found


def main(seconds: float, rate: float, *, one_topic: bool, realtime: bool) -> bool:
    """Measure; True where the gateway keeps to its figures."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "robot.toml"
        config.write_text(robot_text(one_topic=one_topic))
        with (
            running(__file__, "--serve", *(["--realtime"] if realtime else [])) as (_, service),
            Link.open(router_settings(["tcp/127.0.0.1:0"])) as free,
        ):
            ros = free.endpoints[0]
            free.close()
            settings = {"mode": "router", "listen/endpoints": [ros]}
            chosen = zenoh.Config()
            for key, value in settings.items():
                chosen.insert_json5(key, json.dumps(value))
            chosen.insert_json5("scouting/multicast/enabled", "false")
            fast = ("--realtime",) if realtime else ()
            between = {
                "echo": (__file__, *fast, "--echo", service, ros),
                "gateway": (
                    *("-m", "adaptive_contact", "bridge", "ros2", "--config", str(config)),
                    *("--connect", service, "--ros-connect", ros, *fast),
                ),
            }
            found = {}
            with zenoh.open(chosen) as session:
                for name, command in between.items():
                    with (
                        running(*command) as (pid, _),
                        Link.open(client_settings([service])) as own,
                    ):
                        inward, outward, share = measure(
                            session, own, seconds, rate, pid, one_topic=one_topic
                        )
                        found[name] = (
                            row(f"{name}: message in, sample out", inward),
                            row(f"{name}: contact in, Bool out", outward),
                        )
                        print(f"{name}: {100 * share:.1f} % of a core", flush=True)
    added = [found["gateway"][way]["p99"] - found["echo"][way]["p99"] for way in (0, 1)]
    print(
        f"added p99: samples {added[0]:.2f}, contacts {added[1]:.2f} ms (at most {MOST_MS:g}); "
        f"{100 * share:.1f} % of a core (at most {100 * MOST_SHARE:g} %)"
    )
    return max(added) <= MOST_MS and share <= MOST_SHARE


if __name__ == "__main__":
    if "--realtime" in sys.argv and (refused := take_priority()) is not None:
        sys.exit(refused)
    if "--serve" in sys.argv:
        serve()
    elif "--echo" in sys.argv:
        echo(*sys.argv[-2:])
    else:
        parser = argparse.ArgumentParser(description="what the ROS 2 gateway adds")
        parser.add_argument("--seconds", type=float, default=30.0, help="of each of the two")
        parser.add_argument("--rate", type=float, default=50.0, help="ticks a second")
        parser.add_argument("--one-topic", action="store_true", help="one message for six legs")
        parser.add_argument("--realtime", action="store_true", help="before ordinary processes")
        parser.add_argument("--assert", dest="strict", action="store_true", help="fail above")
        asked = parser.parse_args()
        well = main(asked.seconds, asked.rate, one_topic=asked.one_topic, realtime=asked.realtime)
        sys.exit(1 if asked.strict and not well else 0)
