"""Ground truth: teat ends touched with the arm, or touched once and carried by the stage, each with its uncertainty budget."""
