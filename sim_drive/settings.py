"""What distinguishes one emulated drive from another: identity, encoder, motor, and limits of its own making."""

from dataclasses import dataclass, field
from pathlib import Path

from config.quirks import Quirk
from sim_drive.switches import Switches


@dataclass(frozen=True, slots=True)
class DriveIdentity:
    """Identity object 1018h."""

    vendor_id: int = 0x000004D2
    """A placeholder: CiA assigns vendor ids, and the emulator has none."""
    product_code: int = 0x00001024
    revision_number: int = 0x00010000
    serial_number: int = 1


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Everything about a drive that is not in its EDS file; the defaults are those of the file that ships."""

    identity: DriveIdentity = field(default_factory=DriveIdentity)
    counts_per_revolution: int = 4096
    rated_torque_Nm: float = 1.5
    gains: tuple[int, ...] | None = None
    """Defaults of 3020h (K_P, K_I, K_D, K_V, K_F over 256); None keeps those of the EDS file."""
    switches: Switches = field(default_factory=Switches)
    initial_offset_counts: int = 0
    """Position actual value minus shaft counts after power-on, before any homing."""
    missing_set_point_limit: int = 5
    """Default of 3050h: interpolation times without a set-point after which an enabled axis faults (8700h); 0 never
    does."""
    cam_jump_window_counts: int = 64
    """How far the cam's demand may be from the axis when it is engaged."""
    sdo_timeout_s: float = 1.0
    """How long a client may pause within a segmented or block transfer."""
    sdo_block_size: int = 127
    """Segments in a sub-block of a block download, 1 to 127."""
    boot_up_delay_s: float = 0.0
    """From power-on or a reset to the boot-up message."""
    quirks: frozenset[Quirk] = frozenset()
    """Habits of real drives that it has."""
    further_axes: tuple["DriveSettings", ...] = ()
    """Logical axes of the node beside the first, 7 at most; of theirs counts what concerns an axis."""
    parameter_file: Path | None = None
    """Where parameters are stored (1010h) over the end of the process; None: nowhere."""
