"""A script tried on emulators before its run: what would fail, and how long it takes."""
