"""Run the command `csac` as `python -m csac`."""

import sys

from csac.cli import main

sys.exit(main())
