"""What has a wire, and the simulated world behind the wires."""
