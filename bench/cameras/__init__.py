"""From a rig file's cameras to frame sets that may be measured with."""
