"""`python -m armctl`: the command line."""

import sys

from armctl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
