"""`python -m hiernav` is the command `hiernav`."""

import sys

from hiernav.cli import main

if __name__ == "__main__":
    sys.exit(main())
