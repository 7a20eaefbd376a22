"""Training of the networks: the losses, the recipes and the loop."""
