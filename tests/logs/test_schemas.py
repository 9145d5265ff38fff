"""Definitions in every language that logs store."""

import pytest

from soundmap.logs.messages import Form, form_of
from soundmap.logs.records import Channel
from soundmap.logs.schemas import SchemaError, message_type

SEPARATOR = "=" * 80 + "\n"
FRAME_IDL = """IDL: mics/msg/Frame
#include "std_msgs/msg/Header.idl"
module mics {
  module msg {
    @verbatim (language="comment", text=
      "One block of all microphones.")
    struct Frame {
      std_msgs::msg::Header header;
      string format;
      @verbatim (language="comment", text="Microphones.")
      uint32 channel_count;
      uint32 sampling_frequency;
      uint32 frame_sample_count;
      sequence<uint8> data;
    };
  };
};
"""
HEADER_IDL = """IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs {
  module msg {
    struct Header {
      builtin_interfaces::msg::Time stamp;
      string frame_id;
    };
  };
};
"""


def channel(name, encoding, text, message_encoding="cdr"):
    return Channel("/topic", message_encoding, name, encoding, text.encode())


def test_idl_definitions_are_read_with_what_they_include():
    text = SEPARATOR + FRAME_IDL + SEPARATOR + HEADER_IDL
    found = message_type(channel("mics/msg/Frame", "ros2idl", text))
    assert form_of(found) is Form.AUDIO_FRAME
    assert found.fields["header.stamp.nanosec"] == "uint32"
    # Header, stamp 1.000000002 s, frame "m", format "f", three numbers, one byte.
    data = bytes.fromhex("00010000 01000000 02000000 02000000 6d000000 02000000 66000000")
    data += bytes.fromhex("04000000 803e0000 0a000000 01000000 ff")
    message = found.decoder()(memoryview(data))
    assert (message.header.stamp.nanosec, message.header.frame_id) == (2, "m")
    assert (message.sampling_frequency, message.data.tolist()) == (16000, [255])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (channel("a/msg/B", "ros2msg", "float64 [[ 3"), "damaged"),
        (channel("a/msg/B", "ros2msg", "c/D d"), "c/msg/D is not in the log"),
        (channel("a/msg/B", "ros2msg", ""), "a/msg/B is not in the log"),
        (channel("a/msg/B", "omgidl", "struct B {};"), "'omgidl' cannot be read"),
        (channel("B", "jsonschema", "{}", "json"), "'json' cannot be read"),
        (channel("a.B", "protobuf", "not a descriptor", "protobuf"), "damaged"),
    ],
)
def test_what_cannot_be_read_is_said_in_a_few_words(given, says):
    with pytest.raises(SchemaError, match=says):
        message_type(given)


def test_a_type_that_contains_itself_ends_somewhere():
    found = message_type(channel("a/msg/Node", "ros2msg", "Node[] children\nfloat64 value\n"))
    assert found.has("children", "value")
