"""Stored parameters on disk: a JSON file with a checksum, replaced whole or not at all."""

import json
import os
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sim_drive.communication.parameters import (
    MemoryParameterStore,
    ParameterStore,
    ParameterStoreError,
    Place,
    StoredParameters,
)
from sim_drive.settings import DriveSettings

MAX_FILE_BYTES: Final = 1 << 20


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Literal["sim-drive parameters"] = "sim-drive parameters"
    version: Literal[1] = 1
    node_id: Annotated[int, Field(ge=1, le=127)] | Literal[255] | None = None
    bit_timing: Annotated[int, Field(ge=0, le=9)] | None = None
    saved_as: Annotated[int, Field(ge=1, le=127)] | None = None
    """Node id under which the values were saved; files of the time before it was noted lack it."""
    values: dict[
        Annotated[str, Field(pattern=r"^[0-9A-F]{4}:[0-9A-F]{2}$")],
        Annotated[str, Field(pattern=r"^([0-9A-F]{2}){1,8}$")],
    ]
    """Index and sub-index to little-endian bytes, all in hexadecimal."""

    def crc32(self) -> int:
        """CRC-32 of everything but itself, in the one way to write it."""
        without = {"saved_as"} if self.saved_as is None else None
        text = json.dumps(self.model_dump(exclude=without), sort_keys=True, separators=(",", ":"))
        return zlib.crc32(text.encode())


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    crc32: int
    parameters: _Body


class FileParameterStore:
    """Keeps a drive's parameters in the file at ``path``, whose folder has to exist."""

    __slots__ = ("path",)

    def __init__(self, path: Path) -> None:
        self.path: Final = path

    def load(self) -> StoredParameters | None:
        """See ParameterStore; a file that is not there stores nothing."""
        try:
            with self.path.open("rb") as file:
                raw = file.read(MAX_FILE_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ParameterStoreError(f"{self.path}: cannot be read: {error.strerror or error}") from None
        if len(raw) > MAX_FILE_BYTES:
            raise ParameterStoreError(f"{self.path}: larger than {MAX_FILE_BYTES} bytes, which no parameter file is")
        try:
            file = _File.model_validate_json(raw)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "file"
            raise ParameterStoreError(f"{self.path}: not a parameter file: {where}: {first['msg']}") from None
        body = file.parameters
        if body.crc32() != file.crc32:
            raise ParameterStoreError(f"{self.path}: damaged: its CRC-32 is {body.crc32()}, not {file.crc32}")
        values = {_place(name): bytes.fromhex(data) for name, data in body.values.items()}
        return StoredParameters(values, body.node_id, body.bit_timing, body.saved_as)

    def save(self, parameters: StoredParameters) -> None:
        """See ParameterStore."""
        body = _Body(
            node_id=parameters.node_id,
            bit_timing=parameters.bit_timing,
            saved_as=parameters.saved_as,
            values={
                f"{index:04X}:{subindex:02X}": data.hex().upper()
                for (index, subindex), data in sorted(parameters.values.items())
            },
        )
        text = _File(crc32=body.crc32(), parameters=body).model_dump_json(indent=1)
        beside = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            with beside.open("w") as file:
                file.write(text + "\n")
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self.path)
        except OSError as error:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            raise ParameterStoreError(f"{self.path}: cannot be written: {error.strerror or error}") from None


def make_parameter_store(settings: DriveSettings) -> ParameterStore:
    """The file that the settings name, or a store that lasts as long as the process."""
    path = settings.parameter_file
    return MemoryParameterStore() if path is None else FileParameterStore(path)


def _place(name: str) -> Place:
    index, subindex = name.split(":")
    return int(index, 16), int(subindex, 16)
