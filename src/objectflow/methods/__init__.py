"""Methods that estimate moving objects from two frames."""
