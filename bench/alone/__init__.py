"""One instrument without a run: looked at, tried, set."""
