"""Arms with closed loops: kinematics and equations of motion. MuJoCo's constraints and finite differences judge."""

import copy
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import mjcf, motors

import armctl
from armctl.model.arm.core_model import inverse_dynamics

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

PALLETIZER = Path(__file__).parents[3] / "examples/models/parallel_link_arm.xml"
STEP = 1e-6  # rad, of finite differences


def slider_crank():
    """A motor turns a crank, and a rod pushes a slide up a ramp, with a sprung flap on it. Nothing in it is a parallelogram."""
    geom = '<geom type="capsule" fromto="0 0 0 {} 0 0" size="0.01" mass="{}" contype="0" conaffinity="0"/>'
    flap = (
        '<body name="FLAP" pos="0.2 0 0"><joint name="flap" axis="1 0 1" stiffness="0.3" springref="0.2" damping="0.02"/>'
        f"{geom.format(0.1, 0.2)}</body>"
    )
    hinge = '<joint name="rod" axis="0 1 0" damping="0.1" armature="0.01"/>'
    rod = f'<body name="ROD" pos="0.15 0 0">{hinge}{geom.format(0.4, 0.5)}</body>'
    crank = f'<body name="CRANK"><joint name="crank" axis="0 1 0" range="-1.2 1.2"/>{geom.format(0.15, 0.3)}{rod}</body>'
    slide = '<joint name="slide" type="slide" axis="1 0 0.3" range="-0.5 0.2" damping="1" armature="0.2"/>'
    cart = f'<body name="CART" pos="0.55 0 0">{slide}{geom.format(0.1, 1.0)}{flap}<site name="tcp" pos="0.1 0 0"/></body>'
    turn = '<joint name="table" axis="0.2 0 1" range="-2 2"/>'
    tilted = f'<body name="TABLE" quat="0.9 0.3 0.1 0">{turn}{geom.format(0.1, 1)}{crank}{cart}</body>'
    rest = motors("table crank flap") + '<equality><connect name="pin" body1="ROD" body2="CART" anchor="0.4 0 0"/></equality>'
    return mujoco.MjSpec.from_string(mjcf(tilted, rest))


@pytest.fixture(scope="module", params=["palletizer", "slider crank"])
def arm(request):
    if request.param == "palletizer":
        return armctl.load(PALLETIZER)
    return armctl.load(slider_crank(), tip="FLAP")


@pytest.fixture
def states(arm):
    """Ten configurations at which the loops close, with velocities and accelerations."""
    rng = np.random.default_rng(0)
    drawn = arm.limits.random(arm.home, 10, rng)
    q = arm.joint_map.closure.inward(arm.home, drawn)
    return [(row, rng.uniform(-1, 1, arm.n), rng.uniform(-3, 3, arm.n)) for row in q]


def placed(arm, q, v=None):
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    if v is not None:
        data.qvel[:] = arm.qvel(v, q)
    mujoco.mj_fwdPosition(arm.model, data)
    mujoco.mj_fwdVelocity(arm.model, data)
    return data


