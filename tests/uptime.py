"""Recordings as they would be after another uptime: all stamps moved by one offset, with the floats that gives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hardware.recording.mcap_file import CHECKSUM_KEY, sealed
from hardware.recording.recorder import LOG_EPOCH
from hardware.recording.session_reader import open_session

MINUTE, DAY = 60.0, 86_400.0
STAMPS = ("stamp", "camera_stamp")
OPTIONAL_STAMPS = ("pose_stamp", "onset")  # a list that is empty where there is none


def moved(recording: Path, out: Path, first: float) -> Path:
    """A copy of a recording whose first picture has the stamp `first`, s."""
    by = first - min(ref.stamp for refs in open_session(recording).sets for ref in refs)
    with recording.open("rb") as source, out.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, compression=CompressionType.NONE)
        writer.start("ros2", "stillbed")
        channels: dict[int, int] = {}
        for metadata in reader.iter_metadata():
            table = {key: text for key, text in metadata.metadata.items() if key != CHECKSUM_KEY}
            table |= {"epoch_ns": str(LOG_EPOCH * 10**9), "log_times": "not known"}
            writer.add_metadata(metadata.name, sealed(table))
        for kept in reader.iter_attachments():
            writer.add_attachment(kept.create_time, kept.log_time, kept.name, kept.media_type, kept.data)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                number = 0 if schema is None else writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = message.data
            if channel.message_encoding == "json":
                data = json.dumps(_moved(json.loads(data), by)).encode()
            log_time = message.log_time + round(by * 1e9)
            writer.add_message(channels[channel.id], log_time, data, log_time, message.sequence)
        writer.finish()
    return out


def _moved(value: Any, by: float) -> Any:
    if isinstance(value, list):
        return value if not value or not isinstance(value[0], dict) else [_moved(each, by) for each in value]
    if not isinstance(value, dict):
        return value
    out = {key: _moved(each, by) for key, each in value.items()}
    for key in STAMPS:
        if isinstance(out.get(key), (int, float)):
            out[key] += by
    for key in OPTIONAL_STAMPS:
        if isinstance(out.get(key), list):
            out[key] = [each + by for each in out[key]]
    return out
