"""What the bench takes for an instrument, and how a driver of another package becomes one."""
