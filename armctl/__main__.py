"""`python -m armctl`: the command line."""

import sys

from armctl.cli import program

if __name__ == "__main__":
    sys.exit(program())
