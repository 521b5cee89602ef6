"""An image in a recording is what ROS reads as one, and bytes that are none are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import SeekingReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from session_files import image, rig

from estimation.errors import InputError
from hardware.compressed_image import LAST_SECOND, NAME, pack, unpack
from hardware.files.images import decode, encode
from hardware.files.session import open_session
from hardware.recording.mcap_file import ChunkOf, Stored, walk
from hardware.recording.recorder import Recorder
from perception.frames import Frame
from tests.recorded import write_frames

STORE = get_typestore(Stores.ROS2_HUMBLE)
WORDS = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12)


@given(kind=WORDS, frame=WORDS, data=st.binary(max_size=70), log_time=st.integers(0, LAST_SECOND * 10**9))
def test_ros_reads_what_is_packed_and_so_do_we(kind: str, frame: str, data: bytes, log_time: int) -> None:
    packed = pack(kind, data, frame, log_time)
    assert unpack(packed) == (kind, data)
    told = STORE.deserialize_cdr(packed, NAME)
    stamp = told.header.stamp
    assert (told.format, told.header.frame_id, bytes(told.data)) == (kind, frame, data)
    assert stamp.sec * 10**9 + stamp.nanosec == log_time
    assert bytes(STORE.serialize_cdr(told, NAME)) == packed


@given(data=st.binary(max_size=30), cut=st.integers(0, 200))
def test_bytes_that_are_cut_are_refused(data: bytes, cut: int) -> None:
    packed = pack("png", data, "camera/left", 5)
    if cut < len(packed):
        with pytest.raises(ValueError, match=r"ends at byte|begins with"):
            unpack(packed[:cut])


def test_a_time_that_ros_cannot_tell_is_its_last() -> None:
    stamp = STORE.deserialize_cdr(pack("png", b"", "", (LAST_SECOND + 9) * 10**9 + 7), NAME).header.stamp
    assert (stamp.sec, stamp.nanosec) == (LAST_SECOND, 7)


def test_the_schema_in_the_file_is_the_one_that_ros_knows(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 3)
    with open(tmp_path / "x.mcap", "rb") as file:
        found = list(SeekingReader(file, validate_crcs=True).iter_messages(topics=["/camera/left/image"]))
    for number, (schema, channel, message) in enumerate(found):
        assert schema is not None
        assert (schema.name, schema.encoding, channel.message_encoding) == (NAME, "ros2msg", "cdr")
        defined = get_types_from_msg(schema.data.decode(), schema.name)
        assert all(STORE.fielddefs[name] == fields for name, fields in defined.items())
        picture = decode(bytes(STORE.deserialize_cdr(message.data, NAME).data), "x", "image")
        assert np.array_equal(picture, image(0, number))


def test_an_image_that_is_broken_inside_a_sound_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with Recorder(path, rig(2)) as recorder:
        recorder.write(Frame(0, 0.0, image(0, 0)))
    stored = next(m for part in walk(path) if isinstance(part, ChunkOf) for m in part.messages if "image" in m.topic)
    assert isinstance(stored, Stored) and unpack(stored.data) == encode(image(0, 0))
    with Recorder(path, rig(2), overwrite=True) as recorder:
        recorder.encoded_frame(0, 0.0, "png", b"no picture")
    with pytest.raises(InputError, match="undecodable"):
        open_session(path)
