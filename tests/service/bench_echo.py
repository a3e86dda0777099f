"""Sample in -> event out through the service, against a bare Zenoh echo; a script, not a test.

    PYTHONPATH=tests python tests/service/bench_echo.py [--assert]

Three processes: this one publishes six legs at 50 Hz and times the answers; the other is first
an echo (a router whose callback puts the payload back), then the whole service with its own
learners on a simulated walk, and last the service with a learner that costs nothing and changes its
mind at every sample, so that each sample gives an event.  Meanwhile a fourth process refits without
a pause, as the service's own worker does now and then.

A tick's samples are put one right after the other, as a bus gives them, so the echo's sixth answer
waits for five, as the service's does.  The walk gives some eight events a second: it lasts as long
as 3,000 of them need, some eight minutes, because a p99 over a few hundred is that of six answers.
What else the machine does changes by the minute, so the echo and the service take turns, in blocks.
The 95 % interval of the ratio of the two p99 is a bootstrap over seconds within their blocks:
answers that wait for the same core are not independent.  With ``--assert`` the exit code is 1
where the ratio is above 2, or there are too few events to tell.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from adaptive_contact.service.link import Link, client_settings, router_settings
from adaptive_contact.wire import ContactEvent, ServoSample, contact_key, decode, servo_key
from adaptive_contact.wire.received import Received
from programs import Program

MOST = 2.0
WALK_EVENTS_PER_S = 6.5
EVENTS = 3000
BLOCKS = 8
MADE_UP_S = 10.0
DRAWS = 2000

LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")
Tick = dict[str, ServoSample]
# Round trips in ms, by the second of their samples.
Trips = dict[int, list[float]]

# What a refit of one leg is: seven slopes over 1,300 rows, and a sparse fit, over and over.
REFIT = """
import dataclasses
import os
import numpy as np
from adaptive_contact.fit.refit_job import RefitJob, refit
from adaptive_contact.model import Library
from adaptive_contact.model.leg_prior import leg_prior
os.nice(5)
library = Library("servo", ("a", "b", "c"), ("yaw", "pitch", "pitch"))
window = np.random.default_rng(1).uniform(-0.4, 0.4, (1300, 24))
softer = dataclasses.replace(library, slope_rad=0.05)
other = leg_prior(softer, 0.005)
target = other.model.library.evaluate_flat(window) @ other.model.coefficients
values = np.concatenate([library.evaluate_flat(window), target], axis=1)
print("refitting", flush=True)
while True:
    refit(RefitJob("rf", 1, values, library, 0.005))
