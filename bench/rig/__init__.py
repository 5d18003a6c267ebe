"""The rig file and its open instruments, real or emulated, and the guardian beside them."""
