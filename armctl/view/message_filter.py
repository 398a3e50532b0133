"""MessageFilter: which messages of a client reach viser, and with which values.

viser trusts its clients: one message may set any attribute of a control, open a public tunnel or upload files. The filter
decodes every message into one of the types below, checks types, lengths, finiteness and ranges, and encodes the result.
Everything else is dropped. msgspec decodes and encodes; viser uses it too.
"""

import math
from collections.abc import Mapping
from typing import Annotated, TypeGuard

import msgspec
import viser

MAX_COORDINATE_M = 1e3
MAX_MESSAGE_BYTES = 65536  # a client's largest message, a camera, has less than 1 kB
_MAX_CAMERA_NUMBER = 1e6  # the page's own cameras stay below a thousand; squares of a number far above would overflow
_MIN_QUATERNION_NORM = 1e-3

_Name = Annotated[str, msgspec.Meta(max_length=64)]
_Pixels = Annotated[int, msgspec.Meta(ge=1, le=65536)]
_Vector3 = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]


class _Message(msgspec.Struct, tag_field="type"):
    """A message whose tag is the name of viser's class."""


class _GizmoMessage(_Message):
    name: _Name
    owner: Annotated[str, msgspec.Meta(max_length=0)] = ""  # the page has no controls of single clients


class _GizmoMoved(_GizmoMessage, tag="TransformControlsUpdateMessage", kw_only=True):
    wxyz: _Quaternion
    position: _Vector3


class _GizmoTaken(_GizmoMessage, tag="TransformControlsDragStartMessage"):
    pass


class _GizmoReleased(_GizmoMessage, tag="TransformControlsDragEndMessage"):
    pass


class _CameraMoved(_Message, tag="ViewerCameraMessage"):
    wxyz: _Quaternion
    position: _Vector3
    fov: float
    near: float
    far: float
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector3
    up_direction: _Vector3


class _Updates(msgspec.Struct):
    """Only `value` is decoded: a client may not change other properties of a control."""

    value: bool | int | float | str | list[float]


class _InputChanged(_Message, tag="GuiUpdateMessage"):
    uuid: _Name
    updates: _Updates


class MessageFilter:
    """Checks the messages of all clients of one page."""

    def __init__(self) -> None:
        self.inputs: Mapping[str, object] = {}  # viser's controls by their id. Updates of other controls are dropped
        self._decoder = msgspec.msgpack.Decoder(_GizmoMoved | _GizmoTaken | _GizmoReleased | _CameraMoved | _InputChanged)
        self._encoder = msgspec.msgpack.Encoder()

    def checked(self, raw: str | bytes) -> bytes | None:
        """The message as far as it was checked, encoded again; None if it is dropped."""
        if isinstance(raw, str) or len(raw) > MAX_MESSAGE_BYTES:
            return None
        try:
            message = self._decoder.decode(raw)
        except (msgspec.MsgspecError, ValueError, RecursionError):  # ValueError: text that is not UTF-8
            return None
        if isinstance(message, _GizmoMoved):
            accepted = _limit_pose(message)
        elif isinstance(message, _CameraMoved):
            accepted = _is_camera(message)
        elif isinstance(message, _InputChanged):
            accepted = self._limit_value(message)
        else:
            accepted = True
        return self._encoder.encode(message) if accepted else None

    def _limit_value(self, message: _InputChanged) -> bool:
        value = limited_value(self.inputs.get(message.uuid), message.updates.value)
        if value is None:
            return False
        message.updates.value = value
        return True


def limited_value(control: object, value: object) -> bool | float | str | list[float] | None:
    """The value for a control: the nearest bound for a finite number out of its range; None for other wrong values."""
    if getattr(control, "disabled", False):
        return None
    if isinstance(control, viser.GuiButtonHandle):
        return True
    if isinstance(control, viser.GuiCheckboxHandle):
        return value if isinstance(value, bool) else None
    if isinstance(control, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
        return value if isinstance(value, str) and value in control.options else None
    if isinstance(control, viser.GuiSliderHandle):
        return min(max(float(value), control.min), control.max) if _is_finite(value) else None
    if isinstance(control, viser.GuiVector3Handle) and isinstance(value, list) and len(value) == 3:
        return [_limited_coordinate(number) for number in value] if all(map(_is_finite, value)) else None
    return None


def _limit_pose(message: _GizmoMoved) -> bool:
    if not (all(map(math.isfinite, message.position)) and _is_orientation(message.wxyz)):
        return False
    x, y, z = message.position
    message.position = (_limited_coordinate(x), _limited_coordinate(y), _limited_coordinate(z))
    return True


def _is_camera(message: _CameraMoved) -> bool:
    numbers = (*message.position, *message.look_at, *message.up_direction, message.near, message.far)
    in_range = all(abs(number) <= _MAX_CAMERA_NUMBER for number in numbers)
    return in_range and 0.0 < message.fov < math.pi and _is_orientation(message.wxyz)


def _is_orientation(wxyz: _Quaternion) -> bool:
    return _MIN_QUATERNION_NORM < math.hypot(*wxyz) < 1 / _MIN_QUATERNION_NORM


def _limited_coordinate(number: float) -> float:
    return min(max(float(number), -MAX_COORDINATE_M), MAX_COORDINATE_M)


def _is_finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
