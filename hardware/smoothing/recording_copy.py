"""A copy of a recording with the smoothed poses beside the rest; the recording itself is never written to.

Of a damaged recording it holds what can be read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from estimation.batch.smoothed import Smoothed
from estimation.errors import StillbedError
from estimation.pose import SurfacePose, TrackState
from hardware.recording.mcap_file import Damage, pieces
from hardware.recording.messages import message_from_pose
from hardware.recording.schemas import POSE

TOPIC = "/smoothed"


def write_copy(source: Path, target: Path, smoothed: Smoothed) -> None:
    """Copy the .mcap file `source` to `target` with the channel /smoothed; StillbedError where it cannot be copied."""
    part = target.with_suffix(".part.mcap")
    try:
        with part.open("wb") as written:
            writer = Writer(written)
            writer.start(profile="", library="stillbed")
            copying = _Copying(writer)
            for piece in pieces(source):
                for record in () if isinstance(piece, Damage) else piece.records:
                    copying.write(record)
            _add(writer, smoothed, copying.epoch)
            writer.finish()  # type: ignore[no-untyped-call]
        os.replace(part, target)
    except McapError as error:
        raise StillbedError(f"{source}: cannot be copied: {error}") from error
    finally:
        part.unlink(missing_ok=True)


class _Copying:
    """Writes the records of one file into another, where channels have other numbers. epoch: s, as metadata said."""

    def __init__(self, writer: Writer) -> None:
        self.epoch = 0
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._kept: dict[int, int] = {}  # number of a channel that has messages: its number in the copy

    def write(self, record: McapRecord) -> None:
        """Write a record, or keep what later ones need of it."""
        if isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
            epoch = record.metadata.get("epoch_s", "")
            self.epoch = int(epoch) if epoch.isdecimal() else self.epoch
        elif isinstance(record, Attachment):
            a = record
            self._writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message) and self._channels[record.channel_id].topic != TOPIC:
            number, m = self._number(record.channel_id), record
            self._writer.add_message(number, m.log_time, m.data, m.publish_time, m.sequence)

    def _number(self, channel: int) -> int:
        if channel not in self._kept:
            of, schema = self._channels[channel], self._schemas.get(self._channels[channel].schema_id)
            number = 0 if schema is None else self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._kept[channel] = self._writer.register_channel(of.topic, of.message_encoding, number)
        return self._kept[channel]


def _add(writer: Writer, smoothed: Smoothed, epoch: int) -> None:
    kept = writer.register_schema(f"{POSE['title']}", "jsonschema", json.dumps(POSE).encode())
    channel = writer.register_channel(TOPIC, "json", kept)
    used = smoothed.fitted.used.sum(1)
    at = smoothed.instants
    for k, stamp in enumerate(smoothed.stamps):
        state = TrackState.TRACKING if used[k] else TrackState.COASTING
        pose = SurfacePose(
            float(stamp), at.base_from_surface[k], at.covariance[k], at.twist[k], state, at.twist_covariance[k]
        )
        data = json.dumps(message_from_pose(pose), allow_nan=False, separators=(",", ":")).encode()
        log_time = round(float(stamp) * 1e9) + epoch * 1_000_000_000
        writer.add_message(channel, log_time, data, log_time)
