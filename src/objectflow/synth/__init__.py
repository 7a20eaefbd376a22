"""The simulated data set: objects, scenes, physics, rendering and generation."""
