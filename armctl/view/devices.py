"""HandDevices: what keyboards, gamepads and SpaceMice of the page's visitors ask for, and how fast their browsers draw.

`devices.js` reads and sends it.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed

from armctl.core.validation import Array

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

PATH = "/devices"
LEASE_S = 0.25  # for which a velocity counts; the script renews it every 40 ms
_MAX_MESSAGE_CHARACTERS = 256
FULL_SPEED = 0.1  # m/s of the tip
_FULL_TURN = 0.5  # rad/s of the tip

_Shares = tuple[float, float, float, float, float, float]


class TipVelocity(NamedTuple):
    """A velocity of the tip, world axes."""

    linear: Array  # (3,) m/s
    angular: Array  # (3,) rad/s


class HandDevices:
    """The velocity that one visitor at a time asks for. It ends if it is not renewed, and when the visitor leaves."""

    def __init__(self) -> None:
        self._commander: object = None
        self._shares: Array | None = None
        self._renewed_at = -math.inf
        self._draws_fast: bool | None = None
        self.meshes_drawn = 0  # of moving bodies, in the picture of the browser that said so last

    @property
    def draw_fast(self) -> bool:
        """Whether every browser until now draws with a graphics card; False before the first one."""
        return self._draws_fast is True

    @property
    def velocity(self) -> TipVelocity | None:
        """What is asked for now; None for nothing. Any thread may read it."""
        shares = self._shares
        if shares is None or time.monotonic() - self._renewed_at > LEASE_S:
            return None
        return TipVelocity(FULL_SPEED * shares[:3], _FULL_TURN * shares[3:])

    async def serve(self, connection: ServerConnection) -> None:
        try:
            with contextlib.suppress(ConnectionClosed):
                async for message in connection:
                    self.take(connection, message)
        finally:
            if self._commander is connection:
                self._shares = None
                self._commander = None

    def take(self, connection: object, message: str | bytes) -> None:
        """Takes a message: shares of the full speed along and about x, y, z, each in [-1, 1], whether a browser draws fast, or
        how many meshes it draws. Others are dropped.
        """
        if len(message) > _MAX_MESSAGE_CHARACTERS:
            return
        try:
            shares = msgspec.json.decode(message, type=_Shares | bool | int)
        except (msgspec.MsgspecError, ValueError):
            return
        if isinstance(shares, bool):
            self._draws_fast = shares and self._draws_fast is not False
            return
        if isinstance(shares, int):
            self.meshes_drawn = shares
            return
        if not all(map(math.isfinite, shares)) or (self._commander is not connection and self.velocity is not None):
            return
        self._commander = connection
        self._renewed_at = time.monotonic()
        self._shares = np.clip(shares, -1.0, 1.0) if any(shares) else None
