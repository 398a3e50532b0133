"""All results have one form: `ok`, `reason`, and `bool(result) == result.ok`."""

import dataclasses
import inspect

import numpy as np
import pytest

import armctl


def result_classes() -> dict[str, type]:
    """Every public class with a field or a property `ok`."""
    classes = {name: getattr(armctl, name) for name in armctl.__all__}
    return {name: x for name, x in classes.items() if inspect.isclass(x) and (hasattr(x, "ok") or "ok" in fields(x))}


def fields(cls: type) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []


RETURNED = ("MoveResult", "IkResult", "IkBatch", "Report", "LimitCheck", "Peak", "TorqueCheck", "SerialChain")


def test_there_are_results():
    assert {"MoveResult", "IkResult", "Report", "LimitCheck", "TorqueCheck", "GripResult", "Iso9283", "PayloadEstimate"} <= set(
        result_classes()
    )


@pytest.mark.parametrize("name", result_classes())
def test_a_result_is_true_if_it_is_ok_and_has_a_reason(name: str):
    cls = result_classes()[name]
    assert hasattr(cls, "__bool__"), f"bool({name}) does not depend on ok"
    assert "reason" in fields(cls) or isinstance(inspect.getattr_static(cls, "reason", None), property)
    assert cls.__eq__ is object.__eq__ or not any("Array" in str(x) for x in cls.__annotations__.values()), "arrays have no =="


@pytest.mark.parametrize("ok", [True, False])
@pytest.mark.parametrize("name", [name for name, cls in result_classes().items() if {"ok", "reason"} <= set(fields(cls))])
def test_the_truth_of_a_result_is_ok(name: str, ok: bool):
    cls = result_classes()[name]
    flag = np.array([True, ok]) if name == "IkBatch" else ok
    result = cls(**(dict.fromkeys(fields(cls), 0.0) | {"ok": flag, "reason": "" if ok else "it failed"}))
    assert bool(result) is ok


@pytest.fixture(scope="module")
def results(bundled) -> dict[str, tuple]:
    """What calls return, if they succeed and if they fail."""
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.5)
    simulation = armctl.Simulation(bundled)
    reached = simulation.move_to(simulation.target)
    log = reached.log
    near = bundled.fk(bundled.home + 0.1).position
    tight = dataclasses.replace(bundled.limits, v_max=0.1 * bundled.limits.v_max)
    weak = bundled.with_limits(dataclasses.replace(bundled.limits, tau_max=0.01 * bundled.limits.tau_max))
    chain = armctl.chains("robot_arm_3dof")[0]
    return {
        "MoveResult": (reached, simulation.move_to([2.0, 0.0, 0.3])),
        "IkResult": (armctl.solve_ik(bundled, near), armctl.solve_ik(bundled, [2.0, 0.0, 0.3])),
        "IkBatch": (armctl.solve_ik_batch(bundled, [near]), armctl.solve_ik_batch(bundled, [near, [2.0, 0.0, 0.3]])),
        "Report": (armctl.Report.from_log(log), armctl.Report.from_log(log, tolerance=0.0)),
        "LimitCheck": (motion.check_limits(), motion.check_limits(tight)),
        "Peak": (motion.check_limits().peaks[0], next(peak for peak in motion.check_limits(tight).peaks if not peak.ok)),
        "TorqueCheck": (armctl.check_torque(bundled, motion), armctl.check_torque(weak, motion)),
        "SerialChain": (chain, dataclasses.replace(chain, reason="it is driven by two motors")),
    }


@pytest.mark.parametrize("name", RETURNED)
def test_a_failure_has_a_reason_and_a_success_has_none(results, name: str):
    good, bad = results[name]
    assert type(good).__name__ == name
    assert good
    assert not bad
    assert bool(np.all(good.ok))
    assert not bool(np.all(bad.ok))
    reasons = good.reason if name == "IkBatch" else [good.reason]
    assert not any(reasons)
    assert any(bad.reason) if name == "IkBatch" else len(bad.reason) > 10
