"""The simulated data set: objects, their symmetry, scenes, physics, rendering; one step a file."""
