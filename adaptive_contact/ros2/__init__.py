"""ROS 2 without ROS: what its messages, keys and bags mean for the legs of a robot.

Pure of any network: :mod:`adaptive_contact.service.ros2` sends and receives, and
:mod:`adaptive_contact.service.recording` reads bags.  Only :mod:`adaptive_contact.ros2.types` needs
the extra ``ros2`` (rosbags).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from adaptive_contact.errors import MissingExtraError

__all__ = ["needs_rosbags"]


@contextlib.contextmanager
def needs_rosbags() -> Iterator[None]:
    """Around imports of :mod:`adaptive_contact.ros2.types`: says which extra is missing.

    Raises:
        MissingExtraError: rosbags is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "rosbags":
            raise
        raise MissingExtraError("ROS 2", "ros2") from error
