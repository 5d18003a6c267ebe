"""The trial script and the trials that it plans."""
