"""A gait controller's loop that stops a leg on contact.

It drives one leg through a bridge in drive mode: lift, reach down slowly, and stop the moment the
service says that the foot touches.  Everything it knows comes over Zenoh: the leg's pose from the
bridge's samples, contacts from the service.  Run it against a virtual robot on a low stand::

    adaptive-contact bridge virtual --dir bus --height 0.13 --write-config rig.toml
    adaptive-contact serve
    adaptive-contact bridge dynamixel --config rig.toml --drive
    python examples/gait_controller.py --leg rf --steps 5

What it does when something is missing: without samples it ends and commands nothing more, and the
bridge holds the leg where it is.  While no service watches the leg, no contacts are reported: the
leg holds still, lifts once it is watched again, and steps again.  A contact from before a descent
began (the last one is kept for late joiners) is not one of this descent.

Legs of three joints (yaw, pitch, pitch) and of two (pitch, pitch) will do.

Needs ``adaptive-contact`` and numpy.
"""

from __future__ import annotations

import argparse
import queue
import sys
import time
from pathlib import Path

import numpy as np

from adaptive_contact.errors import AdaptiveContactError, ConfigurationError
from adaptive_contact.robot import Leg, axis_text, inverse, load_robot, shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.settings import SILENT_AFTER_S, Finding
from adaptive_contact.wire import (
    HEARTBEAT,
    Command,
    ContactEvent,
    Heartbeat,
    Rejected,
    ServoSample,
    command_key,
    contact_key,
    decode,
    servo_key,
)

# A step: up in so many ticks, then down in so many; the foot aims below the ground.
LIFT_TICKS, DESCENT_TICKS, STAND_TICKS = 14, 24, 25
LAG_TICKS = 6
# Where a step goes, in lengths of the stretched leg from its first axis.
REACH, TOP, BOTTOM = 0.586, -0.195, -0.605


class Ears:
    """The newest sample and contact of a leg.  Zenoh's threads only put, the loop takes."""

    def __init__(self, link: Link, leg: str) -> None:
        self.samples: queue.Queue[ServoSample] = queue.Queue()
        self.contact: ContactEvent | None = None
        self._leg = leg
        self._sampled_s = float("-inf")  # when the service's newest sample of the leg came
        link.subscribe(HEARTBEAT, self._heartbeat)
        link.subscribe(servo_key(leg), self._sample)
        link.subscribe(contact_key(leg), self._contact, history=True)  # also after a cut link

    def _sample(self, received) -> None:
        sample = decode(received.payload, ServoSample, received.encoding)
        if not isinstance(sample, Rejected):
            self.samples.put(sample)

    def _contact(self, received) -> None:
        event = decode(received.payload, ContactEvent, received.encoding)
        if not isinstance(event, Rejected):
            self.contact = event

    def _heartbeat(self, received) -> None:
        heartbeat = decode(received.payload, Heartbeat, received.encoding)
        if not isinstance(heartbeat, Rejected) and self._leg in heartbeat.legs:
            self._sampled_s = time.monotonic() - heartbeat.legs[self._leg].age_s

    @property
    def watched(self) -> bool:
        """Whether a service watches the leg: it has had a sample of it just now."""
        return time.monotonic() - self._sampled_s <= SILENT_AFTER_S

    def touched_since(self, t_ns: int) -> bool:
        """Whether the foot touches, by an event no older than ``t_ns`` of the samples."""
        event = self.contact
        return event is not None and event.contact and event.t_ns >= t_ns


