"""The running part of the demo: service and simulator as two processes, a third that injects.

This process only watches and records; what it ends up with is a recording of everything that went
over the wire, and the moment of the drift.  It shows a live table, or plain lines where there is no
terminal.
"""

from __future__ import annotations

import re
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from adaptive_contact.cli.demo.child import Child, Listening
from adaptive_contact.cli.demo.settings import DemoSettings, drift_words
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.recording import RecordingWriter
from adaptive_contact.service.recording.recorder import Recorder
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.service.watch import Feed, View
from adaptive_contact.service.watch_table import table
from adaptive_contact.web import LivePage
from adaptive_contact.wire import JSON, SIM_DRIFT, Drift, DriftReply, Rejected, decode, servo_key

if TYPE_CHECKING:
    from adaptive_contact.service.watch import LegView

# Between two plain lines, s of simulated time.
_LINE_EVERY_S: Final = 5.0


class Display:
    """Shows what goes on: the table of ``watch``; without a terminal a line every few seconds."""

    def __init__(self, console: Console, settings: DemoSettings) -> None:
        self._console, self._settings = console, settings
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._next_s = 0.0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, view: View, walked_s: float, *, drifted: bool) -> None:
        """Redraw the table, or print a line, if one is due."""
        if self._live is not None:
            words = _headline(self._settings, walked_s, drifted=drifted)
            line = Text(words, style="bold yellow" if drifted else "bold")
            below = table(view, self._console.width, self._console.height - 3)
            self._live.update(Group(line, Text(), below), refresh=True)
        elif walked_s >= self._next_s and view.legs:
            self._next_s += _LINE_EVERY_S
            drifting = self._settings.leg
            others = [leg for leg in view.legs if leg.leg != drifting]
            own = [leg for leg in view.legs if leg.leg == drifting]
            name = f"{drifting} (drifted)" if drifted else drifting
            self.say(f"{walked_s:4.0f} s   {name}: {_tally(own)}   others: {_tally(others)}")

    def say(self, line: str) -> None:
        """Print a line, above the table."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=self._live is None)
        self._console.file.flush()


def _headline(settings: DemoSettings, walked_s: float, *, drifted: bool) -> str:
    words = f"{walked_s:4.0f} of {settings.seconds:.0f} s   "
    what = f"leg {settings.leg}: {drift_words(settings)}"
    if drifted:
        return f"{words}{what}, since {settings.drift_at_s:.0f} s"
    return f"{words}walking on rough ground; at {settings.drift_at_s:.0f} s {what}"


def _tally(legs: list[LegView]) -> str:
    """Touches, false alarms and models of some legs."""
    seen, touches = sum(leg.seen or 0 for leg in legs), sum(leg.touches or 0 for leg in legs)
    latencies = [leg.latency_ms for leg in legs if leg.latency_ms is not None]
    last = f" (the last after {latencies[-1]:.0f} ms)" if latencies else ""
    alarms = sum(leg.false_alarms or 0 for leg in legs)
    versions = sorted({leg.model_version for leg in legs if leg.model_version is not None})
    statuses = sorted({leg.status for leg in legs if leg.status is not None})
    model = "/".join(f"v{version}" for version in versions) or "-"
    return (
        f"{seen} of {touches} touches seen{last}, {alarms} false, "
        f"model {model} {'/'.join(statuses)}"
    )


_READY = re.compile(r"listening on (\S+?)[;,]")
_INJECTED = re.compile(r"^\{.*\}$")
_REFRESH_S: Final = 0.25
# A start imports numpy, scipy and the models: a second and a half here, more on a small board.
_START_S: Final = 60.0
# The service publishes its counts once a second; what is on its way is worked off long before.
_SETTLE_S: Final = 3.0
# The simulator walks in real time unless the machine is far too slow for it.
_SLOWEST: Final = 3.0


class StoppedError(Exception):
    """The run was stopped before its end."""


@dataclass(frozen=True)
class Take:
    """What a run left."""

    drift_ns: int  # moment of the drift, by the samples' clock
    # what drifts from then on, `{kind: {leg: {joint: value}}}`
    holds: dict[str, dict[str, dict[str, float]]]
    service: ServiceStatus | None  # the service's own last word
    simulator: str  # the simulator's last word


def conduct(
    settings: DemoSettings,
    robot: Robot,
    show: Display,
    stop: threading.Event,
    page: LivePage | None = None,
) -> Take:
    """Run service and simulator, inject the drift half way, record everything.

    Raises:
        StoppedError: ``stop`` was set.
        AdaptiveContactError: a process failed; in one line, with its last words.
    """
    with ExitStack() as stack:
        service = stack.enter_context(Child("the service", _serve(settings)))
        endpoint = service.wait_line(_READY, _START_S).group(1)
        show.say(f"service     process {service.pid}, listening on {endpoint}")
        link = stack.enter_context(Link.open(client_settings([endpoint], wait=False)))
        if page is not None:
            page.follow(stack.enter_context(Link.open(client_settings([endpoint], wait=False))))
            stack.callback(page.leave)
        about = {
            "source": "adaptive-contact demo",
            "robot": robot.name,
            "seed": str(settings.seed),
        }
        writer = stack.enter_context(RecordingWriter(settings.recording, about))
        recorder = Recorder(link, writer, "robot/**")
        feed = Feed(link)
        recording = stack.enter_context(Listening(recorder))
        simulator = stack.enter_context(Child("the simulator", _walk(settings, endpoint)))
        show.say(f"simulator   process {simulator.pid}, seed {settings.seed}")
        stack.enter_context(show)
        run = _Run(settings, robot, endpoint, recorder, show)
        stack.callback(run.close)

        until_s = time.monotonic() + _START_S + _SLOWEST * settings.seconds
        while simulator.running:
            if stop.wait(_REFRESH_S):
                raise StoppedError
            if not service.running:  # it has ended, well or not, and should go on until stopped
                raise service.failure()
            recording.check()
            run.step(feed.view(time.monotonic_ns()))
            if time.monotonic() > until_s:
                raise AdaptiveContactError(
                    f"the simulator has walked {run.walked_s:.0f} of {settings.seconds:.0f} s; "
                    "this machine is too slow for real time"
                )
        if stop.is_set():
            raise StoppedError
        simulator.check()
        run.finish()
        last = _settle(feed, recorder, robot, stop)
        recording.end()
        for drift in settings.drifts:
            # It went as a query, which no subscription receives; a recording should hold it.
            writer.write_message(SIM_DRIFT, drift, run.drift_ns)
        return Take(
            drift_ns=run.drift_ns,
            holds=run.holds,
            service=last.service,
            simulator=simulator.lines[-1] if simulator.lines else "",
        )


def _serve(settings: DemoSettings) -> tuple[str, ...]:
    """Without state: a demo begins with the shipped models, and leaves none of its own behind."""
    return (
        *("serve", "--config", settings.robot, "--no-state", "--listen", "tcp/127.0.0.1:0"),
        *("--log-level", "warning"),
    )


def _walk(settings: DemoSettings, endpoint: str) -> tuple[str, ...]:
    return (
        *("sim", "walk", "--robot", settings.robot, "--terrain", "rough", "--stop-on", "truth"),
        *("--seconds", f"{settings.seconds:g}", "--seed", str(settings.seed)),
        *("--connect", endpoint),
    )


class _Run:
    """The walk so far, and the drift in it."""

    def __init__(
        self,
        settings: DemoSettings,
        robot: Robot,
        endpoint: str,
        recorder: Recorder,
        show: Display,
    ) -> None:
        self.walked_s = 0.0  # simulated time, from the samples that were recorded
        # drift_ns, holds: of the simulator's answers
        self.drift_ns = 0
        self.holds: dict[str, dict[str, dict[str, float]]] = {}
        self._key = servo_key(settings.leg)
        self._settings = settings
        self._period_s = robot.period_s
        self._endpoint = endpoint
        self._recorder = recorder
        self._show = show
        self._waiting = list(settings.drifts)
        self._injector: Child | None = None

    def step(self, view: View) -> None:
        """Look at the walk, inject what is due, and show it."""
        before_s, self.walked_s = self.walked_s, self._recorder.counts[self._key] * self._period_s
        if self._injector is not None and not self._injector.running:
            self._injected(self._injector)
            self._injector = None
        if self._injector is None and self._waiting and self.walked_s >= self._settings.drift_at_s:
            drift = self._waiting.pop(0)
            self._injector = Child("the injection", _inject(drift, self._endpoint))
        if self.walked_s > before_s:  # what is left standing is the walk, not the silence after
            self._show.show(view, self.walked_s, drifted=self.drift_ns > 0)

    def finish(self) -> None:
        """Make sure that the drift was there before the walk was over.

        Raises:
            AdaptiveContactError: it was not.
        """
        if self._injector is not None:
            self._injector.wait(_START_S)
            self._injected(self._injector)
        if self._waiting or not self.drift_ns:
            raise AdaptiveContactError(
                f"the walk was over after {self.walked_s:.0f} s, before all of the drift was "
                "injected; give more --seconds"
            )

    def close(self) -> None:
        """End an injection that is under way."""
        if self._injector is not None:
            self._injector.end()

    def _injected(self, injector: Child) -> None:
        injector.check()
        injector.end()
        match = injector.wait_line(_INJECTED, 0.0)
        reply = decode(match.group(0).encode(), DriftReply, JSON)
        if isinstance(reply, Rejected):
            raise AdaptiveContactError(f"the injection's answer cannot be read: {reply.detail}")
        # The first of several marks the moment: from then on the leg is another.
        self.drift_ns = self.drift_ns or reply.t_ns
        self.holds = reply.holds
        held = ", ".join(
            f"{kind} {max(joints.values()):g}"
            for kind, legs in reply.holds.items()
            for joints in legs.values()
        )
        self._show.say(f"injected    by process {injector.pid}, now holds: {held}")


def _inject(drift: Drift, endpoint: str) -> tuple[str, ...]:
    return (
        *("sim", "inject", drift.kind, "--value", f"{drift.value:g}"),
        *("--leg", drift.leg or "all", "--json", "--connect", endpoint),
    )


def _settle(feed: Feed, recorder: Recorder, robot: Robot, stop: threading.Event) -> View:
    """Wait until the service has worked off what was sent; its last view."""
    sent = sum(recorder.counts[servo_key(leg)] for leg in robot.leg_ids)
    until_s = time.monotonic() + _SETTLE_S
    while True:
        view = feed.view(time.monotonic_ns())
        done = view.service is not None and view.service.samples >= sent
        if done or time.monotonic() >= until_s:
            return view
        if stop.wait(_REFRESH_S):
            raise StoppedError
