"""The loop transfer measured: sines injected at the controllers' outputs of a machine that holds still, correlated.

With the machine held at a position, a torque offset d is added at one controller's output at a time. What the output
then is, w = (I + L)^-1 d, is correlated with the injection over whole periods, which gives the sensitivity S = (I +
L)^-1 column by column, and so L = S^-1 - I at that frequency, with everything in it that the machine really has:
quantisation, sampling, delay, coupling. Dry friction would stick at these amplitudes; measure without it, or moving.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import yaml
from numpy.typing import NDArray

from config.schema import GatewayConfig
from gateway.errors import GatewayError
from gateway.tuning.controller import SERVO_RATE_HZ
from gateway.tuning.margins import Margins, margins_of

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Complex = NDArray[np.complex128]

SETTLE_S: Final = 1
MEASURE_S: Final = 2
"""Whole seconds hold whole periods of whole frequencies, of the servo ticks, and of the usual SYNC periods."""
DEFAULT_AMPLITUDE_NM: Final = 0.15
DEFAULT_FREQUENCIES_HZ: Final = (
    *range(2, 20, 2),
    *range(20, 60, 4),
    *range(60, 140, 8),
    *range(140, 300, 20),
    *range(300, 461, 40),
)
FINE_COUNTS: Final = 1 << 20
"""Counts a revolution of a resolver whose quantisation does not hide the loop."""
_COMMAND: Final = 2
_OFFSET: Final = 4


class SimulatedRun(Protocol):
    """What `SimulatedLoop.run` answers."""

    @property
    def actual_counts(self) -> Int:
        """(n, 2): latched at each SYNC."""
        ...

    @property
    def error_counts(self) -> Int:
        """(n, 2): following errors, as the gateway has them."""
        ...

    @property
    def is_torn(self) -> bool:
        """Whether the linkage came too near a singular position."""
        ...

    @property
    def ticks(self) -> Float:
        """(m, 2, 5): counts, demand, torque command, torque and torque offset (N m) at every servo tick."""
        ...


class SimulatedLoop(Protocol):
    """A machine under its controllers, simulated; `sim_drive.closed_loop.ClosedLoop` is one."""

    gains: Float

    @property
    def cycle_s(self) -> float:
        """Time from SYNC to SYNC."""
        ...

    def reset(
        self,
        seed: int = 0,
        theta_rad: tuple[float, float] | None = None,
        omega_rad_per_s: tuple[float, float] = (0.0, 0.0),
        torque_Nm: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Begin anew, enabled, at these angles and velocities."""
        ...

    def run(
        self,
        targets: Int,
        torque_offsets: Float | None = None,
        *,
        sync_ns: Int | None = None,
        record_ticks: bool = False,
    ) -> SimulatedRun:
        """Go on for n SYNCs with targets (counts) and torque offsets (per mille of rated torque), both (n, 2)."""
        ...


@dataclass(frozen=True, slots=True)
class MeasuredLoop:
    """The loop transfer (m, 2, 2) at one position, and its margins."""

    theta2: float
    frequencies_hz: Float
    transfer: Complex

    def margins(self) -> Margins:
        """As of a model; the least between the frequencies that were measured."""
        return margins_of(self.transfer[None], self.frequencies_hz, np.array([self.theta2]))


def frictionless_text(config: GatewayConfig) -> str:
    """The configuration for a measurement: without dry friction, and with resolvers of ``FINE_COUNTS``."""
    document = config.model_dump(mode="json")
    for axis in document["axes"].values():
        axis["counts_per_revolution"] = FINE_COUNTS
        axis["limits"]["following_error_counts"] = FINE_COUNTS // 4
        axis["limits"]["guarded_error_counts"] = None
        axis["emulation"]["coulomb_Nm"] = 0.0
        axis["emulation"]["resolver_noise_counts"] = 0.0
    return yaml.safe_dump(document, sort_keys=False)


def measure_loop(
    loop: SimulatedLoop,
    theta_rad: tuple[float, float],
    counts_per_rad: tuple[float, float],
    rated_torque_Nm: tuple[float, float],
    frequencies_hz: tuple[int, ...] = DEFAULT_FREQUENCIES_HZ,
    amplitude_Nm: float = DEFAULT_AMPLITUDE_NM,
    seed: int = 0,
) -> MeasuredLoop:
    """Measure at the position ``theta_rad``, with sines of ``amplitude_Nm`` of whole frequencies.

    Raises GatewayError if the linkage tears meanwhile.
    """
    transfer = np.zeros((len(frequencies_hz), 2, 2), dtype=np.complex128)
    held = np.floor(np.array(theta_rad) * np.array(counts_per_rad) + 0.5).astype(np.int64)
    for number, hz in enumerate(frequencies_hz):
        outputs = np.zeros((2, 2), dtype=np.complex128)
        inputs = np.zeros((2, 2), dtype=np.complex128)
        for axis in (0, 1):
            injected, given = _response(loop, held, theta_rad, rated_torque_Nm, axis, hz, amplitude_Nm, seed)
            inputs[:, axis], outputs[:, axis] = injected, given
        sensitivity = outputs @ np.linalg.inv(inputs)
        transfer[number] = np.linalg.inv(sensitivity) - np.eye(2)
    return MeasuredLoop(theta_rad[0], np.array(frequencies_hz, dtype=np.float64), transfer)


def _response(
    loop: SimulatedLoop,
    held: Int,
    theta_rad: tuple[float, float],
    rated_torque_Nm: tuple[float, float],
    axis: int,
    hz: int,
    amplitude_Nm: float,
    seed: int,
) -> tuple[Complex, Complex]:
    """Injection and output of both axes at ``hz``, N m, as complex amplitudes over the servo ticks."""
    count = round((SETTLE_S + MEASURE_S) / loop.cycle_s)
    offsets = np.zeros((count, 2))
    phase = 2.0 * np.pi * hz * loop.cycle_s * np.arange(count)
    offsets[:, axis] = amplitude_Nm * np.sin(phase) * 1000.0 / rated_torque_Nm[axis]
    loop.reset(seed, theta_rad)
    run = loop.run(np.tile(held, (count, 1)), offsets, record_ticks=True)
    if run.is_torn:
        raise GatewayError(f"the linkage tore while {hz} Hz were injected at axis {axis}: the loop is unstable")
    measured = run.ticks[-MEASURE_S * SERVO_RATE_HZ :]
    carrier: Complex = np.exp(-2j * np.pi * hz * np.arange(len(measured)) / SERVO_RATE_HZ)
    measured = measured.astype(np.complex128)
    return carrier @ measured[:, :, _OFFSET], carrier @ measured[:, :, _COMMAND]
