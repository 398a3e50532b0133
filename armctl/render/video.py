"""Film: a log played back into images, and images into a video or a picture."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from armctl.core.errors import InputError, NotInstalledError
from armctl.core.log import Log
from armctl.core.progress import progress_bar
from armctl.core.validation import Array, number
from armctl.loading.prepare import TARGET
from armctl.render.camera import frame
from armctl.render.renderer import Image, Renderer
from armctl.robot.arm import Arm

ENDINGS = (".mp4", ".gif")
_FRAMES_PER_SECOND = {".mp4": 30, ".gif": 25}  # a GIF counts hundredths of a second
_FRAMED = 12  # how many states of a run the camera must show


def record(
    log: Log | Sequence[Log],
    arm: Arm,
    path: str | os.PathLike[str],
    *,
    width: int = 640,
    height: int = 480,
    quality: str = "fast",
    speed: float = 1.0,
) -> Path:
    """Films a run, or several one after the other: the arm and all that moves, the target, and the way of the tip.

    Args:
        log: The run, or the runs.
        arm: The arm that ran.
        path: The film, .mp4 or .gif; its folder is made.
        width: Pixels, even.
        height: Pixels, even.
        quality: "fast", for software that draws, or "full", with shadows and smooth edges.
        speed: 1 is real time, 0.5 is slow motion.

    Returns:
        The path.

    Raises:
        InputError: Another ending, an empty log or one of another arm, an odd size, or there is no such quality.
        NotInstalledError: There is no OpenGL here that works without a screen, or no encoder for .mp4.
    """
    path = film_path(path)
    if width % 2 or height % 2:
        raise InputError(f"size: {width} x {height} pixels given, even numbers wanted")
    per_second = _FRAMES_PER_SECOND[path.suffix]
    logs = [log] if isinstance(log, Log) else list(log)
    _check(logs, arm)
    end = (sum(map(len, logs)) - 1) * logs[0].dt
    times = np.arange(0.0, end + 1e-9, number("speed", speed, 0.01, 100.0) / per_second)
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = _with_progress(path, images(logs, arm, times, width=width, height=height, quality=quality), len(times))
    if path.suffix == ".gif":
        _write_gif(path, frames, per_second)
    else:
        _write_mp4(path, frames, per_second, (width, height))
    return path


def still(
    log: Log,
    arm: Arm,
    path: str | os.PathLike[str],
    *,
    at: float | None = None,
    width: int = 1280,
    height: int = 720,
    quality: str = "full",
) -> Path:
    """Draws one instant of a run, with the way of the tip until then.

    Args:
        log: The run.
        arm: The arm that ran.
        path: The picture, .png; its folder is made.
        at: s, when; the end of the run if left out.
        width: Pixels.
        height: Pixels.
        quality: "fast" or "full".

    Returns:
        The path.

    Raises:
        InputError: Another ending, an empty log or one of another arm, or there is no such quality.
        NotInstalledError: There is no OpenGL here that works without a screen.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise InputError(f"path: {path.name!r} ends in {path.suffix!r}, .png wanted")
    from PIL import Image as Picture

    when = log.t[-1] if at is None and len(log) else number("at", 0.0 if at is None else at)
    (image,) = images([log], arm, np.array([when]), width=width, height=height, quality=quality)
    path.parent.mkdir(parents=True, exist_ok=True)
    Picture.fromarray(image).save(path, optimize=True)
    return path