"""


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


def made_up(seconds: float) -> list[Tick]:
    """Samples at each of which the made-up learner changes its mind."""
    return [
        dict.fromkeys(
            LEGS,
            ServoSample(
                t_ns=seq * 20_000_000,
                seq=seq,
                measured=[0.5 * (seq % 2 == 0), 0.1, 0.2],
                desired=[0.0, 0.1, 0.2],
            ),
        )
        for seq in range(int(seconds * 50))
    ]


def walked(seconds: float) -> list[Tick]:
    """Samples of a simulated walk."""
    from adaptive_contact_sim import Simulation, SimulationSettings, TerrainSettings, WalkSettings

    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=2901
    )
    return [dict(tick.samples) for tick in Simulation(settings).run(seconds)]


def measure(command: Sequence[str], ticks: list[Tick]) -> Trips:
    """Round trips, ms, to a process and back; every leg in the same tick as a robot's bus."""
    sent: dict[tuple[str, int], int] = {}
    trips: Trips = {}

    def sink(received: Received) -> None:
        leg = received.key.split("/")[2]
        message = decode(received.payload, ContactEvent, received.encoding)
        if not isinstance(message, ContactEvent):
            message = decode(received.payload, ServoSample, received.encoding)
        took_ms = (received.arrival_ns - sent[leg, message.seq]) / 1e6
        trips.setdefault(message.seq // 50, []).append(took_ms)

    with closing(Program(*command, stdin=subprocess.PIPE)) as process:
        endpoint = process.wait_line(r"listening on ([^;]+);", 600.0)[1]
        with Link.open(client_settings([endpoint])) as link:
            link.subscribe(contact_key("*"), sink)
            publishers = {leg: link.publisher(servo_key(leg)) for leg in LEGS}
            time.sleep(0.5)  # a benchmark may: the declarations travel
            due = time.monotonic()
            for tick in ticks:
                for leg, sample in tick.items():
                    sent[leg, sample.seq] = time.monotonic_ns()
                    publishers[leg].put(sample)
                due += 0.02
                time.sleep(max(0.0, due - time.monotonic()))
            time.sleep(1.0)  # the last answers
    return trips


def flat(blocks: list[Trips]) -> list[float]:
    """All round trips of some blocks."""
    return [trip for block in blocks for second in block.values() for trip in second]


def drawn(blocks: list[Trips], rng: np.random.Generator) -> float:
    """The p99 of seconds that are resampled within each block."""
    chosen = [rng.choice(list(block), len(block)) for block in blocks]
    pairs = zip(blocks, chosen, strict=True)
    return float(np.percentile([ms for block, at in pairs for s in at for ms in block[s]], 99))


def row(name: str, blocks: list[Trips]) -> float:
    """Print the figures of round trips; their p99."""
    found = np.percentile(flat(blocks), [50, 95, 99, 100])
    figures = "p50 {:.2f}  p95 {:.2f}  p99 {:.2f}  max {:.2f} ms".format(*found)
    print(f"{name:40s} n {len(flat(blocks)):6d}  {figures}", flush=True)
    return float(found[2])


def main(rng: np.random.Generator) -> bool:
    """Measure; True where the service is as fast as it must be."""
    walk = walked(EVENTS / WALK_EVENTS_PER_S)
    length = -(-len(walk) // BLOCKS)
    # The echo of a block has as many answers as it takes for its own p99 to stand still.
    every = made_up(max(MADE_UP_S, length / 50 / 2))
    echoed: list[Trips] = []
    own: list[Trips] = []
    with tempfile.TemporaryDirectory() as folder, closing(Program("-c", REFIT)):
        config = Path(folder) / "robot.toml"
        legs = "".join(f'[[leg]]\nid = "{leg}"\njoints = ["a", "b", "c"]\n' for leg in LEGS)
        config.write_text(f'[robot]\nname = "b"\nperiod_s = 0.02\nquantum_rad = 0.005\n{legs}')
        words = ("--listen", "tcp/127.0.0.1:0", "--log-level", "warning", "--state", folder)
        fake = (str(Path(__file__).with_name("fake_service.py")), *words, "--config", str(config))
        turns = [
            lambda block: own.append(measure(("-m", "adaptive_contact", "serve", *words), block)),
            lambda _: echoed.append(measure((__file__, "--echo"), every)),
        ]
        for begin in range(0, len(walk), length):
            turns.reverse()  # who goes first changes, too
            for turn in turns:
                turn(walk[begin : begin + length])
        ratio = 1.0 / row("echo", echoed)
        ratio *= row("service, its own learners", own)
        row("service, a learner that costs nothing", [measure(fake, every)])
    own, echoed = [b for b in own if b], [b for b in echoed if b]
    ratios = [drawn(own, rng) / drawn(echoed, rng) for _ in range(DRAWS)]
    low, high = np.quantile(ratios, [0.025, 0.975])
    heard = len(flat(own))
    print(
        f"p99 of the service over that of the echo: {ratio:.2f}, 95 % interval {low:.2f} to "
        f"{high:.2f}, at most {MOST:g}; {heard} events, expected {EVENTS}"
    )
    return ratio <= MOST and heard >= EVENTS


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="sample in -> event out, against a bare echo")
    parser.add_argument("--echo", action="store_true", help="be the echo")
    parser.add_argument("--assert", dest="strict", action="store_true", help="fail above 2")
    asked = parser.parse_args()
    if asked.echo:
        echo()
    else:
        sys.exit(not main(np.random.default_rng(0)) and asked.strict)
