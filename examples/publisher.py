"""A control loop that publishes one leg's samples: read, compute, write, publish.

Put your servos into ``read`` and ``write`` and your gait into ``compute``; as they are, a leg
swings in the air.  Needs ``eclipse-zenoh`` and ``msgpack`` only::

    python examples/publisher.py tcp/127.0.0.1:7447
"""

import argparse
import itertools
import json
import math
import signal
import sys
import threading
import time

import msgpack
import zenoh

LEG, PERIOD_S = "rf", 0.02
SWING_TICKS, STANCE_TICKS = 30, 30  # of a step
ARRIVED_TICKS = 5  # the foot comes after its command
servos = [0.0, 0.6, -1.8]  # stands for the hardware: where the servos are, rad
# Set by Ctrl-C: an exception could strike inside a library, and be lost there.
stopped = threading.Event()


def read() -> list[float]:
    """The servos' positions now, rad, in the order of `joints` in robot.toml."""
    return list(servos)


def compute(seq: int) -> tuple[list[float], str]:
    """The goals of this tick, rad, and its phase.

    It is ``swing`` from the first command that lifts the foot until the foot can have arrived.
    """
    tick = seq % (SWING_TICKS + STANCE_TICKS)
    there = math.cos(2.0 * math.pi * seq / (SWING_TICKS + STANCE_TICKS))
    lift = max(math.sin(math.pi * tick / SWING_TICKS), 0.0)
    swings = 0 < tick < SWING_TICKS + ARRIVED_TICKS
    return [0.2 * there, 0.6 + 0.4 * lift, -1.8], "swing" if swings else "stance"


def write(goals: list[float]) -> None:
    """Send the goals to the servos, which go a fifth of the way in a tick."""
    servos[:] = [at + 0.2 * (goal - at) for at, goal in zip(servos, goals, strict=True)]


def wait_for_router(endpoint: str) -> zenoh.Session:
    """Join the router as soon as it is there; later Zenoh reconnects by itself."""
    client = {"mode": "client", "connect": {"endpoints": [endpoint]}}
    try:
        config = zenoh.Config.from_json5(json.dumps(client))
    except zenoh.ZError:
        sys.exit(f"'{endpoint}' is no endpoint; give one such as tcp/127.0.0.1:7447")
    while not stopped.is_set():
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            print(f"no router at {endpoint}; trying again", file=sys.stderr, flush=True)
            stopped.wait(1.0)
    sys.exit(130)


def main() -> None:
    """Run the loop until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", nargs="?", default="tcp/127.0.0.1:7447", help="of the router")
    with wait_for_router(parser.parse_args().endpoint) as session:
        out = session.declare_publisher(f"robot/leg/{LEG}/servo", encoding="application/msgpack")
        run = time.time_ns() // 1_000_000  # this start; larger than that of any start before
        due_s = time.monotonic()
        for seq in itertools.count():
            measured, t_ns = read(), time.monotonic_ns()
            desired, phase = compute(seq)
            write(desired)
            sample = {"v": 1, "run": run, "seq": seq, "t_ns": t_ns, "phase": phase}
            out.put(msgpack.packb({**sample, "measured": measured, "desired": desired}))
            due_s += PERIOD_S
            if stopped.wait(max(due_s - time.monotonic(), 0.0)):
                sys.exit(130)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda *_: stopped.set())
    main()
