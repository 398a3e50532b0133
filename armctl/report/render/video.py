"""Films and still pictures of logs."""

from __future__ import annotations

import base64
import copy
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import repeat
from pathlib import Path
from typing import IO, Self

import mujoco
import numpy as np

from armctl.core.atomic import atomic_path, file_path
from armctl.core.defaults import FILM_ENDINGS
from armctl.core.errors import ArmctlWarning, InputError, import_extra
from armctl.core.log import Log
from armctl.core.progress import progress_bar
from armctl.core.validation import Array, choice, instance, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.mjmodel.target_marker import find_target, set_target
from armctl.report.render.camera import fitted_camera
from armctl.report.render.renderer import QUALITIES, Image, Renderer, check_size
from armctl.report.render.stick_figure import NO_SHAPES, has_shapes, needed_stick_figure

_FRAMES_PER_SECOND = {".mp4": 30, ".gif": 25}  # a GIF counts hundredths of a second
_LAST_FRAME_S = 1.0
_SHORTEST_FILM_S = 3.0
_STATES_IN_VIEW = 12  # of a run, for which the camera is placed
_TARGET_SCALE = 1.15  # the target stays visible around a tip of the same size


class Film(type(Path())):  # type: ignore[misc]  # before Python 3.12 only the class of the system's paths can be derived from
    """The path of a film; a notebook shows the film itself."""

    def __new__(cls, *parts: str | os.PathLike[str]) -> Self:
        """The path of a film from its parts, as `pathlib.Path` takes them."""
        for part in parts:
            instance("parts", part, (str, os.PathLike), "'film.mp4' is one")
        return super().__new__(cls, *parts)

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.read_bytes()).decode("ascii")
        if self.suffix == ".gif":
            return f'<img src="data:image/gif;base64,{data}" alt="film">'
        return f'<video controls loop src="data:video/mp4;base64,{data}"></video>'


def record(
    log: Log | Sequence[Log],
    arm: Arm,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] = (640, 480),
    quality: str = "fast",
    speed: float = 1.0,
) -> Film:
    """Films one run, or several runs one after the other: the arm, loose objects, the target, and the path of the tip.

    The camera is placed so that the whole run is visible. Frames are 1/30 s apart in an .mp4, 1/25 s in a .gif. The last frame
    stays for one second, and longer in a film that would last less than three. The file is written atomically; a progress bar
    appears on a terminal after two seconds. An arm without visible shapes is drawn as a stick figure, and an ArmctlWarning
    says so.

    Args:
        log: The run, or the runs; all with the same tick.
        arm: The arm of these runs.
        path: The film, .mp4 or .gif; its folder is made.
        size: Width and height in pixels, even, in [16, 8192].
        quality: "fast", for software rendering, or "full", with shadows and smooth edges.
        speed: Simulated time per film time, in [0.01, 100]: 1 is real time, 0.5 is slow motion.

    Returns:
        The path, as a `Film` that a notebook shows.

    Raises:
        InputError: Another file extension, an empty log or one of another arm, a size that is odd or out of bounds, an unknown
            quality.
        ArmctlError: The file cannot be written.
        NotInstalledError: No OpenGL works here without a screen, or there is no encoder for .mp4.
    """
    path = film_path(path)
    width, height = check_size(size)
    if width % 2 or height % 2:
        raise InputError(f"size: expected even numbers, got {width} x {height} pixels")
    choice("quality", quality, QUALITIES)
    speed = number("speed", speed, 0.01, 100.0)
    frames_per_second = _FRAMES_PER_SECOND[path.suffix]
    logs = [log] if isinstance(log, Log) else log
    _check(logs, arm)
    end = (sum(map(len, logs)) - 1) * logs[0].dt
    times = np.arange(0.0, end + 1e-9, speed / frames_per_second)
    held = round(frames_per_second * max(_LAST_FRAME_S, _SHORTEST_FILM_S - times[-1] / speed))
    film = _with_last_held(images(logs, arm, times, (width, height), quality), held)
    frames = _with_progress(path, film, len(times) + held)
    with atomic_path(path) as temporary:
        if path.suffix == ".gif":
            _write_gif(temporary, frames, frames_per_second)
        else:
            write_mp4(temporary, frames, frames_per_second, (width, height))
    return Film(path)


