"""`python -m armctl.run.links DESCRIPTOR`: the process that holds a link; started by `armctl.run.links.process`."""

import sys

from armctl.run.links.process import serve

if __name__ == "__main__":
    serve(int(sys.argv[1]))