def film_path(path: str | os.PathLike[str]) -> Path:
    """The path of a film, checked before anything runs.

    Args:
        path: The path.

    Returns:
        It.

    Raises:
        InputError: It ends in neither .mp4 nor .gif.
        NotInstalledError: It ends in .mp4 and there is no encoder.
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise InputError(f"path: {path.name!r} ends in {path.suffix!r}, {' or '.join(ENDINGS)} wanted")
    if path.suffix == ".mp4":
        try:
            import av  # noqa: F401
        except ImportError:
            raise NotInstalledError.of_extra("an .mp4 needs an encoder (a .gif does not)", "view") from None
    return path


def images(logs: Sequence[Log], arm: Arm, times: Array, *, width: int, height: int, quality: str) -> Iterator[Image]:
    """Runs as images, one after the other.

    Args:
        logs: The runs, of one tick.
        arm: The arm that ran.
        times: (k,) s since the first began, clamped to theirs.
        width: Pixels.
        height: Pixels.
        quality: "fast" or "full".

    Yields:
        (height, width, 3), red, green and blue.

    Raises:
        InputError: A log is empty or of another arm or model, or there is none.
    """
    _check(logs, arm)
    model, qpos, tip = copy.copy(arm.model), np.concatenate([x.qpos for x in logs]), np.concatenate([x.tip for x in logs])
    model.geom_size[model.geom_bodyid == model.body(TARGET).id] *= 1.15  # to be seen around a tip as thick as itself
    targets = np.repeat([_target(log) for log in logs], [len(log) for log in logs], axis=0)
    shown = [_state(arm, qpos[k], targets[k]) for k in np.linspace(0, len(qpos) - 1, _FRAMED).astype(int)]
    camera, data = frame(arm, shown, np.concatenate([tip, targets[-1:, :3]]), width / height), shown[-1]
    with Renderer(model, width, height, quality) as renderer:
        for k in np.clip(np.rint(times / logs[0].dt).astype(int), 0, len(qpos) - 1):
            _pose(arm, data, qpos[k], targets[k])
            yield renderer.image(data, camera, tip[: k + 1])


def _check(logs: Sequence[Log], arm: Arm) -> None:
    if not logs or min(map(len, logs)) == 0:
        raise InputError("log: it has no tick, so there is nothing to film")
    if len({log.dt for log in logs}) > 1:
        raise InputError("log: runs with different ticks make no one film")
    for log in logs:
        if log.joint_names != arm.joint_names:
            raise InputError(f"log: it is of {log.robot} with {len(log.joint_names)} joints, not of {arm!r}")
        if log.qpos.shape[1] != arm.model.nq:
            raise InputError(f"log: it is of a model with {log.qpos.shape[1]} positions, {arm!r} has {arm.model.nq}")


def _target(log: Log) -> Array:
    """(7,) where the green target stands: at the run's goal, or at the end of its reference."""
    asked = not np.isnan(log.target[:3]).any()
    end = log.tip_ref[-1] if not log.is_open_loop else log.tip[-1]
    quat = log.target[3:] if not np.isnan(log.target[3:]).any() else np.array([1.0, 0.0, 0.0, 0.0])
    return np.concatenate([log.target[:3] if asked else end, quat])


def _state(arm: Arm, qpos: Array, target: Array) -> mujoco.MjData:
    """The model in some positions, the green target in its place."""
    data = mujoco.MjData(arm.model)
    _pose(arm, data, qpos, target)
    return data


def _pose(arm: Arm, data: mujoco.MjData, qpos: Array, target: Array) -> None:
    mocap = arm.model.body_mocapid[arm.model.body(TARGET).id]
    if mocap >= 0:
        data.mocap_pos[mocap], data.mocap_quat[mocap] = target[:3], target[3:]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_comPos(arm.model, data)
    mujoco.mj_camlight(arm.model, data)
    if arm.model.ntendon:
        mujoco.mj_tendon(arm.model, data)


def _write_mp4(path: Path, frames: Iterable[Image], per_second: int, size: tuple[int, int]) -> None:
    import av

    with av.open(path, "w") as container:
        stream = container.add_stream("h264", rate=per_second)
        stream.width, stream.height = size
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "20", "preset": "veryfast"}
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode())


def _write_gif(path: Path, frames: Iterable[Image], per_second: int) -> None:
    """One palette for all frames, made from the first, middle and last, so that nothing flickers."""
    from PIL import Image as Picture

    images = list(frames)
    sample = np.concatenate([images[0], images[len(images) // 2], images[-1]])
    palette = Picture.fromarray(sample).quantize(256, Picture.Quantize.MAXCOVERAGE)
    pictures = [Picture.fromarray(image).quantize(palette=palette, dither=Picture.Dither.NONE) for image in images]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=1000 // per_second, loop=0, optimize=True)


def _with_progress(path: Path, frames: Iterable[Image], count: int) -> Iterator[Image]:
    with progress_bar(path.name, count, "frames") as progress:
        for image in frames:
            yield image
            progress.update()
