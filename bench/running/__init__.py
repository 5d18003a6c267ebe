"""A run's course: its states, its trials, what drops out and comes back, what waits, and what others may watch of it."""
