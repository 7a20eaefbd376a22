"""The procedural shapes: solids made by lofting rings, and the categories built from them."""
