"""`python -m csac` is `csac`."""

import sys

from csac.cli import main

sys.exit(main())
