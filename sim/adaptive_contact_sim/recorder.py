"""A simulation into a recording, as if it had been recorded off the wire."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from adaptive_contact.service.recording import RecordingWriter
from adaptive_contact.service.recording.scene import Scene
from adaptive_contact.wire import (
    SIM_BODY,
    SIM_DRIFT,
    BodyPose,
    ContactEvent,
    contact_key,
    servo_key,
    truth_key,
)
from adaptive_contact_sim.simulation import Simulation, Tick


class TickRecorder:
    """Writes every tick into an MCAP file; a context manager.

    Samples are logged at their own time.  Changes of contact are logged when they became
    certain, up to 60 ms after their own time stamp, as they would be on the wire; drifts when
    they begin.  The body's pose is logged after each tick, at its own time; contact events when the
    gait gets them.

    Raises:
        RecordingError: the file cannot be written.
    """

    def __init__(self, path: Path, sim: Simulation) -> None:
        settings = sim.settings
        self._sim = sim
        self._drifts_begun = 0
        self._writer = RecordingWriter(
            path,
            {
                "source": "adaptive-contact sim",
                "robot": sim.robot.description.name,
                "motion": repr(settings.motion),
                "terrain": repr(sim.terrain.settings),
                "encoder": repr(settings.encoder),
                "seed": str(settings.seed),
                "robot_seed": str(settings.robot_seed),
                "drift": repr(settings.drift),
            },
            Scene(sim.robot.description),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, tick: Tick) -> None:
        """Append one tick; to be called right after it was made."""
        write = self._writer.write_message
        now_ns = self._sim.t_ns
        begun = self._sim.drift.begun
        for injection in begun[self._drifts_begun :]:
            at_ns = self._sim.settings.epoch_ns + round(injection.at_s * 1e9)
            write(SIM_DRIFT, injection.drift, at_ns)
        self._drifts_begun = len(begun)
        for leg, sample in tick.samples.items():
            write(servo_key(leg), sample, sample.t_ns)
        for change in tick.truth:
            write(truth_key(change.leg), change.message, now_ns)
        plant = self._sim.plant
        if plant.elements.floats:
            place = plant.body_pose()[0].tolist()
            turn = plant.data.xquat[plant.elements.body].tolist()
            pose = BodyPose(t_ns=now_ns, position_m=tuple(place), quaternion_wxyz=tuple(turn))
            write(SIM_BODY, pose, now_ns)

    def write_event(self, event: ContactEvent) -> None:
        """Append an event; to be called when the gait gets it."""
        self._writer.write_message(contact_key(event.leg), event, self._sim.t_ns)
