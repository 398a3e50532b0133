"""Synthetic arms for the laws of controllers."""

from pathlib import Path

import pytest
from synthetic import BENT, serial_arm

import armctl


@pytest.fixture(params=BENT)
def bent(request: pytest.FixtureRequest, tmp_path: Path) -> armctl.Arm:
    return serial_arm(tmp_path, BENT[request.param])


@pytest.fixture
def redundant(tmp_path: Path) -> armctl.Arm:
    return serial_arm(tmp_path, BENT["redundant"])
