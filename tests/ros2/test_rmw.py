"""Keys, tokens and attachments, against the examples of rmw_zenoh's design and Zenoh's coder."""

from __future__ import annotations

import zenoh
from zenoh.ext import Int64, z_serialize
from zenoh_ros2_sdk import qos

from adaptive_contact.ros2 import rmw

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_keys_are_those_of_the_design() -> None:
    key = f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"
    address = rmw.Address("/robot1/chatter", STRING, HASH)
    assert rmw.topic_key(0, address) == key
    assert rmw.address_of(key) == address
    read = zenoh.KeyExpr(rmw.any_type(0, "/robot1/chatter"))
    assert read.includes(zenoh.KeyExpr(key))
    below = rmw.topic_key(0, rmw.Address("/robot1/chatter/more", STRING, HASH))
    assert not read.intersects(zenoh.KeyExpr(below))


def test_tokens_are_those_of_the_design() -> None:
    node = rmw.Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "listener")
    assert node.token == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    token = node.endpoint_token("MS", 10, rmw.Address("/chatter", STRING, HASH), rmw.STREAM)
    assert token == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
    )


def test_attachments_are_what_zenoh_serializes() -> None:
    publisher = bytes(range(1, 17))
    made = rmw.Attachment(42, 1_700_000_000_000_000_000, publisher)
    seq, time_ns = Int64(made.seq), Int64(made.time_ns)
    plain = z_serialize((seq, time_ns, publisher)).to_bytes()
    assert rmw.encode_attachment(made) == plain
    assert rmw.decode_attachment(plain) == made
    for data in (b"", plain[:-1], plain + b"\0", plain[:16] + b"\x0f" + plain[17:], b"x" * 77):
        assert rmw.decode_attachment(data) is None


def test_quality_is_what_a_foreign_sdk_reads() -> None:
    latched = qos.QosProfile.decode(rmw.LATCHED)
    assert latched.durability is qos.QosDurability.TRANSIENT_LOCAL
    assert (latched.reliability, latched.history_depth) == (qos.QosReliability.RELIABLE, 1)
    stream = qos.QosProfile.decode(rmw.STREAM)
    assert (stream.durability, stream.history_depth) == (qos.QosDurability.VOLATILE, 10)
