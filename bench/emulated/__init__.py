"""What a rig file says of its emulators, and the world they share stood up in this process."""
