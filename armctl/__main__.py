"""`python -m armctl` is the command line."""

import sys

from armctl.cli import main

if __name__ == "__main__":
    sys.exit(main())
