"""The examples, and what they must print."""

import re
from pathlib import Path

from printed_outputs import difference

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# Dask, JAX and PyTorch start threads, after which other tests of the process could not fork.
APART = [path for path in EXAMPLES if re.search("dask|jax|stable_baselines3", path.read_text(encoding="utf-8"))]

# Training, sampled pushes and rounding in single precision have other numbers on another processor: the words of these must
# agree, and the numbers that a pattern finds are within bounds.
BOUNDS = {
    "76_push_a_box": (r"([\d.]+) mm", 0.0, 10.0),
    "91_ppo_learns_to_reach": (r"([\d.]+)%", 95.0, 100.0),
    "94_computed_torque_in_mjx": (r"at most (\S+) mrad", 0.0, 0.01),
}


def assert_printed(example: Path, printed: str, *, numbers: bool = True) -> None:
    """What an example prints is what the pages show of it; no page shows the output of all of them.

    Args:
        example: Its file.
        printed: What it printed.
        numbers: Whether numbers must agree, or be within bounds, too.
    """
    output = ROOT / "docs" / "outputs" / f"{example.stem}.txt"
    assert printed
    if output.is_file():
        changed = difference(output.read_text(encoding="utf-8"), printed, numbers=numbers and example.stem not in BOUNDS)
        assert not changed, f"{changed}\n`make outputs` writes docs/outputs again"
    if numbers and example.stem in BOUNDS:
        pattern, low, high = BOUNDS[example.stem]
        found = [float(number) for number in re.findall(pattern, printed)]
        assert found
        assert all(low <= number <= high for number in found), printed
