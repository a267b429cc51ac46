"""`python -m benchmarks.stability [PART ...]`."""

import sys

from benchmarks.stability.figures import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
