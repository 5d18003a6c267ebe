"""The motion stage's other end: a controller with a carriage, as far as a driver can tell."""
