"""`python -m multidrop`: the same as `multidrop`."""

import sys

from multidrop.cli import main

sys.exit(main())
