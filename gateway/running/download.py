"""Downloads a cam into a drive's profile slot and proves that it arrived: read-back, CRC and the drive's own parse.

The slot's life cycle is the one that real drives with cam memory have in common: write the data, have it parsed, ask
for the result, select it. A slot whose parse fails is left unselected.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers import objects
from drivers.master import Master, Procedure
from drivers.object_dictionary import DataType
from gateway.errors import GatewayError
from gateway.running.commissioning import NodeSettings, check_identity

PARSE: Final = 1
STATE_VALID: Final = 2
STATE_INVALID: Final = 3
PARSE_TIMEOUT_S: Final = 5.0
PARSE_POLL_S: Final = 0.01
TRANSFER_TIMEOUT_S: Final = 2.0
U8, U32 = DataType.UNSIGNED8, DataType.UNSIGNED32


@dataclass(frozen=True, slots=True)
class DownloadResult:
    """What the drive holds after a download. ``crc`` is CRC-32 of the whole image."""

    node_id: int
    slot: int
    bytes: int
    points: int
    crc: int
    is_selected: bool
    elapsed_s: float


def download_image(
    master: Master,
    node: NodeSettings,
    slot: int,
    image: bytes,
    is_selecting: bool,
    on_step: Callable[[str], None] | None = None,
) -> Procedure[DownloadResult]:
    """Write ``image`` into profile slot ``slot`` (1 to 4) of a drive, verify it, and select it if asked.

    Raises GatewayError if the drive holds something else afterwards, or refuses the table; drivers.errors.NodeError if
    it does not answer or aborts.
    """

    def say(step: str) -> None:
        if on_step is not None:
            on_step(step)

    started_ns = master.now_ns
    node_id, index = node.node_id, objects.PROFILE_SLOT + slot - 1
    say("checking the drive's identity")
    yield from check_identity(master, node)
    selected = yield from master.read_int(node_id, objects.PROFILE_SLOT_SELECTED, 0, U8)
    if selected == slot:
        # A table must not change under a drive that may be running it.
        yield from master.write(node_id, objects.PROFILE_SLOT_SELECTED, 0, U8, 0)
    say(f"writing {len(image)} bytes into slot {slot}")
    yield from master.download(node_id, index, objects.PROFILE_SLOT_DATA, image, TRANSFER_TIMEOUT_S)
    say("reading them back")
    stored = yield from master.upload(node_id, index, objects.PROFILE_SLOT_DATA, TRANSFER_TIMEOUT_S)
    if stored != image:
        different = next((i for i, (a, b) in enumerate(zip(stored, image, strict=False)) if a != b), None)
        where = f"{len(stored)} bytes instead of {len(image)}" if different is None else f"differs at byte {different}"
        raise GatewayError(f"axis {node.name}: slot {slot} reads back wrong: {where}")
    crc = zlib.crc32(image)
    held = yield from master.read_int(node_id, index, objects.PROFILE_SLOT_CRC, U32)
    if held != crc:
        raise GatewayError(f"axis {node.name}: slot {slot} has CRC {held:08X}h, the image has {crc:08X}h")
    say("having the drive parse it")
    yield from master.write(node_id, index, objects.PROFILE_SLOT_COMMAND, U8, PARSE)
    deadline_ns = master.now_ns + round(PARSE_TIMEOUT_S * 1e9)
    while True:
        state = yield from master.read_int(node_id, index, objects.PROFILE_SLOT_STATE, U8)
        if state in {STATE_VALID, STATE_INVALID} or master.now_ns >= deadline_ns:
            break
        yield from master.pause(PARSE_POLL_S)
    if state != STATE_VALID:
        error = yield from master.read_int(node_id, index, objects.PROFILE_SLOT_ERROR, U8)
        raise GatewayError(
            f"axis {node.name}: the drive refuses the table in slot {slot} (state {state}, error {error})"
        )
    points = yield from master.read_int(node_id, index, objects.PROFILE_SLOT_POINTS, U32)
    if is_selecting:
        yield from master.write(node_id, objects.PROFILE_SLOT_SELECTED, 0, U8, slot)
    elapsed_s = (master.now_ns - started_ns) * 1e-9
    return DownloadResult(node_id, slot, len(image), points, crc, is_selecting, elapsed_s)
