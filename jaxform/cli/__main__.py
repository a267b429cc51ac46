"""`python -m jaxform.cli`: the command."""

import sys

from jaxform.cli.command import main

sys.exit(main())
