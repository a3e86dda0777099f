"""The foreign side of the ROS 2 tests: a controller and a listener made with zenoh-ros2-sdk.

    python tests/service/foreign_ros2.py PORT

Prints a line of JSON per message.  Publishes a controller's state of two legs at 50 Hz, ten ticks
in contact and ten free, until standard input says "quiet"; then tells what it sees of the graph.
With the next line another listener joins, which asks for what is latched.  Ends with standard
input.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

STATE = "control_msgs/msg/JointTrajectoryControllerState"
VALUES = "control_msgs/msg/DynamicJointState"
BOOL = "std_msgs/msg/Bool"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
# As rosidl has generated them in ROS 2 Iron.
HASHES = {
    STATE: "RIHS01_6cb9ac0858fc11b54bd6c0a46f032ea243c16856182276d8eb0875f6ce6a8335",
    VALUES: "RIHS01_18024c98a62697680f581108eeed40b28fb4542fa0ac5a8e36f56c62b6813d26",
}
POINTS = ("reference", "feedback", "error", "output")
FIELDS = (
    "std_msgs/Header header\nstring[] joint_names\n"
    + "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in POINTS)
    + "string[] multi_dof_joint_names\n"
    + "".join(f"trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_{n}\n" for n in POINTS)
)
JOINTS = [f"{leg}_{joint}" for leg in ("lf", "rf") for joint in ("coxa", "femur", "tibia")]


class Late(ROS2Subscriber):  # type: ignore[misc]
    """Asks for what is latched; the SDK itself finds publishers of topics of one level only."""

    def _discover_publishers(self) -> list[str]:
        topic = self.topic.replace("/", "%")
        replies = self.session_mgr.liveliness.get(f"@ros2_lv/{self.domain_id}/**", timeout=2.0)
        tokens = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok]
        return list({parts[2] for parts in tokens if parts[5:6] == ["MP"] and parts[9] == topic})


def main(port: int) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(FIELDS, STATE))
    values = "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n"
    store.register(get_types_from_msg(values, VALUES))
    store.register(
        get_types_from_msg(
            "string[] interface_names\nfloat64[] values\n", "control_msgs/msg/InterfaceValue"
        )
    )

    def definition(name: str) -> dict[str, Any]:
        text, _ = store.generate_msgdef(name, ros_version=2)
        return {
            "msg_type": name,
            "msg_definition": text,
            "type_hash": HASHES.get(name) or store.hash_rihs01(name),
            "router_port": port,
            "domain_id": 0,
        }

    writing = threading.Lock()

    def say(**line: object) -> None:
        with writing:  # listeners have threads of their own
            print(json.dumps(line), flush=True)

    def listen(topic: str, name: str, tell: Any) -> Any:
        return ROS2Subscriber(topic=topic, callback=tell, **definition(name))

    _kept = [
        listen(
            "/adaptive_contact/rf/contact", BOOL, lambda m: say(topic="rf", contact=bool(m.data))
        ),
        *(
            listen(
                f"/adaptive_contact/{topic}",
                VALUES,
                lambda m, name=topic: say(
                    topic={"contacts": "values"}.get(name, name),
                    stamp=m.header.stamp.sec * 10**9 + m.header.stamp.nanosec,
                    legs={
                        name: dict(zip(row.interface_names, row.values.tolist(), strict=True))
                        for name, row in zip(m.joint_names, m.interface_values, strict=True)
                    },
                ),
            )
            for topic in ("contacts", "states")
        ),
        listen(
            "/diagnostics",
            DIAGNOSTICS,
            lambda m: say(topic="diagnostics", rows={s.name: s.message for s in m.status}),
        ),
    ]
    state = ROS2Publisher(topic="/legs/controller_state", **definition(STATE))
    types = state.session_mgr.store.types
    duration = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)

    def point(angles: list[float]) -> Any:
        empty = np.zeros(0)
        return types["trajectory_msgs/msg/JointTrajectoryPoint"](
            np.array(angles), empty, empty, empty, duration
        )

    nothing = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], duration)
    quiet = threading.Event()
    said = threading.Thread(target=lambda: (sys.stdin.readline(), quiet.set()), daemon=True)
    said.start()
    say(topic="ready")
    tick = 0
    due = time.monotonic()
    while not quiet.is_set():
        contact = tick // 10 % 2 == 1
        t_ns = time.time_ns()
        stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        angles = [0.5 if contact and name == "rf_coxa" else 0.0 for name in JOINTS]
        state.publish(
            header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
            joint_names=JOINTS,
            reference=point([0.0] * len(JOINTS)),
            feedback=point(angles),
            error=point([]),
            output=point([]),
            multi_dof_joint_names=[],
            **{f"multi_dof_{name}": nothing for name in POINTS},
        )
        tick += 1
        due += 0.02
        quiet.wait(max(0.0, due - time.monotonic()))
    say(topic="graph", topics=dict(get_topic_names_and_types(router_port=port, domain_id=0)))
    say(topic="sent", ticks=tick)
    sys.stdin.readline()
    latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
    _late = Late(
        topic="/adaptive_contact/rf/contact",
        callback=lambda m: say(topic="late", contact=bool(m.data)),
        qos=latched,
        **definition(BOOL),
    )
    sys.stdin.read()


if __name__ == "__main__":
    main(int(sys.argv[1]))
