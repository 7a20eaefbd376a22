"""The things in generated scenes: procedural shapes and meshes, with their symmetries."""
