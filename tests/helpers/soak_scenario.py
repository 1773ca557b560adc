"""What happens in a soak, drawn from a seed: a machine, its sessions one after the other, what goes wrong in them."""

import itertools
import os
import tempfile
from dataclasses import dataclass
from enum import Enum, unique
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import yaml
from torque_loops import put_in_torque

from config.conversion import closure_at_home, five_bar
from config.loading import load_config
from drivers import objects
from gateway.cyclic.guard import Condition
from gateway.cyclic.operation import Order
from gateway.running.preparation import compile_config
from sim_drive.injection.faults import PARAMETERS, Direction, Fault, FaultKind

CV, SERVO = 1, 2
PAPER = load_config("paper")


@unique
class Moment(Enum):
    """When something begins: so long after this has been reached in a session."""

    COMMISSIONING = "commissioning"
    ENABLING = "enabling"
    STANDSTILL = "standstill"
    APPROACH = "approach"
    RAMP_UP = "ramp up"
    CAM = "cam"
    RETURN_STROKE = "return stroke"
    RAMP_DOWN = "ramp down"
    CONTROLLED_STOP = "controlled stop"
    QUICK_STOP = "quick stop"
    RECOVERY = "recovery"


IN_MOTION = (Moment.APPROACH, Moment.RAMP_UP, Moment.CAM, Moment.RETURN_STROKE, Moment.RAMP_DOWN)
IN_A_STOP = (Moment.CONTROLLED_STOP, Moment.QUICK_STOP, Moment.RECOVERY)
DELAY_S = {
    Moment.COMMISSIONING: 0.06,
    Moment.ENABLING: 0.02,
    Moment.STANDSTILL: 0.1,
    Moment.APPROACH: 2.0,
    Moment.RAMP_UP: 1.4,
    Moment.RETURN_STROKE: 0.12,
    Moment.RAMP_DOWN: 1.4,
    Moment.CONTROLLED_STOP: 1.2,
    Moment.QUICK_STOP: 0.15,
    Moment.RECOVERY: 0.2,
}


@unique
class Mischief(Enum):
    """What happens that is no fault of the machine."""

    HOST_AWAY = "host away"
    """The gateway's process gets no processor for a while."""
    HOST_LATE = "host late"
    """Everything that it sends comes a cycle late."""
    CONTROLLER_OFF = "controller off"
    """The gateway's own controller goes bus-off, and comes back."""
    KILLED = "gateway killed"
    STOP = "operator stop"
    SIGTERM = "sigterm"
    QUICK_STOP = "operator's quick stop"
    OVERRIDE = "override"
    JOG = "jog"
    PHASE_SHIFT = "phase shift"
    DISENGAGE = "disengage"
    ENGAGE = "engage"
    WINDOW = "window"


ORDER_OF = {
    Mischief.OVERRIDE: Order.OVERRIDE,
    Mischief.JOG: Order.JOG,
    Mischief.PHASE_SHIFT: Order.PHASE_SHIFT,
    Mischief.DISENGAGE: Order.DISENGAGE,
    Mischief.ENGAGE: Order.ENGAGE,
    Mischief.WINDOW: Order.WINDOW,
}
WISH_OF = {Mischief.STOP: Condition.OPERATOR_STOP, Mischief.SIGTERM: Condition.SIGTERM}


@dataclass(frozen=True, slots=True)
class Provocation:
    """One thing that happens to a session."""

    moment: Moment
    delay_s: float
    what: Fault | Mischief
    value: float = 0.0
    """Of an order in its own unit; for how long a host is away or late, or a controller off, s."""

    @property
    def name(self) -> str:
        """Of the kind, for tables."""
        return self.what.kind.value if isinstance(self.what, Fault) else self.what.value

    def __str__(self) -> str:
        if not isinstance(self.what, Fault):
            return f"{self.name} ({self.value:g})" if self.value else self.name
        given = {key: getattr(self.what, key) for key in ("node_id", "for_s", *PARAMETERS)}
        values = (f"{key}={getattr(value, 'value', value)}" for key, value in given.items() if value is not None)
        return f"{self.name} ({', '.join(values)})"


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """One session."""

    machine_cycles: int
    provocations: tuple[Provocation, ...]


@dataclass(frozen=True, slots=True)
class Campaign:
    """One machine, from its first power-up on."""

    seed: int
    gateway_text: str
    """Configuration of the gateway."""
    machine_text: str
    """Configuration of the machine, which the gateway's is not quite right about."""
    friction_drift: float
    """Share by which friction swings."""
    sessions: tuple[SessionPlan, ...]


