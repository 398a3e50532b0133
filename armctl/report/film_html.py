"""A film of a run as an element of an HTML page."""

from __future__ import annotations

import base64
import html
import tempfile
from pathlib import Path

from armctl.core.errors import NotInstalledError
from armctl.core.log import Log
from armctl.model.arm.arm import Arm
from armctl.report.render import record


def film_html(log: Log, arm: Arm, caption: str = "", *, size: tuple[int, int] = (320, 240)) -> str:
    """A run as a film in the page; empty where films cannot be made, because OpenGL or an encoder is missing."""
    width, height = size
    try:
        with tempfile.TemporaryDirectory() as folder:
            film = record(log, arm, Path(folder) / "run.mp4", size=size)
            data = base64.b64encode(film.read_bytes()).decode()
    except NotInstalledError:
        return ""
    video = f'<video width="{width}" height="{height}" controls autoplay loop muted src="data:video/mp4;base64,{data}"></video>'
    return f"<figure>{video}<figcaption>{html.escape(caption)}</figcaption></figure>"
