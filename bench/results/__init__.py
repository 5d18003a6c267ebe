"""A run's record -> verdicts, attribution, error tables, comparison."""
