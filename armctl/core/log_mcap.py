"""A log as an MCAP file of ROS 2 messages, for `ros2 bag`, Foxglove and PlotJuggler."""

from pathlib import Path
from typing import Any

from armctl.core.errors import import_extra
from armctl.core.validation import Array

_RULE = "=" * 80
_STAMP = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_JOINT_STATE = f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_STAMP}"""
_POSE_STAMPED = f"""std_msgs/Header header
geometry_msgs/Pose pose
{_RULE}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_RULE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_STAMP}"""


def save_mcap(path: Path, log: Any) -> None:
    """Writes /joint_states, /joint_references, /tip and /tip_reference, /tips/NAME of others; references if there are any."""
    mcap = import_extra("mcap_ros2.writer", "MCAP files need mcap-ros2-support", "ros")
    joint_topics: dict[str, tuple[Array, Array, Array | None]] = {"/joint_states": (log.q, log.v, log.tau)}
    tip_topics = {"/tip": (log.tip, log.tip_quat)}
    if not log.is_open_loop:
        joint_topics["/joint_references"] = (log.q_ref, log.v_ref, None)
        tip_topics["/tip_reference"] = (log.tip_ref, log.tip_ref_quat)
    for name in log.tip_names[1:]:
        tip = log.tips[name]
        tip_topics[f"/tips/{name}"] = (tip.position, tip.quat)
        if not log.is_open_loop:
            tip_topics[f"/tip_references/{name}"] = (tip.position_ref, tip.quat_ref)
    names = list(log.joint_names)
    with path.open("wb") as file, mcap.Writer(file) as writer:
        joint_schema = writer.register_msgdef("sensor_msgs/msg/JointState", _JOINT_STATE)
        pose_schema = writer.register_msgdef("geometry_msgs/msg/PoseStamped", _POSE_STAMPED)
        for k, time in enumerate(log.t.tolist()):
            nanoseconds = round(1e9 * time)
            header = {"stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}, "frame_id": "world"}
            for topic, (q, v, tau) in joint_topics.items():
                effort = [] if tau is None else tau[k].tolist()
                state = {
                    "header": header,
                    "name": names,
                    "position": q[k].tolist(),
                    "velocity": v[k].tolist(),
                    "effort": effort,
                }
                writer.write_message(topic, joint_schema, state, nanoseconds, nanoseconds)
            for topic, (positions, quaternions) in tip_topics.items():
                pose = {"position": _named("xyz", positions[k]), "orientation": _named("wxyz", quaternions[k])}
                writer.write_message(topic, pose_schema, {"header": header, "pose": pose}, nanoseconds, nanoseconds)


def _named(axes: str, values: Array) -> dict[str, float]:
    return dict(zip(axes, values.tolist(), strict=True))
