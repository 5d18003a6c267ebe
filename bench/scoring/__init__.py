"""Scores as pure functions: arrays in, values out. Formulas and sources: docs/scoring.md."""
