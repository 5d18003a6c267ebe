"""What `bench` promises to Python programs; the commands are written on it."""
