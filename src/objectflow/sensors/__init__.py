"""Models of real cameras: depth noise and missing depth, exposure and colour noise."""
