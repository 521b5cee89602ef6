"""The index of a recording that is being written, kept as the bytes that it ends with.

The library keeps a dictionary for each chunk until the file is closed: 7 to 10 MB an hour of a live run. Its records
say the same in a tenth of that.
"""

from __future__ import annotations

from collections.abc import Iterator

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

from estimation.errors import StillbedError

CHUNKS = "_Writer__chunk_indices"  # the list that the library keeps them in, and goes through at the end


class PackedIndex:
    """Takes the index of each chunk, and gives all of them as one thing that can be written."""

    def __init__(self) -> None:
        self._records = bytearray()

    def append(self, index: ChunkIndex) -> None:
        """Keep the index of one more chunk."""
        builder = RecordBuilder()
        index.write(builder)
        self._records += builder.end()  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator[PackedIndex]:
        if self._records:
            yield self

    def write(self, stream: RecordBuilder) -> None:
        """Write the records of all chunks, in the order in which they came."""
        stream.write(self._records)


def pack_index(writer: Writer) -> None:
    """Have a writer that has written no chunk yet keep its index as bytes.

    StillbedError where the library keeps it elsewhere: another version than the one that was tested.
    """
    if getattr(writer, CHUNKS, None) != []:
        raise StillbedError("this version of mcap keeps its index elsewhere; install the one in constraints.txt")
    setattr(writer, CHUNKS, PackedIndex())
