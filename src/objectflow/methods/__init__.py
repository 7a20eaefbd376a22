"""Every method that turns two frames into moving objects."""
