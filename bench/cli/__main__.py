"""``python -m bench.cli``: the command ``teatbench``."""

import sys

from _teatbench import main

if __name__ == "__main__":
    sys.exit(main())
