"""`python -m fpirhc` is the command line."""

import sys

from fpirhc.cli import main

sys.exit(main())