def still(
    log: Log,
    arm: Arm,
    path: str | os.PathLike[str],
    *,
    at: float | None = None,
    size: tuple[int, int] = (1280, 720),
    quality: str = "full",
) -> Path:
    """Draws one instant of a run, with the path of the tip until then. The file is written atomically.

    An arm without visible shapes is drawn as a stick figure, and an ArmctlWarning says so.

    Args:
        arm: The arm of this run.
        path: The picture, .png; its folder is made.
        at: s, the instant; the end of the run if left out.
        size: Width and height in pixels, in [16, 8192].
        quality: "fast" or "full".

    Raises:
        InputError: Another file extension, an empty log or one of another arm, a size out of bounds, or an unknown quality.
        ArmctlError: The file cannot be written.
        NotInstalledError: No OpenGL works here without a screen.
    """
    path = file_path("path", path, (".png",))
    size = check_size(size)
    choice("quality", quality, QUALITIES)
    instance("log", log, Log, "armctl.simulate and every move of a Simulation that is not refused give one")
    _check([log], arm)
    from PIL import Image as Picture

    instant = log.t[-1] if at is None else number("at", at)
    (image,) = images([log], arm, np.array([instant]), size, quality)
    with atomic_path(path) as temporary:
        Picture.fromarray(image).save(temporary, optimize=True)
    return path


def film_path(path: str | os.PathLike[str], what: str = "path") -> Path:
    """The path of a film, checked before anything runs. Raises NotInstalledError if there is no encoder for it."""
    path = file_path(what, path, FILM_ENDINGS)
    if path.suffix == ".mp4":
        import_extra("av", "an .mp4 needs an encoder (a .gif does not)", "view")
    return path


def images(logs: Sequence[Log], arm: Arm, times: Array, size: tuple[int, int], quality: str) -> Iterator[Image]:
    """Images of runs, each (height, width, 3), at times (k,) in s since the start of the first run."""
    model = copy.copy(arm.model)
    model.geom_size[model.geom_bodyid == find_target(model)] *= _TARGET_SCALE
    qpos = np.concatenate([log.qpos for log in logs])
    tip = np.concatenate([log.tip for log in logs])
    targets = np.repeat([_target(log) for log in logs], [len(log) for log in logs], axis=0)
    states = [_state(arm, qpos[k], targets[k]) for k in np.linspace(0, len(qpos) - 1, _STATES_IN_VIEW).astype(int)]
    camera = fitted_camera(arm, states, np.concatenate([tip, targets[-1:, :3]]), size[0] / size[1])
    data = states[-1]
    figure = needed_stick_figure(arm)
    with Renderer(model, size, quality) as renderer:
        for k in np.rint(np.clip(times / logs[0].dt, 0, len(qpos) - 1)).astype(int):
            pose(arm, data, qpos[k], targets[k])
            yield renderer.image(data, camera, tip[: k + 1], None if figure is None else figure.segments(data))


def _check(logs: Sequence[Log], arm: Arm) -> None:
    check_arm(arm)
    if not isinstance(logs, Sequence) or not logs:
        raise InputError("log: expected a Log or a list of at least one Log")
    for log in logs:
        instance("log", log, Log, "armctl.simulate and every move of a Simulation that is not refused give one")
        if len(log) == 0:
            raise InputError("log: it is empty, so there is nothing to film")
        if log.joint_names != arm.joint_names:
            raise InputError(f"log: it is of {log.robot} with {len(log.joint_names)} joints, not of {arm!r:.80}")
        if log.qpos.shape[1] != arm.model.nq:
            raise InputError(f"log: it is of a model with {log.qpos.shape[1]} positions, {arm!r:.80} has {arm.model.nq}")
    if len({log.dt for log in logs}) > 1:
        raise InputError("log: the runs have different ticks, so they cannot be one film")
    if not has_shapes(arm):
        warnings.warn(ArmctlWarning(f"{arm.name}: {NO_SHAPES}"), stacklevel=3)


