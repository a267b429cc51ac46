"""`python -m jaxform`: the command."""

import sys

from jaxform.cli import main

sys.exit(main())
