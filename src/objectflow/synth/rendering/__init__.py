"""Ray-traced colour, depth and labels of a scene."""