def _target(log: Log) -> Array:
    """(7,) the pose of the green target: the target of the run, or else the end of its reference."""
    has_target = not np.isnan(log.target[:3]).any()
    end = log.tip[-1] if log.is_open_loop else log.tip_ref[-1]
    quat = log.target[3:] if not np.isnan(log.target[3:]).any() else np.array([1.0, 0.0, 0.0, 0.0])
    return np.concatenate([log.target[:3] if has_target else end, quat])


def _state(arm: Arm, qpos: Array, target: Array) -> mujoco.MjData:
    """A state of the model, after forward kinematics, with the green target in its place."""
    data = mujoco.MjData(arm.model)
    pose(arm, data, qpos, target)
    return data


def pose(arm: Arm, data: mujoco.MjData, qpos: Array, target: Array) -> None:
    """Puts a model at positions (nq,), with the green target at (7,) position and quaternion, ready for drawing."""
    set_target(arm.model, data, target[:3], target[3:])
    data.qpos[:] = qpos
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_comPos(arm.model, data)
    mujoco.mj_camlight(arm.model, data)
    if arm.model.ntendon:
        mujoco.mj_tendon(arm.model, data)


class Mp4Writer:
    """Writes images into an .mp4, one after the other. Close it, or use it in a `with`."""

    def __init__(
        self, file: Path | IO[bytes], frames_per_second: int, size: tuple[int, int], keyframe_interval: int | None = None
    ):
        """A film without images; a player can start at every `keyframe_interval`-th one."""
        import av

        with _as_os_error():
            self._container = av.open(file, "w", format="mp4")
        self._stream = self._container.add_stream("h264", rate=frames_per_second)
        self._stream.width = size[0]
        self._stream.height = size[1]
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "20", "preset": "veryfast"}
        if keyframe_interval is not None:
            self._stream.gop_size = keyframe_interval

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:  # an encoder that failed is not asked again
            with suppress(OSError), _as_os_error():
                self._container.close()

    def add(self, image: Image) -> None:
        """Adds an image (height, width, 3). Raises OSError if the file cannot be written."""
        import av

        with _as_os_error():
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        with _as_os_error():
            try:
                self._container.mux(self._stream.encode())
            finally:
                self._container.close()


@contextmanager
def _as_os_error() -> Iterator[None]:
    """Turns errors of the encoder, such as a full disk, into OSError."""
    from av.error import FFmpegError

    try:
        yield
    except FFmpegError as error:
        raise OSError(error.errno, error.strerror) from None


def write_mp4(file: Path | IO[bytes], frames: Iterable[Image], frames_per_second: int, size: tuple[int, int]) -> None:
    """Writes frames, each (height, width, 3), into an .mp4."""
    with Mp4Writer(file, frames_per_second, size) as film:
        for image in frames:
            film.add(image)


def _write_gif(path: Path, frames: Iterable[Image], frames_per_second: int) -> None:
    """One palette for all frames, made from the first, middle and last, prevents flicker."""
    from PIL import Image as Picture

    images = list(frames)
    sample = np.concatenate([images[0], images[len(images) // 2], images[-1]])
    palette = Picture.fromarray(sample).quantize(256, Picture.Quantize.MAXCOVERAGE)
    pictures = [Picture.fromarray(image).quantize(palette=palette, dither=Picture.Dither.NONE) for image in images]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=1000 // frames_per_second, loop=0, optimize=True)


def _with_last_held(frames: Iterable[Image], count: int) -> Iterator[Image]:
    """The frames, of which there is at least one, and the last one again as often as given."""
    last = None
    for last in frames:
        yield last
    assert last is not None
    yield from repeat(last, count)


def _with_progress(path: Path, frames: Iterable[Image], count: int) -> Iterator[Image]:
    with progress_bar(path.name, count, "frames") as progress:
        for image in frames:
            yield image
            progress.update()
