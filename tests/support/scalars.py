"""What TensorBoard would read of a folder."""

import struct
from collections import defaultdict

from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]


def scalars(directory):
    """Return {tag: [(step, value), ...]} of the event files in a directory."""
    found = defaultdict(list)
    for path in directory.glob("events.out.tfevents.*"):
        data, position = path.read_bytes(), 0
        while position < len(data):
            (length,) = struct.unpack_from("<Q", data, position)
            event = Event.FromString(data[position + 12 : position + 12 + length])
            position += 12 + length + 4
            for value in event.summary.value:
                found[value.tag].append((event.step, value.simple_value))
    return dict(found)
