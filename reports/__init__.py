"""A page described as data, and how it becomes HTML. Knows nothing of the bench."""
