"""Calls a command of zig, such as `c++` or `ar`, with the arguments of a compiler: `python zig_wrapper.py c++ -O2 ...`."""

import subprocess
import sys

# Options of other linkers that zig's refuses. They only make the extension smaller.
UNKNOWN_OPTIONS = ("-Wl,-Bsymbolic", "-Wl,-dead_strip", "-Wl,-x", "-bundle")
COMPILES = ("cc", "c++")


def main() -> int:
    """Runs zig.

    Returns:
        Its exit status.
    """
    command = sys.argv[1]
    arguments = [argument for argument in sys.argv[2:] if not argument.startswith(UNKNOWN_OPTIONS)]
    if command in COMPILES:
        # By default zig compiles for the processor of this computer; a wheel must run on others as well.
        arguments.insert(0, "-mcpu=baseline")
    return subprocess.run([sys.executable, "-m", "ziglang", command, *arguments]).returncode


if __name__ == "__main__":
    sys.exit(main())
