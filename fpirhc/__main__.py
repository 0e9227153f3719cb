"""`python -m fpirhc` is the command line."""

import sys

from fpirhc.cli.main import main

sys.exit(main())
