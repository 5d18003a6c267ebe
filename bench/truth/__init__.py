"""Teat ends touched or carried by the stage, with their uncertainty."""
