"""An encoded picture as a recording holds it: ROS 2's sensor_msgs/msg/CompressedImage, its bytes as they are.

Its schema (MCAP's `ros2msg`) is the text below, its encoding (`cdr`) plain CDR, little endian: four bytes that say so,
then each field at a multiple of its own size, counted from behind those four (OMG DDS-XTypes, section 7.4, XCDR1).
Foxglove, Rerun and ROS 2 show it; JSON would need the picture as base64, a third larger and to be made and undone.
"""

from __future__ import annotations

import struct

NAME = "sensor_msgs/msg/CompressedImage"
SCHEMA_ENCODING, ENCODING = "ros2msg", "cdr"
SCHEMA = f"""std_msgs/Header header
string format
uint8[] data
{80 * "="}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{80 * "="}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
LAST_SECOND = 2**31 - 1  # that a Time holds: in 2038

_CDR = b"\x00\x01\x00\x00"  # plain CDR, little endian, no options
_WORD = struct.Struct("<I")
_TIME = struct.Struct("<iI")


def pack(kind: str, data: bytes, frame: str, log_time: int) -> bytes:
    """The message of a picture of `kind` ("png" or "jpeg") in the camera frame `frame`, at log_time, ns.

    A time after 2038 is told as the last one there is: the exact stamp stands in /frames.
    """
    seconds, rest = divmod(log_time, 1_000_000_000)
    head = _TIME.pack(min(seconds, LAST_SECOND), rest) + _text(frame) + _text(kind)
    return b"".join((_CDR, head, _WORD.pack(len(data)), data))


def unpack(message: bytes) -> tuple[str, bytes]:
    """Kind and bytes of the picture in a message; ValueError where it is none."""
    if message[: len(_CDR)] != _CDR:
        raise ValueError(f"begins with {message[: len(_CDR)]!r}, not as little-endian CDR does")
    _, start = _counted(message, len(_CDR) + _TIME.size)
    kind, start = _counted(message, start)
    data, _ = _counted(message, start)
    return kind.rstrip(b"\x00").decode(), data


def _text(text: str) -> bytes:
    """A string, ended by a zero, and so many more that what follows begins at a multiple of 4."""
    data = text.encode() + b"\x00"
    return _WORD.pack(len(data)) + data + bytes(-len(data) % 4)


def _counted(message: bytes, start: int) -> tuple[bytes, int]:
    """The bytes that a count at `start` announces, and where the next count is."""
    begin = start + _WORD.size
    if begin > len(message):
        raise ValueError(f"ends at byte {len(message)}, before a count at {start}")
    (count,) = _WORD.unpack_from(message, start)
    end = begin + int(count)
    if end > len(message):
        raise ValueError(f"ends at byte {len(message)}, in a field that ends at {end}")
    return message[begin:end], end + -count % 4
