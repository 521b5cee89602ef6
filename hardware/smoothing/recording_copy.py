"""A copy of a recording with the smoothed poses beside the rest; the recording itself is never written to."""

from __future__ import annotations

import json
import os
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from estimation.errors import StillbedError
from estimation.pose import SurfacePose, TrackState
from estimation.smoothing.smoothed import Smoothed
from hardware.messages import message_from_pose
from hardware.schemas import POSE

TOPIC = "/smoothed"


def write_copy(source: Path, target: Path, smoothed: Smoothed) -> None:
    """Copy the .mcap file `source` to `target` with the channel /smoothed; StillbedError where it cannot be read."""
    part = target.with_suffix(".part.mcap")
    try:
        with source.open("rb") as read, part.open("wb") as written:
            reader, writer = make_reader(read), Writer(written)
            writer.start(profile="", library="stillbed")
            epoch = 0
            for metadata in reader.iter_metadata():
                writer.add_metadata(metadata.name, metadata.metadata)
                epoch = int(metadata.metadata.get("epoch_s", epoch))
            for a in reader.iter_attachments():
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            channels: dict[int, int] = {}
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if channel.topic == TOPIC:
                    continue
                if channel.id not in channels:
                    kept = 0
                    if schema is not None:
                        kept = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kept)
                number = channels[channel.id]
                writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
            _add(writer, smoothed, epoch)
            writer.finish()  # type: ignore[no-untyped-call]
        os.replace(part, target)
    except McapError as error:
        raise StillbedError(f"{source}: cannot be copied: {error}") from error
    finally:
        part.unlink(missing_ok=True)


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
