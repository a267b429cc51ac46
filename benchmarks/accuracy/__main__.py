"""`python -m benchmarks.accuracy [PART ...]`."""

import sys

from benchmarks.accuracy.validate import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
