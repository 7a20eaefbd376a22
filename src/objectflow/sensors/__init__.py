"""Models of real cameras: depth noise and holes, exposure and colour noise."""