def loops(arm, data):
    """The residuals (k,) and the derivatives (k, nv) of the constraints that close the loops."""
    J = np.zeros((data.nefc, arm.model.nv))
    if mujoco.mj_isSparse(arm.model):
        mujoco.mju_sparse2dense(J, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        J[:] = data.efc_J.reshape(J.shape)
    wanted = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return data.efc_pos[wanted], J[wanted]


def central(function, q, v):
    return (function(q + STEP * v) - function(q - STEP * v)) / (2 * STEP)


def test_loops_are_closed_and_speeds_keep_them_closed(arm, states):
    for q, v, _ in states:
        data = placed(arm, q, v)
        gaps, J = loops(arm, data)
        assert np.abs(gaps).max() < 1e-9
        assert np.abs(J @ data.qvel).max() < 1e-8
        passive = arm.joint_map.qpos_adr[arm.joint_map.closure.passive]
        assert central(arm.qpos, q, v)[passive] == pytest.approx(data.qvel[passive], abs=1e-7)


def test_a_configuration_has_the_same_bits_whatever_was_asked_before(arm, states):
    alone = [arm.joint_map.positions(q) for q, _, _ in states]
    together = arm.joint_map.positions(np.array([q for q, _, _ in reversed(states)]))
    assert np.array_equal(np.array(alone)[::-1], together)


def test_tips_jacobians_and_their_derivatives_are_those_of_mujoco(arm, states):
    for q, v, _ in states:
        data = placed(arm, q, v)
        frame = arm.tip_frames[0]
        T = armctl.Pose.from_rotation(data.xpos[frame.body], data.xmat[frame.body].reshape(3, 3)) @ frame.T_body_tip
        assert arm.fk(q).position == pytest.approx(T.position, abs=1e-9)
        assert arm.fk_many(q[None])[0][0] == pytest.approx(T.position, abs=1e-9)
        J = np.zeros((6, arm.model.nv))
        mujoco.mj_jac(arm.model, data, J[:3], J[3:], T.position, frame.body)
        assert arm.jacobian(q) @ v == pytest.approx(J @ data.qvel, abs=1e-8)
        at_body = np.zeros((6, arm.model.nv))
        mujoco.mj_jacBody(arm.model, data, at_body[:3], at_body[3:], frame.body)
        assert arm.jacobian(q, body=arm.model.body(frame.body).name) @ v == pytest.approx(at_body @ data.qvel, abs=1e-8)
        change = central(lambda x: arm.jacobian(x), q, v)
        assert arm.jacobian_derivative(q, v) == pytest.approx(change, abs=1e-6)


def test_the_equations_of_motion_are_those_of_mujoco_with_its_constraints(arm, states):
    """M a + bias = S tau + J^T f and J a = -dJ/dt v, with M, bias and J of MuJoCo: a rigid loop's acceleration."""
    model = arm.model
    for q, v, a in states:
        tau = arm.inverse_dynamics(q, v, a)
        data = placed(arm, q, v)
        _, J = loops(arm, data)
        rows = central(lambda x: loops(arm, placed(arm, x))[1], q, v)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        force = data.qfrc_passive - data.qfrc_bias
        force[arm.dof_adr] += tau
        K = np.block([[M, -J.T], [J, np.zeros((len(J), len(J)))]])
        found = np.linalg.lstsq(K, np.concatenate([force, -rows @ data.qvel]), rcond=1e-10)[0][: model.nv]
        assert found[arm.dof_adr] == pytest.approx(a, abs=2e-5)
        all_a = arm.joint_map.accelerations(a, q, v)
        assert found[arm.joint_map.dof_adr] == pytest.approx(all_a, abs=2e-5)
        assert arm.forward_dynamics(q, v, tau) == pytest.approx(a, abs=1e-8)
        assert arm.mass_matrix(q) @ a == pytest.approx(tau - arm.inverse_dynamics(q, v, np.zeros(arm.n)), abs=1e-8)


def test_mujoco_itself_accelerates_from_rest_as_the_arm_says(arm, states):
    exact = copy.copy(arm.model)
    exact.opt.iterations = 1000
    exact.opt.tolerance = 0.0
    for q, _, a in states:
        data = placed(arm, q)
        data.qfrc_applied[arm.dof_adr] = arm.inverse_dynamics(q, np.zeros(arm.n), a)
        mujoco.mj_forward(exact, data)
        assert data.qacc[arm.dof_adr] == pytest.approx(
            a, abs=0.05 * np.abs(a).max()
        )  # the constraints of MuJoCo yield a little


def test_gravity_is_the_derivative_of_the_potential_energy_and_the_power_that_of_all_energy(arm, states):
    for q, v, a in states:
        slope = [central(arm.potential_energy, q, each) for each in np.eye(arm.n)]
        assert arm.gravity(q) == pytest.approx(np.array(slope), abs=1e-6)
        skew = central(arm.mass_matrix, q, v) - 2 * arm.coriolis(q, v)
        assert skew + skew.T == pytest.approx(np.zeros((arm.n, arm.n)), abs=1e-6)
        assert arm.regressor(q, v, a).shape == (arm.n, len(arm.inertial_parameters))


def test_the_compiled_core_computes_what_pinocchio_does(arm, states):
    for q, v, a in states:
        tau = inverse_dynamics(arm.core_model, q[None], v[None], a[None])[0]
        assert tau == pytest.approx(arm.inverse_dynamics(q, v, a), rel=1e-10, abs=1e-9)


def test_a_payload_and_other_limits_keep_the_loops(arm):
    loaded = arm.with_payload(2.0)
    q = arm.home
    assert loaded.gravity(q) != pytest.approx(arm.gravity(q), abs=1e-3)
    assert np.array_equal(loaded.qpos(q), arm.qpos(q))
    again = pickle.loads(pickle.dumps(arm.with_limits(arm.limits.at_speed(0.5))))
    assert np.array_equal(again.inverse_dynamics(q, q, q), arm.inverse_dynamics(q, q, q))


def test_a_configuration_outside_the_passive_limits_is_refused_by_the_joint():
    arm = armctl.load(PALLETIZER)
    with pytest.raises(
        armctl.LimitError, match=r"q: the passive joint elbow would be at -2 rad, outside \[-1.400, 1.400\] rad"
    ):
        arm.checked("q", [0.0, 0.9, -1.1])


def test_a_loop_that_cannot_be_closed_is_refused_by_its_name():
    longer = slider_crank()
    longer.joint("crank").range = (-3.0, 3.0)
    longer.body("ROD").pos = (0.5, 0.0, 0.0)  # farther from the slide than the rod is long
    far = armctl.load(longer, tip="FLAP")
    q = np.array([0.0, 0.0, -1.5])
    with pytest.raises(armctl.LimitError, match="q: the loop of the equality 'pin' cannot be closed, or only"):
        far.fk(q)
    with pytest.raises(armctl.LimitError, match="q: the loop of the equality 'pin' cannot be closed, or only"):
        far.checked("q", q)


@pytest.mark.parametrize(
    "call",
    [
        lambda arm: armctl.solve_ik_all(arm, arm.fk(arm.home)),
        lambda arm: armctl.reachability(arm),
        lambda arm: armctl.DifferentialIk(arm),
        lambda arm: arm.joint_map.ratio,
        lambda arm: armctl.margins(arm, "pd"),
        lambda arm: armctl.tune(arm, "pd"),
        lambda arm: armctl.excitation(arm, duration=2.0),
        lambda arm: armctl.ExternalForce(arm),
        lambda arm: armctl.ElasticFeedforward(arm, 1e4),
    ],
)
def test_what_does_not_know_loops_says_so(call):
    with pytest.raises(armctl.ModelError, match=r"'crank parallelogram', .*: this function does not know closed loops"):
        call(armctl.load(PALLETIZER))
