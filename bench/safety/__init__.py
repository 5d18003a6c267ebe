"""Bath monitor, stability, interlocks, latch, guardian, signals."""
