"""The bench's own detector: thermal nominates, optics localise, stereo decides."""
