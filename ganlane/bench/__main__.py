"""``python -m ganlane.bench``."""

import sys

from ganlane.bench import main

if __name__ == "__main__":
    sys.exit(main())
