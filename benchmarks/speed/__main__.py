"""`python -m benchmarks.speed [PART ...]`."""

import sys

from benchmarks.speed.bench import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