def draw_campaign(seed: int) -> Campaign:
    """The campaign of a seed."""
    source = Random(seed)
    document = _document(
        source.choice((60, 60, 60, 60, 45, 30)),
        source.choice((CURVES[0], *CURVES)),
        source.random() < 0.2,
        source.random() < 0.2,
    )
    rpm = document["motion"]["speed_rpm"]
    gateway_text = yaml.safe_dump(document)
    _make_otherwise(document, source)
    sessions = tuple(draw_session(source, rpm) for _ in range(source.randint(5, 10)))
    return Campaign(seed, gateway_text, yaml.safe_dump(document), source.choice((0.0, 0.1, 0.2)), sessions)


def _document(rpm: int, curve: Path, is_learning: bool, is_torque_controlled: bool) -> dict[str, Any]:
    document = yaml.safe_load(PAPER.text)
    document["motion"]["speed_rpm"] = rpm
    document["motion"]["curve"] = str(curve)
    if is_learning:
        document["learning"] = {"enabled": True}
    if is_torque_controlled:
        put_in_torque(document)
        # Drives that are told no torque go on with the last one.
        document["guard"]["sync_lost"]["limit_cycles"] = 6
        for axis in document["axes"].values():
            axis["sync_watchdog"]["cycles"] = 12
    return document


def gateway_texts() -> list[str]:
    """Every configuration of a gateway that a campaign may draw."""
    ways = itertools.product((60, 45, 30), CURVES, (False, True), (False, True))
    return [yaml.safe_dump(_document(*way)) for way in ways]


def _make_otherwise(document: dict[str, Any], source: Random) -> None:
    """The machine is not the gateway's model: masses and friction by up to 10 and 20 %, noisy resolvers."""
    masses, friction = source.uniform(0.9, 1.1), source.uniform(0.8, 1.2)
    for link in document["machine"]["links"].values():
        link["mass_kg"] *= masses
        link["inertia_com_kgm2"] *= masses
    for axis in document["axes"].values():
        emulation = axis["emulation"]
        emulation["coulomb_Nm"] *= friction
        emulation["viscous_Nms"] *= friction
        emulation["resolver_noise_counts"] = source.choice((0.0, 0.3, 0.6))
        emulation["resolver_eccentricity_counts"] = source.choice((0.0, 0.0, 2.0))


def _smaller_curve(share: float) -> Path:
    """The curve that the end effector traces if the servo makes the paper's motion times ``share``."""
    cam = compile_config(PAPER)
    theta2 = np.radians(np.arange(360.0))
    theta5 = share * cam.profile.at_many(theta2)[:, 0]
    points = five_bar(PAPER).end_effector(theta2, theta5, closure_at_home(PAPER)) * 1e3
    path = Path(tempfile.gettempdir()) / f"drive-gateway-soak-{share:g}.csv"
    lines = [f"{degrees},{x:.6f},{y:.6f}" for degrees, (x, y) in enumerate(points)]
    # Another process may be reading it.
    new = path.with_suffix(f".{os.getpid()}")
    new.write_text("\n".join(("theta2_deg,x_mm,y_mm", *lines)) + "\n", encoding="utf-8")
    new.replace(path)
    return path


CURVES = (Path("desired_path.csv"), Path("desired_path_36.csv"), _smaller_curve(0.8))


def draw_session(source: Random, rpm: float) -> SessionPlan:
    """One session; ``rpm``: the speed of its run."""
    cycles = source.choice((1, 1, 2, 2, 3, 5))
    happens: list[Provocation] = []
    if source.random() < 0.3:
        happens += _draw_orders(source, 60.0 / rpm)
    for _ in range(source.choices((0, 1, 2, 3), (1, 9, 8, 4))[0]):
        earlier = happens[-1] if happens else None
        moment, delay_s = _draw_instant(source, cycles * 60.0 / rpm, earlier)
        happens.append(_draw_provocation(source, moment, delay_s))
    return SessionPlan(cycles, tuple(happens))


def _draw_instant(source: Random, span_s: float, earlier: Provocation | None) -> tuple[Moment, float]:
    chance = source.random()
    if earlier is not None and chance < 0.25:
        # At the same time, or nearly.
        return earlier.moment, max(earlier.delay_s + source.uniform(-0.03, 0.03), 0.0)
    moments = IN_A_STOP if earlier is not None and chance < 0.7 else (*Moment, *IN_MOTION)
    moment = source.choice(moments)
    return moment, source.uniform(0.0, span_s if moment is Moment.CAM else DELAY_S[moment])


