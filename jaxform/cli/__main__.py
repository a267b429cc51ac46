"""`python -m jaxform.cli`: the command."""

import sys

from jaxform.cli import main

sys.exit(main())
