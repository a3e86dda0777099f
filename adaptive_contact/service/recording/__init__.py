"""Reads and writes recordings (MCAP).  The only package that imports mcap.

Channel topic = Zenoh key.  Messages of the wire contract are protobuf, with their descriptors in
the file, so that tools which know nothing of this project open it; readers get them as msgpack.
Everything else keeps its bytes and its Zenoh encoding.

The file is made of small compressed chunks, each written out when it is full or a second old, so
that a recorder that is killed loses about a second.  Reading needs no index: the records are walked
from the front, and whatever stops the walk (the end of a cut file, a wrong length) ends it
quietly, with all that came before already given out and the reason in :attr:`Recording.damage`.

A bag of ROS 2 is read as a recording, too: its messages are given out as samples of the wire
contract, by the names in ``robot.toml`` (:mod:`~adaptive_contact.service.recording.bags`).
"""

from __future__ import annotations

from adaptive_contact.service.recording.bags import is_bag, read_recording
from adaptive_contact.service.recording.format import Record
from adaptive_contact.service.recording.reader import Recording
from adaptive_contact.service.recording.writer import RecordingWriter

__all__ = ["Record", "Recording", "RecordingWriter", "is_bag", "read_recording"]
