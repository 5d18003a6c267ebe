"""The commands: arguments, calls, exit codes; the only room that prints."""
