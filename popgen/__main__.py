"""`python -m popgen`."""

import sys

from popgen.cli import main

sys.exit(main())
