"""`python -m lodelight`."""

import sys

from lodelight.cli.main import main

sys.exit(main())
