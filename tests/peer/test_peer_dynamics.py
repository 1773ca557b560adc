"""The equations of motion against Pinocchio (https://github.com/stack-of-tasks/pinocchio), an independent engine.

Pinocchio gets two open chains, p-q on the CV pivot and s-r on the servo pivot, from the configuration's own numbers,
and nothing of `mechanism`. The loop is closed here with its kinematics alone: Newton's method on the distance of both
ends, their Jacobians' null space, and their accelerations.
"""

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from config.conversion import closure_at_home, dynamics_parameters
from config.loading import load_config
from config.schema import GatewayConfig
from gateway.running.preparation import compile_config
from mechanism.dynamics import acceleration, energy, friction_torque, inverse_dynamics
from mechanism.five_bar import Closure

Float = NDArray[np.float64]

STATES_IN_CYCLE = 180


@dataclass(frozen=True)
class TwoChains:
    """p, q and s, r as Pinocchio has them; its joints are theta2, theta3 - theta2, theta5, theta4 - theta5."""

    model: pin.Model
    end_of_q: int
    end_of_r: int

    @classmethod
    def of(cls, config: GatewayConfig) -> "TwoChains":
        five_bar, links = config.machine.five_bar, config.machine.links
        master, slave = config.ordered_axes
        model = pin.Model()
        model.gravity.linear = np.array([*config.machine.gravity_m_s2, 0.0])

        def add(parent: int, at_mm: tuple[float, float], name: str, link) -> int:
            place = pin.SE3(np.eye(3), np.array([at_mm[0] * 1e-3, at_mm[1] * 1e-3, 0.0]))
            joint = model.addJoint(parent, pin.JointModelRZ(), place, name)
            body = pin.Inertia(
                link.mass_kg, np.array([link.com_m, link.com_perp_m, 0.0]), np.diag([0.0, 0.0, link.inertia_com_kgm2])
            )
            model.appendBodyToJoint(joint, body, pin.SE3.Identity())
            return joint

        p = add(0, five_bar.cv_pivot_mm, "p", links.p)
        q = add(p, (five_bar.p_mm, 0.0), "q", links.q)
        s = add(0, five_bar.servo_pivot_mm, "s", links.s)
        r = add(s, (five_bar.s_mm, 0.0), "r", links.r)
        for joint, section in ((p, master), (s, slave)):
            rotor = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, section.emulation.inertia_kgm2]))
            model.appendBodyToJoint(joint, rotor, pin.SE3.Identity())
        end_q = pin.SE3(np.eye(3), np.array([five_bar.q_mm * 1e-3, 0.0, 0.0]))
        end_r = pin.SE3(np.eye(3), np.array([five_bar.r_mm * 1e-3, 0.0, 0.0]))
        model.appendBodyToJoint(
            q, pin.Inertia(config.machine.end_effector_mass_kg, np.zeros(3), np.zeros((3, 3))), end_q
        )
        return cls(
            model,
            model.addFrame(pin.Frame("end of q", q, 0, end_q, pin.FrameType.OP_FRAME)),
            model.addFrame(pin.Frame("end of r", r, 0, end_r, pin.FrameType.OP_FRAME)),
        )

    def _ends(self, data: pin.Data, q: Float) -> tuple[Float, Float]:
        """Distance of the two ends and its Jacobian over the four joints."""
        pin.computeJointJacobians(self.model, data, q)
        pin.updateFramePlacements(self.model, data)
        gap = data.oMf[self.end_of_q].translation - data.oMf[self.end_of_r].translation
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.getFrameJacobian(self.model, data, self.end_of_q, world) - pin.getFrameJacobian(
            self.model, data, self.end_of_r, world
        )
        return gap[:2], jacobian[:2]

    def closed(self, theta: Float, guess: Float) -> Float:
        """The joints at which the ends meet, theta2 and theta5 given."""
        data = self.model.createData()
        q = np.array([theta[0], guess[1], theta[1], guess[3]])
        for _ in range(50):
            gap, jacobian = self._ends(data, q)
            q[[1, 3]] -= np.linalg.solve(jacobian[:, [1, 3]], gap)
            if np.max(np.abs(gap)) < 1e-15:
                break
        return q

    def motion(self, q: Float, omega: Float, alpha: Float) -> tuple[Float, Float, Float]:
        """Velocities and accelerations of all joints in a closed loop, and d(joints)/d(theta2, theta5)."""
        data = self.model.createData()
        _, jacobian = self._ends(data, q)
        span = np.zeros((4, 2))
        span[0, 0] = span[2, 1] = 1.0
        span[[1, 3]] = -np.linalg.solve(jacobian[:, [1, 3]], jacobian[:, [0, 2]])
        v = span @ omega
        # What is left of the ends' accelerations without joint accelerations, by Pinocchio's own forward kinematics.
        pin.forwardKinematics(self.model, data, q, v, np.zeros(4))
        pin.updateFramePlacements(self.model, data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        drift = (
            pin.getFrameClassicalAcceleration(self.model, data, self.end_of_q, world).linear
            - pin.getFrameClassicalAcceleration(self.model, data, self.end_of_r, world).linear
        )[:2]
        a = span @ alpha
        a[[1, 3]] -= np.linalg.solve(jacobian[:, [1, 3]], drift)
        return v, a, span

    def torque(self, q: Float, omega: Float, alpha: Float) -> Float:
        """Motor torques for a motion: the recursive Newton-Euler algorithm's joint torques, by virtual work."""
        v, a, span = self.motion(q, omega, alpha)
        return span.T @ pin.rnea(self.model, self.model.createData(), q, v, a)

    def acceleration(self, q: Float, omega: Float, torque: Float) -> Float:
        """theta2'', theta5'': Pinocchio's mass matrix and bias of four joints with the loop's forces as multipliers."""
        data = self.model.createData()
        v, a0, _ = self.motion(q, omega, np.zeros(2))
        _, jacobian = self._ends(self.model.createData(), q)
        mass = pin.crba(self.model, data, q)
        mass = np.triu(mass) + np.triu(mass, 1).T
        bias = pin.nonLinearEffects(self.model, self.model.createData(), q, v)
        equations = np.block([[mass, jacobian.T], [jacobian, np.zeros((2, 2))]])
        right = np.concatenate([np.array([torque[0], 0.0, torque[1], 0.0]) - bias, jacobian @ a0])
        return np.linalg.solve(equations, right)[[0, 2]]

    def energies(self, q: Float, omega: Float) -> tuple[float, float]:
        v, _, _ = self.motion(q, omega, np.zeros(2))
        data = self.model.createData()
        return pin.computeKineticEnergy(self.model, data, q, v), pin.computePotentialEnergy(self.model, data, q)


@pytest.fixture(scope="module")
def paper() -> GatewayConfig:
    return load_config("paper")


def lopsided(config: GatewayConfig) -> GatewayConfig:
    """The machine with every centre of mass off its link, other pivots and a slanting gravity."""
    links = config.machine.links
    moved = {
        name: getattr(links, name).model_copy(update={"com_perp_m": across, "mass_kg": mass})
        for name, across, mass in (("p", 0.02, 0.7), ("q", -0.013, 0.11), ("r", 0.017, 0.16), ("s", -0.024, 0.2))
    }
    five_bar = config.machine.five_bar.model_copy(
        update={"cv_pivot_mm": (13.0, -21.0), "servo_pivot_mm": (262.0, -17.0), "p_mm": 141.0, "s_mm": 158.0}
    )
    machine = config.machine.model_copy(
        update={
            "links": links.model_copy(update=moved),
            "gravity_m_s2": (2.5, -9.1),
            "five_bar": five_bar,
            "end_effector_mass_kg": 0.23,
        }
    )
    return config.model_copy(update={"machine": machine})


def first_guess(config: GatewayConfig, closure: Closure, theta2: float, theta5: float) -> Float:
    """Angles of q and r (relative) from the law of cosines, on the side that ``closure`` says."""
    five_bar = config.machine.five_bar
    a = np.array(five_bar.cv_pivot_mm) + five_bar.p_mm * np.array([math.cos(theta2), math.sin(theta2)])
    d = np.array(five_bar.servo_pivot_mm) + five_bar.s_mm * np.array([math.cos(theta5), math.sin(theta5)])
    between = d - a
    distance = float(np.hypot(*between))
    at_a = math.acos((five_bar.q_mm**2 + distance**2 - five_bar.r_mm**2) / (2.0 * five_bar.q_mm * distance))
    theta3 = math.atan2(between[1], between[0]) + int(closure) * at_a
    c = a + five_bar.q_mm * np.array([math.cos(theta3), math.sin(theta3)])
    theta4 = math.atan2(c[1] - d[1], c[0] - d[0])
    return np.array([theta2, theta3 - theta2, theta5, theta4 - theta5])


def test_inverse_dynamics_over_the_cycle_agree_with_pinocchio(paper: GatewayConfig) -> None:
    cam = compile_config(paper)
    chains = TwoChains.of(paper)
    params = dynamics_parameters(paper).to_array()
    speed = paper.speed_rad_per_s
    theirs, ours = np.empty((STATES_IN_CYCLE, 2)), np.empty((STATES_IN_CYCLE, 2))
    q: Float | None = None
    for n in range(STATES_IN_CYCLE):
        theta2 = math.tau * n / STATES_IN_CYCLE
        position, slope, curvature = cam.profile.at_many(np.array([theta2]))[0][:3]
        theta = np.array([theta2, position])
        omega = np.array([speed, slope * speed])
        alpha = np.array([0.0, curvature * speed * speed])
        q = chains.closed(theta, first_guess(paper, cam.closure, *theta) if q is None else q)
        theirs[n] = chains.torque(q, omega, alpha)
        with_friction = inverse_dynamics(params, *theta, *omega, *alpha, int(cam.closure), 0.0)
        ours[n] = np.array(with_friction) - friction_torque(params, *omega, 0.0)
    greatest = np.max(np.abs(theirs), axis=0)
    assert np.max(np.abs(ours - theirs) / greatest) < 1e-9
    # What bars and rotors of that size ask for by the independent study of this machine: about -0.79 N m on the servo.
    assert float(np.min(theirs[:, 1])) == pytest.approx(-0.79, abs=0.01)


@pytest.mark.parametrize("is_lopsided", [False, True])
@pytest.mark.parametrize("closure", list(Closure))
def test_forward_and_inverse_dynamics_and_energy_in_random_states(
    paper: GatewayConfig, closure: Closure, is_lopsided: bool
) -> None:
    config = lopsided(paper) if is_lopsided else paper
    chains = TwoChains.of(config)
    params = dynamics_parameters(config).to_array()
    random = np.random.default_rng(5)
    states = 0
    while states < 60:
        theta = random.uniform(-math.pi, math.pi, 2)
        try:
            q = chains.closed(theta, first_guess(config, closure, *theta))
        except ValueError:
            continue  # the linkage does not reach
        if abs(math.sin(q[0] + q[1] - q[2] - q[3])) < 0.1:
            continue  # near a singular position
        states += 1
        omega, alpha, torque = random.uniform(-20, 20, 2), random.uniform(-300, 300, 2), random.uniform(-4, 4, 2)
        theirs = chains.torque(q, omega, alpha)
        ours = np.array(inverse_dynamics(params, *theta, *omega, *alpha, int(closure), 0.0))
        ours -= friction_torque(params, *omega, 0.0)
        assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-9 * np.max(np.abs(theirs)))
        forward = acceleration(params, *theta, *omega, *torque, int(closure))
        expected = chains.acceleration(q, omega, torque)
        assert forward == pytest.approx(expected, rel=1e-8, abs=1e-8 * np.max(np.abs(expected)))
        kinetic, potential = energy(params, *theta, *omega, int(closure))
        assert (kinetic, potential) == pytest.approx(chains.energies(q, omega), rel=1e-9, abs=1e-12)


def test_home_of_the_paper_is_the_same_closure(paper: GatewayConfig) -> None:
    assert closure_at_home(paper) is compile_config(paper).closure
