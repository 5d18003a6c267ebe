"""Many emulated scenes scored without instruments, in chunks on many processors."""
