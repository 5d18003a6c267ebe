"""Bath monitor, stability, interlocks, latch, signals."""
