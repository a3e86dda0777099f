"""The layout in `examples/` is one that Foxglove takes, and each path leads to a field.

Structure: `LayoutData` of Foxglove Studio and Lichtblick (`context/CurrentLayoutContext/actions`),
paths: `packages/message-path`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import pytest

from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.recording.scene import BODY, Scene
from adaptive_contact.service.recording.schemas import kind_of_key, parts_of
from adaptive_contact.wire import ServoSample, servo_key

LAYOUT = json.loads(
    (Path(__file__).parents[2] / "examples" / "foxglove_layout.json").read_text("utf-8")
)
PANELS: dict[str, dict[str, Any]] = LAYOUT["configById"]
# What a plot or a strip of states can draw.
DRAWN = (bool, int, float, str)


def paths() -> Iterator[tuple[str, dict[str, Any]]]:
    for panel, config in PANELS.items():
        for path in config.get("paths", ()):
            yield panel, path


def field_of(path: str) -> Any:
    """Type at the end of a message path."""
    parsed = re.fullmatch(r"(?P<topic>[\w/]+)(?P<fields>(?:\.\w+(?:\[\d+\])?)+)", path)
    assert parsed is not None, path
    topic = parsed["topic"]
    kind: Any = kind_of_key(topic)
    assert kind is not None, f"{topic} is no key of the contract"
    for name, index in re.findall(r"\.(\w+)(\[\d+\])?", parsed["fields"]):
        assert issubclass(kind, msgspec.Struct), path
        kind, arguments, _ = parts_of(get_type_hints(kind)[name])
        if index:
            assert kind is list, path
            kind = parts_of(arguments[0])[0]
    return kind


@pytest.mark.parametrize(("panel", "path"), list(paths()))
def test_each_path_leads_to_what_can_be_drawn(panel: str, path: dict[str, Any]) -> None:
    assert path["timestampMethod"] == "receiveTime"
    if panel.startswith("Plot!"):
        assert path["enabled"] is True
        if re.fullmatch(r"-?\d+(\.\d+)?", path["value"]):  # a horizontal line
            return
        assert field_of(path["value"]) in (int, float)
    else:
        kind = field_of(path["value"])
        assert kind in DRAWN or kind.__name__ == "Literal"


def test_raw_messages_are_of_a_topic() -> None:
    for panel, config in PANELS.items():
        if panel.startswith("RawMessages!"):
            assert kind_of_key(config["topicPath"]) is not None


def test_the_robot_is_drawn_from_a_topic_and_a_frame_of_recordings() -> None:
    scene = Scene(shipped_robot())
    sample = ServoSample(t_ns=1, seq=1, measured=[0.0] * 3, desired=[0.0] * 3)
    topics = {
        topic: (schema, content)
        for leg in shipped_robot().leg_ids
        for topic, content, (schema, _) in scene.update(servo_key(leg), sample, 1)
    }
    (panel,) = (config for name, config in PANELS.items() if name.startswith("3D!"))
    (shown,) = panel["topics"]
    assert topics[shown][0] == "foxglove.SceneUpdate"
    assert panel["followTf"] == BODY
    assert BODY.encode() in topics["/tf"][1]
