"""What a script comes to before anything moves: trials, poses, times, and what a claim needs."""
