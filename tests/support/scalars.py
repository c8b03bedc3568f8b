"""What TensorBoard would read of a folder."""

import struct
from collections import defaultdict

from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]


def scalars(directory):
    """Return {tag: [(step, value), ...]} of the event files in a directory."""
    found = defaultdict(list)
    for event in _events(directory):
        for value in event.summary.value:
            found[value.tag].append((event.step, value.simple_value))
    return dict(found)


def purges(directory):
    """Return the steps from which on what was written before is dropped, in the order of the files."""
    return [event.step for event in _events(directory) if event.HasField("session_log")]


def _events(directory):
    for path in sorted(directory.glob("events.out.tfevents.*")):
        data, position = path.read_bytes(), 0
        while position < len(data):
            (length,) = struct.unpack_from("<Q", data, position)
            yield Event.FromString(data[position + 12 : position + 12 + length])
            position += 12 + length + 4
