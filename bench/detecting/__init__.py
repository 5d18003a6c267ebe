"""Detectors chosen by name, their answers checked, timed and scored on one frame set."""
