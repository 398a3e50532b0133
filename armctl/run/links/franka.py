"""A Franka Research 3 by Franka's own client, pylibfranka: joint positions or torques at 1 kHz, and its hand."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LinkError, import_extra
from armctl.core.limits import Limits
from armctl.core.validation import Array, as_array, flag, inertia_tensor, instance, number, vector
from armctl.run.links.envelope import Envelope
from armctl.run.links.link import HandReading, Link, Reading
from armctl.run.links.torque_interface import TorqueInterface, TorqueLink

_COLLISION_TORQUE = 20.0  # N m, at which the robot stops; the value of Franka's examples
_COLLISION_FORCE = 20.0  # N
_ROWS_ON_THEIR_WAY = 5  # at most, when the robot reports what is wrong with one of them
_HAND_SPEED = 0.05  # m/s
_HAND_WIDTH_ERROR = 0.08  # m, of a grasp: any width counts

# Franka's documentation, robot specifications; libfranka, rate_limiting.h and joint_velocity_limits.h; the URDF of the robot.
FR3 = Envelope(
    source="Franka Research 3, robot specifications and libfranka's rate limiting",
    limits=Limits(
        q_min=np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196]),
        q_max=np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196]),
        v_max=np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]),
        a_max=np.full(7, 10.0),
        j_max=np.full(7, 5000.0),
        tau_max=np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]),
        deceleration_limit=np.array([6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0]),
        velocity_offset=np.array([0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35]),
    ),
)

# libfranka: `Torques` are joint torques without gravity and friction, which the robot adds; rate_limiting.h: `kMaxTorqueRate`.
# Its client filters the torques of callbacks only.
FR3_TORQUE = TorqueInterface(
    tau_max=FR3.limits.tau_max,
    rate_max=1000.0,
    adds_gravity=True,
    adds_friction=True,
    source="libfranka, class Torques and rate_limiting.h",
)


class Franka(Link, TorqueLink):
    """A Franka Research 3 with the Franka Control Interface, protocol 10 (system 5.9 and later).

    It takes joint positions, or the torques of a controller. It was tried with simulators of the controller only, never with a
    robot. Needs the extra `franka`.

    Attributes:
        host: The address of the robot.
        dt: s, the tick.
        name, address, envelope, rest_speed, settle, payload, passes_time, torque: As of every link.
    """

    dt = 1e-3
    envelope: Envelope | None = FR3
    rest_speed = 2e-2  # joint 7 of a simulated controller chatters while it stands
    settle = (5e-4, 5e-3)
    passes_time = False

    def __init__(
        self,
        host: str,
        *,
        payload: float = 0.0,
        payload_center: ArrayLike = (0.0, 0.0, 0.0),
        payload_inertia: ArrayLike = (0.0, 0.0, 0.0),
        real_time: bool = True,
        torque: TorqueInterface | None = None,
    ):
        """A robot that is not connected yet.

        Args:
            host: Its address.
            payload: kg, which the robot is set to, besides its hand.
            payload_center: (3,) m, its center of mass in the flange's frame.
            payload_inertia: kg m^2 about its center of mass, in the flange's axes: (3,) moments, a (3, 3) matrix, or the (9,)
                numbers of the matrix.
            real_time: Whether the process must get a real-time priority, as Franka demands for a robot.
            torque: What it does with torques; by default what Franka publishes: it adds gravity and friction. Another one for
                a simulator that does not add friction, or with a delay that is known.

        Raises:
            InputError: The host is no text, a number is out of its bounds, or the interface has not seven joints.
        """
        if not isinstance(host, str) or not host:
            raise InputError(f"host: expected an address such as 172.16.0.2, got {host!r:.80}")
        self.host = host
        self.name = f"Franka Research 3 at {host}"
        self.address = host
        self.payload: float | None = number("payload", payload, 0.0)
        self._center: Array = vector("payload_center", payload_center, 3)
        numbers = as_array("payload_inertia", payload_inertia)
        self._inertia = inertia_tensor("payload_inertia", numbers.reshape(3, 3) if numbers.shape == (9,) else numbers)
        self._real_time = flag("real_time", real_time)
        if torque is not None:
            instance(
                "torque", torque, TorqueInterface, "armctl.links.TorqueInterface(tau_max=[87, 87, 87, 87, 12, 12, 12]) is one"
            )
            vector("torque.tau_max", torque.tau_max, 7, finite=False)
        self.torque: TorqueInterface | None = FR3_TORQUE if torque is None else torque
        self._robot: Any = None
        self._control: Any = None
        self._hand: Any = None
        self._stands_where_it_is = False  # whether torques moved it last, so that it has no commanded position
        self._is_first = True  # whether no row of the stream was sent yet
        self._received = 0.0  # s of the clock, when the last reading came
        self._intervals = deque([0.0], maxlen=_ROWS_ON_THEIR_WAY)  # s, between the last readings

    def open(self) -> None:
        """Connects, and sets load and collision thresholds."""
        with _calling(f"{self.host}: cannot be opened: ") as client:
            kind = client.RealtimeConfig.kEnforce if self._real_time else client.RealtimeConfig.kIgnore
            self._robot = client.Robot(self.host, kind)
            torques = [_COLLISION_TORQUE] * 7
            forces = [_COLLISION_FORCE] * 6
            self._robot.set_collision_behavior(torques, torques, forces, forces)
            if self.payload:
                self._robot.set_load(self.payload, self._center.tolist(), self._inertia.ravel().tolist())

    def read(self) -> Reading:
        return self._reading(self._state())

    def tip(self) -> Array | None:
        return np.array(self._state().O_T_EE).reshape(4, 4).T

    def start(self) -> None:
        with _calling() as client:
            self._control = self._opened().start_joint_position_control(client.ControllerMode.JointImpedance)
        self._begin(takes_torques=False)

    def start_torques(self) -> None:
        with _calling():
            self._control = self._opened().start_torque_control()
        self._begin(takes_torques=True)

    def _begin(self, takes_torques: bool) -> None:
        self._stands_where_it_is = takes_torques
        self._is_first = True
        self._received = time.monotonic()
        self._intervals = deque([0.0], maxlen=_ROWS_ON_THEIR_WAY)

    def wait(self) -> tuple[int, Reading]:
        control = self._stream()
        try:
            with _calling():
                state, period = control.readOnce()
        except LinkError as error:
            self._control = None
            late = max(self._intervals) - self.dt
            raise LinkError(f"{error}; a row came {1e3 * late:.1f} ms late" if late > 0.5 * self.dt else str(error)) from None
        now = time.monotonic()
        self._intervals.append(now - self._received)
        self._received = now
        ticks = 1 if self._is_first else max(1, round(period.to_sec() / self.dt))
        self._is_first = False
        return ticks, self._reading(state)

    def send(self, q: Array, last: bool) -> None:
        self._write("JointPositions", vector("q", q, 7), flag("last", last))

    def send_torques(self, tau: Array, last: bool) -> None:
        self._write("Torques", vector("tau", tau, 7), flag("last", last))

    def _write(self, kind: str, row: Array, last: bool) -> None:
        """Sends a row of a kind, the name of its class in Franka's client."""
        control = self._stream()
        self._control = None  # where the call fails or the stream ends, the next motion must not find it
        with _calling() as client:
            command = getattr(client, kind)(row.tolist())
            command.motion_finished = last
            control.writeOnce(command)
        self._control = None if last else control

    def recover(self) -> None:
        self._control = None
        with _calling("recover: "):
            self._opened().automatic_error_recovery()

    def read_hand(self) -> HandReading:
        with self._calling_hand() as hand:
            state = hand.read_once()
        return HandReading(state.width, state.max_width, state.is_grasped)

    def move_hand(self, width: float) -> bool:
        with self._calling_hand() as hand:
            return hand.move(width, _HAND_SPEED)

    def close_hand(self, force: float) -> bool:
        with self._calling_hand() as hand:
            return hand.grasp(0.0, _HAND_SPEED, force, _HAND_WIDTH_ERROR, _HAND_WIDTH_ERROR)

    def close(self) -> None:
        self._control = None
        self._hand = None
        self._robot = None

    @contextmanager
    def _calling_hand(self) -> Iterator[Any]:
        with _calling("gripper: ") as client:
            if self._hand is None:
                self._hand = client.Gripper(self.host)
            yield self._hand

    def _opened(self) -> Any:
        if self._robot is None:
            raise LinkError(f"{self.host}: the link is not open; give it to an armctl.Robot")
        return self._robot

    def _stream(self) -> Any:
        if self._control is None:
            raise LinkError(f"{self.host}: no stream is open; call start() first")
        return self._control

    def _state(self) -> Any:
        with _calling(f"{self.host}: "):
            return self._opened().read_once()

    def _reading(self, state: Any) -> Reading:
        fault = str(state.current_errors) if state.current_errors else ""
        return Reading(
            t=state.time.to_sec(),
            q=np.array(state.q),
            v=np.array(state.dq),
            tau=np.array(state.tau_J),
            q_ref=np.array(state.q if self._stands_where_it_is else state.q_d),
            fault=fault,
            tau_ref=np.array(state.tau_J_d),
        )


@contextmanager
def _calling(words: str = "") -> Iterator[Any]:
    """Franka's client, whose exceptions become LinkErrors that begin with some words; they have no common base."""
    client = import_extra("pylibfranka", "links to a Franka need pylibfranka", "franka")
    try:
        yield client
    except (client.FrankaException, RuntimeError) as error:
        raise LinkError(f"{words}{error}") from None
