"""``python -m bench.cli`` and ``teatbench``: Ctrl-C has its sentence also while it all loads."""

import os
import signal
import sys


def main() -> int:
    """Run the command of this process; gives back its exit code."""
    code, words = 3, b"teatbench: interrupted: nothing was begun.\n"  # of CODES, which loads slowly

    def end(*_: object) -> None:
        os.write(2, words)
        os._exit(code)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)
    from bench.cli.main import main as run

    words = b"teatbench: interrupted.\n"
    try:
        code, words = run(), b""
    except SystemExit as ended:  # argparse's
        code, words = int(ended.code or 0), b""
    return code


if __name__ == "__main__":
    sys.exit(main())
