"""Sample in -> event out through the service, against a bare Zenoh echo; a script, not a test.

    python tests/service/bench_echo.py [seconds]

Three processes: this one publishes six legs at 50 Hz and times the answers; the other is first
an echo (a router whose callback puts the payload back), then the service with a learner that
changes its mind at every sample, so that each sample gives an event.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from adaptive_contact.service.link import Link, client_settings, router_settings
from adaptive_contact.wire import ContactEvent, ServoSample, contact_key, decode, servo_key

HERE = Path(__file__).parent
LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")


def echo() -> None:
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        publishers = {
            servo_key(leg): link.publisher(contact_key(leg), reliable=True) for leg in LEGS
        }
        link.subscribe(
            servo_key("*"), lambda got: publishers[got.key].put_raw(got.payload, got.encoding)
        )
        print(f"listening on {link.endpoints[0]}; echo", flush=True)
        sys.stdin.read()


def measure(endpoint: str, seconds: float) -> list[float]:
    """Round trips in ms, every leg in the same tick as a robot's bus gives them."""
    sent: dict[tuple[str, int], int] = {}
    trips: list[float] = []
    done = threading.Event()
    ticks = int(seconds * 50)

    def sink(received) -> None:  # type: ignore[no-untyped-def]
        leg = received.key.split("/")[2]
        message = decode(received.payload, ContactEvent, received.encoding)
        if not isinstance(message, ContactEvent):
            message = decode(received.payload, ServoSample, received.encoding)
        trips.append((received.arrival_ns - sent[leg, message.seq]) / 1e6)
        if len(trips) >= ticks * len(LEGS):
            done.set()

    with Link.open(client_settings([endpoint])) as link:
        link.subscribe(contact_key("*"), sink)
        publishers = {leg: link.publisher(servo_key(leg)) for leg in LEGS}
        time.sleep(0.3)  # a benchmark may: the declarations travel
        due = time.monotonic()
        for seq in range(ticks):
            away = 0.5 * (seq % 2 == 0)
            for leg, publisher in publishers.items():
                sample = ServoSample(
                    t_ns=seq * 20_000_000,
                    seq=seq,
                    measured=[away, 0.1, 0.2],
                    desired=[0.0, 0.1, 0.2],
                )
                sent[leg, seq] = time.monotonic_ns()
                publisher.put(sample)
            due += 0.02
            time.sleep(max(0.0, due - time.monotonic()))
        done.wait(2.0)
    return sorted(trips)


def main(seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "robot.toml"
        legs = "".join(f'[[leg]]\nid = "{leg}"\njoints = ["a", "b", "c"]\n' for leg in LEGS)
        config.write_text(f'[robot]\nname = "b"\nperiod_s = 0.02\nquantum_rad = 0.005\n{legs}')
        serve = [
            str(HERE / "fake_service.py"),
            "--listen",
            "tcp/127.0.0.1:0",
            "--config",
            str(config),
        ]
        for name, command in (("echo", [__file__, "--echo"]), ("service", serve)):
            with subprocess.Popen(
                [sys.executable, *command], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
            ) as process:
                assert process.stdout is not None
                line = process.stdout.readline()
                trips = measure(line.split("listening on ")[1].split(";")[0], seconds)
                process.terminate()
            n = len(trips)
            print(
                f"{name:8s} n {n}  p50 {trips[n // 2]:.2f}  p95 {trips[int(n * 0.95)]:.2f}  "
                f"p99 {trips[int(n * 0.99)]:.2f}  max {trips[-1]:.2f} ms"
            )


if __name__ == "__main__":
    if "--echo" in sys.argv:
        echo()
    else:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
