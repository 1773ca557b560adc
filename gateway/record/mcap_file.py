"""MCAP files of many small messages of one size: chunks are built and taken apart as whole arrays.

The package ``mcap`` knows the records of the format and is used for them; its writer takes some 5 us a message, which
would be most of what a run in virtual time costs. Here a chunk holds messages of one channel, and the chunk's bytes,
its message index and its messages' headers are made by numpy at once. Any MCAP reader reads the result.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, BinaryIO, Final

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_COMPRESSION_LEVEL: Final = 3
_MAX_CHUNK_BYTES: Final = 1 << 28
_RECORD_HEADER: Final = struct.Struct("<BQ")
_MESSAGE_FIELDS: Final = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
_MESSAGE_HEADER: Final = np.dtype(_MESSAGE_FIELDS)
_MESSAGE_OVERHEAD: Final = _MESSAGE_HEADER.itemsize - _RECORD_HEADER.size
_INDEX_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class McapError(Exception):
    """Not an MCAP file, or a damaged one; ``offset`` is the byte where it was noticed."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(f"{reason} (at byte {offset})")
        self.offset = offset
        self.reason = reason


class McapWriter:
    """Writes an MCAP file to ``stream``, which must be at its start and stays the caller's to close."""

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._position = 0
        self._compressor = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indices: list[ChunkIndex] = []
        self._attachment_indices: list[AttachmentIndex] = []
        self._metadata_indices: list[MetadataIndex] = []
        self._message_counts: dict[int, int] = {}
        self._time_range: tuple[int, int] | None = None
        self._write(MCAP_MAGIC)
        self._write_record(Header(profile="", library=library))

    def _write(self, data: bytes) -> int:
        """Write, and say where it began."""
        start = self._position
        self._stream.write(data)
        self._position += len(data)
        return start

    def _write_record(self, record: McapRecord) -> tuple[int, int]:
        """Write, and say where it began and how long it is."""
        data = _encode(record)
        return self._write(data), len(data)

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Register a message definition; returns its id."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=text.encode())
        self._schemas.append(schema)
        self._write_record(schema)
        return schema.id

    def add_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """Register a channel; returns its id."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=message_encoding,
            metadata={},
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._message_counts[channel.id] = 0
        self._write_record(channel)
        return channel.id

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write a file into the file."""
        record = Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        offset, length = self._write_record(record)
        self._attachment_indices.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=0,
                create_time=0,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a table of texts."""
        offset, length = self._write_record(Metadata(name=name, metadata=dict(data)))
        self._metadata_indices.append(MetadataIndex(offset=offset, length=length, name=name))

    def write_array(self, channel_id: int, log_times: NDArray[np.uint64], bodies: NDArray[np.uint8]) -> None:
        """Write one chunk: message i is ``bodies[i]``; ``bodies`` has shape (messages, bytes of a message)."""
        count, size = bodies.shape
        messages = np.empty(count, np.dtype([*_MESSAGE_FIELDS, ("body", "u1", (size,))]))
        messages["opcode"] = Opcode.MESSAGE
        messages["length"] = size + _MESSAGE_OVERHEAD
        messages["channel"] = channel_id
        messages["sequence"] = np.arange(count, dtype=np.uint32) + np.uint32(self._message_counts[channel_id])
        messages["log_time"] = messages["publish_time"] = log_times
        messages["body"] = bodies
        offsets = np.arange(count, dtype=np.uint64) * np.uint64(messages.dtype.itemsize)
        self._write_chunk(channel_id, messages.tobytes(), log_times, offsets)

    def write_messages(self, channel_id: int, messages: Sequence[tuple[int, bytes]]) -> None:
        """Write one chunk of messages of any size, as (log time, body)."""
        builder = RecordBuilder()
        offsets: list[int] = []
        for number, (log_time, body) in enumerate(messages, start=self._message_counts[channel_id]):
            offsets.append(builder.count)
            Message(channel_id=channel_id, log_time=log_time, publish_time=log_time, sequence=number, data=body).write(
                builder
            )
        times = np.array([log_time for log_time, _ in messages], dtype=np.uint64)
        self._write_chunk(channel_id, builder.end(), times, np.array(offsets, dtype=np.uint64))

    def _write_chunk(
        self, channel_id: int, data: bytes, log_times: NDArray[np.uint64], offsets: NDArray[np.uint64]
    ) -> None:
        first, last = int(log_times.min()), int(log_times.max())
        compressed = self._compressor.compress(data)
        chunk_offset, chunk_length = self._write_record(
            Chunk(
                compression="zstd",
                data=compressed,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        entries = np.empty(len(log_times), dtype=_INDEX_ENTRY)
        entries["log_time"] = log_times
        entries["offset"] = offsets
        body = struct.pack("<HI", channel_id, entries.nbytes) + entries.tobytes()
        index_data = _RECORD_HEADER.pack(Opcode.MESSAGE_INDEX, len(body)) + body
        index_offset = self._write(index_data)
        self._chunk_indices.append(
            ChunkIndex(
                message_start_time=first,
                message_end_time=last,
                chunk_start_offset=chunk_offset,
                chunk_length=chunk_length,
                message_index_offsets={channel_id: index_offset},
                message_index_length=len(index_data),
                compression="zstd",
                compressed_size=len(compressed),
                uncompressed_size=len(data),
            )
        )
        self._message_counts[channel_id] += len(log_times)
        known = self._time_range or (first, last)
        self._time_range = min(known[0], first), max(known[1], last)

    def finish(self) -> None:
        """Write the summary, without which only readers that go through the whole file can read it."""
        self._write_record(DataEnd(0))
        start, end = self._time_range or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachment_indices),
            channel_count=len(self._channels),
            channel_message_counts={id_: count for id_, count in self._message_counts.items() if count},
            chunk_count=len(self._chunk_indices),
            message_count=sum(self._message_counts.values()),
            metadata_count=len(self._metadata_indices),
            message_start_time=start,
            message_end_time=end,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indices),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indices),
            (Opcode.METADATA_INDEX, self._metadata_indices),
        ]
        summary_start = self._position
        summary = b""
        offsets = b""
        for opcode, records in groups:
            group = b"".join(map(_encode, records))
            if group:
                group_start = summary_start + len(summary)
                offsets += _encode(SummaryOffset(group_opcode=opcode, group_start=group_start, group_length=len(group)))
                summary += group
        offset_start = summary_start + len(summary)
        footer = struct.pack("<QQ", summary_start, offset_start)
        # The CRC covers the summary and the footer up to the CRC itself.
        crc = zlib.crc32(summary + offsets + _RECORD_HEADER.pack(Opcode.FOOTER, len(footer) + 4) + footer)
        self._write(summary + offsets)
        self._write_record(Footer(summary_start=summary_start, summary_offset_start=offset_start, summary_crc=crc))
        self._write(MCAP_MAGIC)


def _encode(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


@dataclass(frozen=True, slots=True)
class RawChunk:
    """A chunk as it lies in the file."""

    offset: int
    compression: str
    data: bytes
    uncompressed_size: int
    uncompressed_crc: int

    def messages(self) -> bytes:
        """The records in it. Raises ``McapError`` where it is damaged, or larger than it says."""
        if self.uncompressed_size > _MAX_CHUNK_BYTES:
            raise McapError(self.offset, f"a chunk of {self.uncompressed_size} bytes, at most {_MAX_CHUNK_BYTES} taken")
        if self.compression == "":
            data = self.data
        elif self.compression == "zstd":
            data = _decompress(self)
        else:
            raise McapError(self.offset, f"a chunk compressed with {self.compression!r}, only zstd is known")
        if len(data) != self.uncompressed_size or (self.uncompressed_crc and zlib.crc32(data) != self.uncompressed_crc):
            raise McapError(self.offset, "a chunk fails its checksum")
        return data


def _decompress(chunk: RawChunk) -> bytes:
    try:
        declared = zstandard.get_frame_parameters(chunk.data).content_size
        if declared not in (zstandard.CONTENTSIZE_UNKNOWN, chunk.uncompressed_size):
            raise McapError(chunk.offset, "a chunk contradicts itself about its size")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise McapError(chunk.offset, f"a chunk cannot be decompressed: {error}") from error


Scanned = Schema | Channel | RawChunk | Message | Attachment | Metadata | Footer
"""What ``scan`` yields."""

_READABLE: Final[dict[int, Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.FOOTER: Footer,
}


def scan(data: bytes | memoryview) -> Iterator[Scanned]:
    """Go through the file from its start; ends without a ``Footer`` where the file ends early.

    Raises ``McapError`` for a foreign file and for records that make no sense.
    """
    if bytes(data[: len(MCAP_MAGIC)]) != MCAP_MAGIC:
        raise McapError(0, "not an MCAP file")
    offset = len(MCAP_MAGIC)
    while offset + _RECORD_HEADER.size <= len(data):
        opcode, length = _RECORD_HEADER.unpack_from(data, offset)
        end = offset + _RECORD_HEADER.size + length
        if end > len(data):
            return
        if opcode in _READABLE or opcode == Opcode.MESSAGE:
            record = _parse(opcode, bytes(data[offset + _RECORD_HEADER.size : end]), offset)
            yield record
            if isinstance(record, Footer):
                return
        offset = end


def _parse(opcode: int, body: bytes, offset: int) -> Scanned:
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.MESSAGE:
            return Message.read(stream, len(body))
        record = _READABLE[opcode].read(stream)
    except Exception as error:
        # mcap's readers raise whatever their slicing and decoding meets: EndOfFile, struct.error, UnicodeDecodeError
        raise McapError(offset, f"a damaged record: {error or type(error).__name__}") from error
    if isinstance(record, Chunk):
        return RawChunk(offset, record.compression, record.data, record.uncompressed_size, record.uncompressed_crc)
    return record


Bodies = list[bytes] | NDArray[np.uint8]
"""Messages without their headers; an array, shape (messages, bytes), where all have one size and channel."""


def split_records(records: bytes, offset: int) -> tuple[dict[int, Bodies], list[Channel]]:
    """Bodies of the messages in a chunk's records, by channel id, and the channels that are declared there.

    Raises ``McapError``; ``offset`` is where the chunk lies, for its message.
    """
    if not records:
        return {}, []
    if len(records) >= _MESSAGE_HEADER.itemsize:
        head = np.frombuffer(records, _MESSAGE_HEADER, 1)[0]
        total = int(head["length"]) + _RECORD_HEADER.size
        if total >= _MESSAGE_HEADER.itemsize and len(records) % total == 0 and head["opcode"] == Opcode.MESSAGE:
            rows = np.frombuffer(records, np.uint8).reshape(-1, total)
            same = (rows[:, : _RECORD_HEADER.size + 2] == rows[0, : _RECORD_HEADER.size + 2]).all()
            if same:
                return {int(head["channel"]): rows[:, _MESSAGE_HEADER.itemsize :]}, []
    bodies: dict[int, list[bytes]] = {}
    channels: list[Channel] = []
    position = 0
    while position < len(records):
        if position + _RECORD_HEADER.size > len(records):
            raise McapError(offset, "a chunk ends within a record")
        opcode, length = _RECORD_HEADER.unpack_from(records, position)
        start, position = position + _RECORD_HEADER.size, position + _RECORD_HEADER.size + length
        if position > len(records) or (opcode == Opcode.MESSAGE and length < _MESSAGE_OVERHEAD):
            raise McapError(offset, "a chunk ends within a record")
        if opcode == Opcode.MESSAGE:
            (channel,) = struct.unpack_from("<H", records, start)
            bodies.setdefault(channel, []).append(records[start + _MESSAGE_OVERHEAD : position])
        elif opcode == Opcode.CHANNEL:
            declared = _parse(opcode, records[start:position], offset)
            channels += [declared] if isinstance(declared, Channel) else []
    return dict(bodies), channels
