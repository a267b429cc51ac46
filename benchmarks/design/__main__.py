"""`python -m benchmarks.design [PART ...]`."""

import sys

from benchmarks.design.figures import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
