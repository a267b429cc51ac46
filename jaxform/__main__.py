"""`python -m jaxform`: the command."""

import sys

from jaxform.cli.command import main

sys.exit(main())
