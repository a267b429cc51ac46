"""`python -m benchmarks.paper [PART ...]`."""

import sys

from benchmarks.paper.figures import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
