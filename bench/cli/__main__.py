"""``python -m bench.cli`` and ``teatbench``: Ctrl-C has its sentence also while the command loads,
and costs no exit code where it has ended.
"""

import os
import signal
import sys

FAULT = 3  # of CODES, which takes a tenth of a second to load


def main() -> int:
    """Run the command of this process; gives back its exit code."""
    code, words = FAULT, b"teatbench: interrupted: nothing was begun.\n"

    def end(*_: object) -> None:
        os.write(2, words)
        os._exit(code)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)
    from bench.cli.main import main as run

    try:
        code, words = run(), b""
    except SystemExit as ended:  # argparse's
        code, words = int(ended.code or 0), b""
    return code


if __name__ == "__main__":
    sys.exit(main())
