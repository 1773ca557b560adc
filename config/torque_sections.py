"""What a configuration says of torque offsets: the model behind the feed-forward, and learning from cycle to cycle."""

from typing import Annotated

from pydantic import Field

from config.model import AxisName, Model, NotNegative, Point, Positive


class NominalLinkSection(Model):
    """A link as the feed-forward's model has it; what is left out is the machine's."""

    mass_kg: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None
    com_m: Annotated[float, Field(ge=-10.0, le=10.0)] | None = None
    com_perp_m: Annotated[float, Field(ge=-10.0, le=10.0)] | None = None
    inertia_com_kgm2: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None


class NominalLinksSection(Model):
    """The links as the feed-forward's model has them."""

    p: NominalLinkSection = NominalLinkSection()
    q: NominalLinkSection = NominalLinkSection()
    r: NominalLinkSection = NominalLinkSection()
    s: NominalLinkSection = NominalLinkSection()


class NominalAxisSection(Model):
    """An axis as the feed-forward's model has it; what is left out is taken from its ``emulation``."""

    inertia_kgm2: Positive | None = None
    viscous_Nms: NotNegative | None = None
    coulomb_Nm: NotNegative | None = None
    drive_damping_Nms: Annotated[float, Field(ge=-1e3, le=1e3)] | None = None
    """What the drive gives by itself in proportion to the demand's velocity beyond what it takes off in proportion to
    the actual one: from K_F - K_V unless given."""
    torque_limit_Nm: Positive | None = None
    """Bound of the torque offset."""


class FeedForwardSection(Model):
    """Torque offsets from the model of the machine along the cam."""

    enabled: bool = False
    torque_delay_us: Annotated[float, Field(ge=0.0, le=100_000.0)] | None = None
    """From the SYNC that applies a torque offset to the torque on the shaft; null: that of the emulated drives, half a
    servo period, their output delay and the amplifier's time constant."""
    coulomb_velocity_rad_per_s: Positive = 0.1
    """Speed below which dry friction fades: it must not jump where an axis reverses."""
    links: NominalLinksSection = NominalLinksSection()
    end_effector_mass_kg: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None
    gravity_m_s2: Point | None = None
    axes: dict[AxisName, NominalAxisSection] = Field(default_factory=dict[AxisName, NominalAxisSection])
    load_check_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = 50.0
    """Within this after enabling an axis has to carry what the model says that it holds, or the run is refused: longer
    than a brake takes to open after its drive says that it is enabled. 0 looks at no torque."""

    @property
    def tells_loads(self) -> bool:
        """Whether the model is held to say what an axis that stands holds, and so what it would do without that."""
        return self.enabled and self.load_check_ms > 0.0


class LearnedAxisSection(Model):
    """How the error of an axis becomes torque in learning; what is left out is what its ``emulation`` gains say."""

    proportional_Nm_per_rad: NotNegative | None = None
    integrating_Nm_per_rad_s: NotNegative | None = None
    derivative_Nms_per_rad: NotNegative | None = None
    bound_Nm: Positive | None = None
    """Greatest correction; null: half of the rated torque."""


class LearningSection(Model):
    """Learning from cycle to cycle: a torque correction that repeats with the master's revolution."""

    enabled: bool = False
    memory: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """File to resume from and to write to, or a folder that has one for each profile; relative to the configuration."""
    gain: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Share of the torque still missing that is taken into the correction in each revolution."""
    window_ms: Annotated[float, Field(ge=1.0, le=1000.0)] = 6.0
    """Half width of the zero-phase low pass."""
    settle_ms: Annotated[float, Field(ge=0.0, le=60_000.0)] = 100.0
    """Constant speed before anything is learned."""
    bins: Annotated[int, Field(ge=16, le=4096)] = 256
    """Places of a revolution for which a torque is kept."""
    axes: dict[AxisName, LearnedAxisSection] = Field(default_factory=dict[AxisName, LearnedAxisSection])


class PositionLoopSection(Model):
    """The position loop of an axis that the gateway closes itself: its drive runs in cyclic synchronous torque."""

    proportional_Nm_per_rad: Positive
    integrating_Nm_per_rad_s: NotNegative = 0.0
    derivative_Nms_per_rad: NotNegative = 0.0
    torque_limit_Nm: Positive
    """Bound of the torque that is sent, feed-forward included."""
