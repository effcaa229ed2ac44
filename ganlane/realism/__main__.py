"""``python -m ganlane.realism``."""

import sys

from ganlane.realism import main

if __name__ == "__main__":
    sys.exit(main())