class Legwork:
    """Commands one leg, a goal per control tick, in step with the bridge's samples."""

    def __init__(self, link: Link, leg: Leg) -> None:
        self.leg = leg
        self.ears = Ears(link, leg.id)
        self.commands = link.publisher(command_key(leg.id))
        self.goal = np.array(self._next(5.0).measured)

    def _next(self, timeout_s: float) -> ServoSample:
        try:
            return self.ears.samples.get(timeout=timeout_s)
        except queue.Empty:
            raise ConfigurationError(
                f"no sample of leg '{self.leg.id}' for {timeout_s:g} s; run `adaptive-contact "
                "bridge dynamixel --drive` with this robot's --config"
            ) from None

    def tick(self, goal) -> None:
        """Wait for the next sample and answer it with a goal."""
        sample = self._next(1.0)
        while not self.ears.samples.empty():
            sample = self.ears.samples.get()  # late: only the newest counts
        self.goal = np.array(goal)
        self.commands.put(Command(desired=self.goal.tolist()))
        self.sample = sample

    def hold(self, ticks: int) -> None:
        """Stay where the last goal is."""
        for _ in range(ticks):
            self.tick(self.goal)

    def await_service(self) -> None:
        """Stay where the last goal is until contacts are reported."""
        if not self.ears.watched:
            print("no service reports contacts; holding still until one does", flush=True)
        while not self.ears.watched:
            self.tick(self.goal)

    def move(self, target_m, ticks: int) -> None:
        """Move the foot in a straight line."""
        for goal in self._line(target_m, ticks):
            self.tick(goal)

    def descend(self, target_m, ticks: int) -> str:
        """Move the foot down until a contact stops it.

        Returns:
            ``contact``, ``none``, or ``unwatched`` where the service has gone on the way: the foot
            may have touched since, without a report.
        """
        began_ns = self.sample.t_ns
        # The foot lags its command: what it runs into after the last goal counts as well.
        line = self._line(target_m, ticks)
        for goal in [*line, *[line[-1]] * LAG_TICKS]:
            if not self.ears.watched:
                return "unwatched"
            if self.ears.touched_since(began_ns):
                return "contact"
            self.tick(goal)
        return "none"

    def _line(self, target_m, ticks: int) -> list[np.ndarray]:
        start = self.leg.chain.foot(self.goal)
        way = np.array(target_m) - start
        return [angles(self.leg, start + (k / ticks) * way) for k in range(1, ticks + 1)]


def angles(leg: Leg, point_m) -> np.ndarray:
    """Joint angles that put the foot at a point of the leg's frame."""
    if leg.lengths_m is None:
        raise ConfigurationError(
            f"leg '{leg.id}' has no lengths_m; this example knows straight legs only"
        )
    if leg.joint_axes == ("pitch", "pitch"):  # three joints without the first
        found = inverse([point_m[0], 0.0, point_m[2]], (0.0, *leg.lengths_m))[1:]
    elif leg.joint_axes == ("yaw", "pitch", "pitch"):
        found = inverse(point_m, leg.lengths_m)
    else:
        raise ConfigurationError(
            f"leg '{leg.id}' has the axes {', '.join(map(axis_text, leg.joint_axes))}; this "
            "example knows legs of yaw, pitch, pitch and of pitch, pitch"
        )
    if not np.isfinite(found).all():
        x, _, z = point_m
        raise ConfigurationError(
            f"leg '{leg.id}' cannot reach {x:.3f} m out and {z:.3f} m up; change REACH, TOP "
            "and BOTTOM"
        )
    return found


def main() -> int:
    """Make some steps; what is wrong is reported in one line."""
    try:
        run(arguments())
    except AdaptiveContactError as error:
        print(f"gait_controller: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def print_waiting(finding: Finding) -> None:
    """Print what stands in the way of the network."""
    print(f"gait_controller: {finding.line}; trying on", file=sys.stderr, flush=True)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", help="robot.toml; the shipped hexapod without it")
    parser.add_argument("--leg", default="rf")
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--connect", action="append", help="router, such as tcp/127.0.0.1:7447")
    parser.add_argument("--namespace", help="prefix of all keys, such as hexapod1")
    parser.add_argument("--zenoh-config", type=Path, help="JSON5 file with a user or TLS")
    return parser.parse_args()


def run(options: argparse.Namespace) -> None:
    """Step as the options say."""
    robot = load_robot(options.config) if options.config else shipped_robot()
    leg = robot.leg(options.leg)
    stretched = leg.chain.reach_m if leg.chain is not None else 0.0
    reach, up, down = (share * stretched for share in (REACH, TOP, BOTTOM))
    # All that may be wrong with the leg shows before anything moves.
    top, _ = angles(leg, [reach, 0.0, up]), angles(leg, [reach, 0.0, down])
    settings = client_settings(
        options.connect or (), namespace=options.namespace, zenoh_config=options.zenoh_config
    )
    with Link.open(settings, on_wait=print_waiting) as link:
        work = Legwork(link, leg)
        # The bridge comes to the first goal at an easy pace of its own.
        began = time.monotonic()
        while time.monotonic() - began < 3.0:
            work.tick(top)
        said = {"contact": "stopped on contact", "none": "no contact"}
        for step in range(options.steps):
            work.await_service()
            found = work.descend([reach, 0.0, down], DESCENT_TICKS)
            while found == "unwatched":
                work.await_service()
                work.move([reach, 0.0, up], LIFT_TICKS)
                found = work.descend([reach, 0.0, down], DESCENT_TICKS)
            height = work.leg.chain.foot(work.sample.measured)[2]
            print(f"step {step + 1}: {said[found]}, foot at {100 * height:+.1f} cm", flush=True)
            work.hold(STAND_TICKS)
            work.move([reach, 0.0, up], LIFT_TICKS)


if __name__ == "__main__":
    sys.exit(main())