def _draw_orders(source: Random, cycle_s: float) -> list[Provocation]:
    """A sequence that leaves the machine as it was, if nothing comes between."""
    at_s = source.uniform(0.0, cycle_s)

    def order(after_s: float, what: Mischief, value: float) -> Provocation:
        return Provocation(Moment.CAM, at_s + after_s, what, value)

    match source.randrange(4):
        case 0:
            other = source.uniform(10.0, 125.0)
            return [order(0.0, Mischief.OVERRIDE, other), order(source.uniform(0.3, 2.0), Mischief.OVERRIDE, 100.0)]
        case 1:
            rpm = source.choice((-1.0, 1.0)) * source.uniform(1.0, 7.0)
            jog_s = 1.8 + source.uniform(0.0, 1.0)
            return [
                order(0.0, Mischief.OVERRIDE, 0.0),
                order(1.8, Mischief.JOG, rpm),
                order(jog_s, Mischief.JOG, 0.0),
                order(jog_s + 0.6, Mischief.OVERRIDE, 100.0),
            ]
        case 2:
            back_s = source.uniform(0.2, 1.0)
            return [order(0.0, Mischief.PHASE_SHIFT, source.uniform(-8.0, 8.0)), order(back_s, Mischief.PHASE_SHIFT, 0)]
        case _:
            leave, back = source.uniform(150.0, 220.0), source.uniform(150.0, 220.0)
            return [
                order(0.0, Mischief.WINDOW, source.choice((0.0, 40.0, 60.0, 90.0))),
                order(0.03, Mischief.DISENGAGE, leave),
                order(1.3 * cycle_s, Mischief.ENGAGE, back),
            ]


def _draw_provocation(source: Random, moment: Moment, delay_s: float) -> Provocation:
    if source.random() < 0.15:
        what = source.choice(
            (
                Mischief.STOP,
                Mischief.STOP,
                Mischief.SIGTERM,
                Mischief.QUICK_STOP,
                Mischief.HOST_AWAY,
                Mischief.HOST_LATE,
                Mischief.CONTROLLER_OFF,
                Mischief.CONTROLLER_OFF,
                Mischief.KILLED,
            )
        )
        return Provocation(moment, delay_s, what, source.choice((0.004, 0.015, 0.03, 0.06, 0.15, 0.5)))
    return Provocation(moment, delay_s, _draw_fault(source, moment))


def _draw_fault(source: Random, moment: Moment) -> Fault:
    node, span_s = source.choice((CV, SERVO)), source.choice((source.uniform(0.002, 0.05), source.uniform(0.05, 0.6)))
    kinds = [kind for kind in FaultKind if kind not in COMMISSIONING_ONLY or moment is Moment.COMMISSIONING]
    if moment is Moment.COMMISSIONING:
        # A reference that is taken from a resolver that shows something else is wrong, and nobody can know.
        kinds.remove(FaultKind.JUMPING_RESOLVER)
    kind = source.choice(kinds)
    if kind is FaultKind.BROKEN_BRAKE:
        # A servo axis that coasts without a brake cannot be held by anything that the other one does.
        return Fault(kind, CV, 0.0, 3.0)
    more = _parameters(source, kind, node)
    if kind is FaultKind.NODE_RESET:
        return Fault(kind, node)
    return Fault(kind, node, 0.0, span_s, **more)


COMMISSIONING_ONLY = (FaultKind.WRONG_IDENTITY, FaultKind.SDO_ABORT)


def _parameters(source: Random, kind: FaultKind, node: int) -> dict[str, Any]:
    match kind:
        case FaultKind.JUMPING_RESOLVER:
            # About where a leap begins to be told from motion, and far from there.
            counts = source.choice((15, 40, 100, 250, source.randint(20, 60), source.randint(20, 60)))
            return {"counts": source.choice((-1, 1)) * counts}
        case FaultKind.SLOW_SDO:
            return {"delay_s": source.uniform(0.001, 0.3)}
        case FaultKind.SDO_ABORT:
            index = source.choice((objects.MODES_OF_OPERATION, objects.IDENTITY, objects.PRODUCER_HEARTBEAT_TIME))
            return {"index": index}
        case FaultKind.WRONG_IDENTITY:
            return {"vendor_id": 7}
        case FaultKind.LOST_FRAMES | FaultKind.LATE_FRAMES | FaultKind.DOUBLED_FRAMES | FaultKind.REORDERED_FRAMES:
            return _frames(source, kind, node)
        case _:
            return {}


def _frames(source: Random, kind: FaultKind, node: int) -> dict[str, Any]:
    direction, cob_id = source.choice(
        (
            (Direction.SENT, 0x180 + node),
            (Direction.RECEIVED, 0x200 + node),
            (Direction.SENT, 0x580 + node),
            (Direction.RECEIVED, 0x600 + node),
            (Direction.RECEIVED, 0x080),
            (Direction.BOTH, None),
        )
    )
    more: dict[str, Any] = {"direction": direction, "probability": source.choice((0.02, 0.1, 0.3, 1.0))}
    if cob_id is not None:
        more["cob_id"] = cob_id
    if kind is FaultKind.LATE_FRAMES:
        more["delay_s"] = source.uniform(1e-4, 3e-3)
    return more
