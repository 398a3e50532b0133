"""`python -m armctl.links DESCRIPTOR`: the process that holds a link; started by `armctl.links.process`."""

import sys

from armctl.links.process import serve

if __name__ == "__main__":
    serve(int(sys.argv[1]))
