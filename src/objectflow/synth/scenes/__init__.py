"""What lies where in a generated scene, and how it looks."""
