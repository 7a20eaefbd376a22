"""`python -m objectflow`, the same as `objectflow`."""

import sys

from objectflow.cli import main

if __name__ == "__main__":
    sys.exit(main())
