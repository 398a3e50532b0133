"""The structs that MuJoCo lists are where its library keeps contacts."""

import ctypes

import mujoco
import numpy as np
import pytest

from armctl.core.errors import ModelError
from armctl.run.sim import mujoco_structs

RESTING = """<mujoco><worldbody><geom type="plane" size="9 9 1"/>{}</worldbody></mujoco>"""
BALL = '<body pos="{} 0 0.09"><freejoint/><geom size="0.1"/></body>'
BOX = '<body pos="{} 1 0.09"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>'


@pytest.mark.parametrize(("balls", "boxes"), [(0, 0), (1, 1), (3, 1), (0, 2)])
def test_contacts_are_read_from_memory_as_mujoco_gives_them(balls, boxes):
    bodies = [BALL.format(k) for k in range(balls)] + [BOX.format(k) for k in range(boxes)]
    model = mujoco.MjModel.from_xml_string(RESTING.format("".join(bodies)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    layout = mujoco_structs.contact_layout()
    assert ctypes.c_int32.from_address(data._address + layout.size).value == data.ncon
    first = ctypes.c_void_p.from_address(data._address + layout.array).value or 0
    for k in range(data.ncon):
        pair = (ctypes.c_int32 * 2).from_address(first + k * layout.stride + layout.geoms)
        assert np.array_equal(pair, data.contact.geom[k])


def test_another_layout_than_the_listed_one_is_refused(monkeypatch):
    listed = mujoco_structs.STRUCTS["mjData"]
    monkeypatch.setitem(mujoco_structs.STRUCTS, "mjData", type(listed)(listed.name, listed.declname, listed.fields[1:]))
    mujoco_structs.contact_layout.cache_clear()
    mujoco_structs._struct.cache_clear()
    try:
        with pytest.raises(ModelError, match="another layout"):
            mujoco_structs.contact_layout()
    finally:
        mujoco_structs.contact_layout.cache_clear()
        mujoco_structs._struct.cache_clear()
