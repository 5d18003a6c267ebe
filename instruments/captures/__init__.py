"""Captures of a link: written, read back, and played to a driver."""
