"""A gait controller's loop that stops a leg on contact.

It drives one leg through a bridge in drive mode: lift, reach down slowly, and stop the moment the
service says that the foot touches.  Everything it knows comes over Zenoh: the leg's pose from the
bridge's samples, contacts from the service.  Run it against a virtual robot on a low stand::

    adaptive-contact bridge virtual --dir bus --height 0.13 --write-config rig.toml
    adaptive-contact serve
    adaptive-contact bridge dynamixel --config rig.toml --drive
    python examples/gait_controller.py --leg rf --steps 5

Needs ``adaptive-contact`` and numpy.
"""

from __future__ import annotations

import argparse
import queue
import sys
import threading
import time

import numpy as np

from adaptive_contact.robot import Leg, foot, inverse, load_robot, shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import (
    Command,
    ContactEvent,
    Rejected,
    ServoSample,
    command_key,
    contact_key,
    decode,
    servo_key,
)

# A step: up in so many ticks, then down in so many; the foot aims below the ground.
LIFT_TICKS, DESCENT_TICKS, STAND_TICKS = 14, 24, 25


class Ears:
    """The newest sample and contact of a leg.  Zenoh's threads only put, the loop takes."""

    def __init__(self, link: Link, leg: str) -> None:
        self.samples: queue.Queue[ServoSample] = queue.Queue()
        self.touches = threading.Event()
        link.subscribe(servo_key(leg), self._sample)
        link.subscribe(contact_key(leg), self._contact)

    def _sample(self, received) -> None:
        sample = decode(received.payload, ServoSample, received.encoding)
        if not isinstance(sample, Rejected):
            self.samples.put(sample)

    def _contact(self, received) -> None:
        event = decode(received.payload, ContactEvent, received.encoding)
        if isinstance(event, Rejected):
            return
        if event.contact:
            self.touches.set()
        else:
            self.touches.clear()


class Legwork:
    """Commands one leg, a goal per control tick, in step with the bridge's samples."""

    def __init__(self, link: Link, leg: Leg) -> None:
        self.leg = leg
        self.ears = Ears(link, leg.id)
        self.commands = link.publisher(command_key(leg.id))
        first = self.ears.samples.get(timeout=10)
        self.goal = np.array(first.measured)

    def tick(self, goal) -> None:
        """Wait for the next sample and answer it with a goal."""
        sample = self.ears.samples.get(timeout=1)
        while not self.ears.samples.empty():
            sample = self.ears.samples.get()  # late: only the newest counts
        self.goal = np.array(goal)
        self.commands.put(Command(desired=self.goal.tolist()))
        self.sample = sample

    def hold(self, ticks: int) -> None:
        """Stay where the last goal is."""
        for _ in range(ticks):
            self.tick(self.goal)

    def move(self, target_m, ticks: int, *, stop_on_contact: bool = False) -> bool:
        """Move the foot in a straight line; True if a contact stopped it."""
        start = foot(self.goal, self.leg.lengths_m, self.leg.joint_axes)
        for k in range(1, ticks + 1):
            if stop_on_contact and self.ears.touches.is_set():
                return True
            point = start + (k / ticks) * (np.array(target_m) - start)
            self.tick(inverse(point, self.leg.lengths_m))
        # The foot lags its command: what it runs into now still counts as this descent's.
        for _ in range(6 if stop_on_contact else 0):
            if self.ears.touches.is_set():
                return True
            self.tick(self.goal)
        return False


def main() -> int:
    """Make some steps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", help="robot.toml; the shipped hexapod without it")
    parser.add_argument("--leg", default="rf")
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--connect", action="append", help="router, such as tcp/127.0.0.1:7447")
    parser.add_argument("--top", type=float, default=-0.05, help="foot height of a lift, m")
    parser.add_argument("--bottom", type=float, default=-0.155, help="where descents aim, m")
    parser.add_argument("--reach", type=float, default=0.15, help="foot from the coxa axis, m")
    options = parser.parse_args()
    robot = load_robot(options.config) if options.config else shipped_robot()
    with Link.open(client_settings(options.connect or ())) as link:
        work = Legwork(link, robot.leg(options.leg))
        reach = options.reach
        # The bridge comes to the first goal at an easy pace of its own.
        top = inverse([reach, 0.0, options.top], work.leg.lengths_m)
        began = time.monotonic()
        while time.monotonic() - began < 3.0:
            work.tick(top)
        for step in range(options.steps):
            work.ears.touches.clear()
            touched = work.move([reach, 0.0, options.bottom], DESCENT_TICKS, stop_on_contact=True)
            height = foot(work.sample.measured, work.leg.lengths_m, work.leg.joint_axes)[2]
            what = "stopped on contact" if touched else "no contact"
            print(f"step {step + 1}: {what}, foot at {100 * height:+.1f} cm", flush=True)
            work.hold(STAND_TICKS)
            work.move([reach, 0.0, options.top], LIFT_TICKS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
