"""The arm as the bench uses it: where it stands on the table, whether it can be trusted, and the commands' dialogues."""
