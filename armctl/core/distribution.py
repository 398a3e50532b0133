"""The distribution that armctl is installed from.

It is called `mujoco-armctl`. The name `armctl` on the Python package index belongs to another project, which moves real robots.
"""

import os
import sys
import warnings

from armctl.core.errors import ArmctlWarning


def warn_if_foreign_armctl_is_installed() -> None:
    """Warn if a distribution called `armctl` is installed beside this one.

    Reads only file names: `importlib.metadata` would take most of the time of `import armctl`.
    """
    for folder in sys.path:
        try:
            names = os.listdir(folder or os.curdir)
        except OSError:
            continue
        for name in names:
            if name.lower().startswith("armctl-") and name.endswith(".dist-info"):
                warnings.warn(
                    f"{os.path.join(folder, name)}: the distribution 'armctl' is another project's, which moves real robots, "
                    "and it shares the import name with mujoco-armctl; uninstall both, then install mujoco-armctl",
                    ArmctlWarning,
                    stacklevel=3,
                )
                return
