"""Libraries that only an export needs: imported when asked for, and missed with a sentence that says what to do."""

from __future__ import annotations

import importlib
from typing import Any

from bench.config import ConfigError


def needed(module: str, what: str) -> Any:
    """The library ``module``. Raises ConfigError where it isn't installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        why = f"{what} needs {package}, which can't be imported: {error}"
        raise ConfigError.plain(f'{why}. Get it with: pip install "teatbench[export]"') from error
