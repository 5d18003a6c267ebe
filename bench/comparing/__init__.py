"""Runs held against each other: by trial, in words, and as a page."""
