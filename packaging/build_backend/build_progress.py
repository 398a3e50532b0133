"""The steps of ninja on one line that moves; what the compiler says is printed if the build fails."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TextIO

_STEP = re.compile(r"\[(\d+)/(\d+)\] ")  # before what ninja does, such as "[3/26] Building CXX object"


def show_progress(lines: Iterable[str], out: TextIO) -> str:
    """Shows how many steps are done, if the output is a terminal.

    Args:
        lines: What ninja prints, while it runs.
        out: Where to write.

    Returns:
        What is not a step: the messages of the compiler.
    """
    messages = []
    shown = False
    for line in lines:
        step = _STEP.match(line)
        if step is None:
            messages.append(line)
        elif out.isatty():
            out.write(f"\rcompiled {step[1]} of {step[2]}")
            out.flush()
            shown = True
    if shown:
        out.write("\n")
    return "".join(messages)
