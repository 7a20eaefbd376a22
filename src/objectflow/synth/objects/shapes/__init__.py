"""Procedural shapes: lofted solids, and the object categories that are built from them."""
