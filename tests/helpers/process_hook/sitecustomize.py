"""Python runs this file when a process of a test starts: it notes whether the process looks for robots, see robot_notes.py."""

import os
import sys

_NOTES = os.environ.get("ARMCTL_TEST_NOTES")


def _note(event: str, arguments: tuple[object, ...]) -> None:
    if event == "import" and arguments[0] == "mujoco_menagerie" and _NOTES:
        with open(_NOTES, "a", encoding="utf-8") as file:
            file.write("x")


sys.addaudithook(_note)
