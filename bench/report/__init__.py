"""What a report says, as data for `reports`."""
