"""``python -m ganlane.reproduce``."""

import sys

from ganlane.reproduce import main

if __name__ == "__main__":
    sys.exit(main())
