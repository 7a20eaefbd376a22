"""Object models of generated scenes: procedural shapes and meshes, with their symmetries."""
