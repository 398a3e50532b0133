"""RosNode: a node of ROS 2 whose callbacks run only while it is asked to; rclpy is imported here and nowhere else."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armctl.core.errors import InputError, NotInstalledError, shown

_WHEEL = "ros-rclpy"
_NANO = 1e-9
QUEUE = 10  # messages
_ANSWER_S = 2.0  # of a service on a busy computer


def import_ros(module: str) -> Any:
    """A module of ROS 2: of an installation where one is sourced, otherwise of the wheels.

    Raises NotInstalledError where there is none, where it is for another Python, or where an installation and the wheels are
    mixed: the wheels put their libraries before all others when Python starts.
    """
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        if os.environ.get("AMENT_PREFIX_PATH"):
            version = f"{sys.version_info.major}.{sys.version_info.minor}"
            raise NotInstalledError(
                f"{module} of the installation of ROS cannot be imported by Python {version}: {error}; use the Python of the "
                "installation, or a shell without its setup"
            ) from None
        raise NotInstalledError.from_extra(
            f"ROS 2 needs {module}: source the setup of an installation of ROS, or, on Linux, install its wheels", "ros2"
        ) from None
    _refuse_mixture(found)
    return found


def _refuse_mixture(module: Any) -> None:
    try:
        importlib.metadata.distribution(_WHEEL)
    except importlib.metadata.PackageNotFoundError:
        return
    folder = Path(module.__file__ or sys.prefix).resolve()
    if not folder.is_relative_to(Path(sys.prefix).resolve()):
        raise NotInstalledError(
            f"{module.__name__} comes from {folder.parent}, but the wheels of the extra [ros2] are installed, too, and their "
            "libraries would be mixed; use an environment without them: pip uninstall ros-rclpy ros-wheels-bootstrapper"
        )


class RosNode:
    """A node in a context of its own, on the network that ROS_DOMAIN_ID and the other variables of ROS choose."""

    def __init__(self, name: str, namespace: str = "", use_sim_time: bool = False):
        """A node, which nobody has discovered yet; with `use_sim_time` its clock is that of the topic /clock."""
        rclpy = import_ros("rclpy")
        self._context = import_ros("rclpy.context").Context()
        signals = import_ros("rclpy.signals").SignalHandlerOptions.NO  # Ctrl-C is for the program
        rclpy.init(context=self._context, args=[], signal_handler_options=signals)
        parameter = import_ros("rclpy.parameter").Parameter
        self.node = rclpy.create_node(
            name,
            namespace=namespace,
            context=self._context,
            parameter_overrides=[parameter("use_sim_time", value=use_sim_time)],
        )
        self._executor = import_ros("rclpy.executors").SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    @property
    def domain(self) -> int:
        """The number of the node's domain."""
        return self._context.get_domain_id()

    @property
    def now(self) -> float:
        """s, the time of the node's clock; 0 while a clock of a simulation has not come."""
        return _NANO * self.node.get_clock().now().nanoseconds

    def spin(self, seconds: float) -> None:
        """Runs what has come, or what comes within some seconds first."""
        self._executor.spin_once(timeout_sec=max(seconds, 0.0))

    def wait_for(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Runs what comes until a condition holds; whether it did in time."""
        deadline = time.monotonic() + seconds
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self.spin(min(left, 0.05))
        return True

    def resolved(self, topic: str) -> str:
        """The full name of a topic."""
        return self.node.resolve_topic_name(topic)

    def others(self, topic: str) -> list[str]:
        """The other nodes that publish a topic."""
        infos = self.node.get_publishers_info_by_topic(self.resolved(topic))
        names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
        return sorted(names - {self.node.get_fully_qualified_name()})

    def count_named(self, name: str) -> int:
        """How many nodes have a full name."""
        return sum(f"{space.rstrip('/')}/{each}" == name for each, space in self.node.get_node_names_and_namespaces())

    def topics_of(self, kind: str) -> list[str]:
        """The topics of a type that the node knows."""
        return sorted(name for name, kinds in self.node.get_topic_names_and_types() if kind in kinds)

    def parameter(self, node: str, name: str) -> Any:
        """A parameter of another node; None if the node does not tell within two seconds."""
        services = import_ros("rcl_interfaces.srv")
        client = self.node.create_client(services.GetParameters, f"{node}/get_parameters")
        try:
            if not self.wait_for(client.service_is_ready, _ANSWER_S):
                return None
            future = client.call_async(services.GetParameters.Request(names=[name]))
            if not self.wait_for(future.done, _ANSWER_S):
                return None
            result = future.result()
        finally:
            self.node.destroy_client(client)
        values = [] if result is None else result.values
        return import_ros("rclpy.parameter").parameter_value_to_python(values[0]) if values else None

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        import_ros("rclpy").shutdown(context=self._context)


def stamp(seconds: float) -> tuple[int, int]:
    """A time as seconds and nanoseconds of ROS."""
    nanoseconds = round(seconds / _NANO)
    return nanoseconds // 10**9, nanoseconds % 10**9


def seconds_of(message: Any) -> float:
    """s, a time or a duration of ROS."""
    return message.sec + _NANO * message.nanosec


def check_name(what: str, name: object, *, empty: bool = False) -> str:
    """A name of ROS without slashes at its ends, which may be empty. Raises InputError where it cannot be one."""
    if not isinstance(name, str):
        raise InputError(f"{what}: expected a name of ROS, got {shown(name)}")
    stripped = name.strip("/")
    parts = stripped.split("/") if stripped else []
    if not (parts or empty) or not all(part.isidentifier() and part.isascii() for part in parts):
        raise InputError(f"{what}: {name!r:.80} is no name of ROS: letters, digits and underscores, with / between parts")
    return stripped
