"""python -m lyapnet: the command line."""

import sys

from lyapnet.cli import main

sys.exit(main())
