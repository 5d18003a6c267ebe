"""The motion stage: GRBL axes that move the phantom."""
