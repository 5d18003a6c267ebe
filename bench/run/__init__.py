"""Runs a script on an open rig, to the end or to safe."""
