"""The rig file and its open instruments, real or emulated."""
