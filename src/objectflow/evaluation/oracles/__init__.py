"""Methods that know a part of the truth, as upper bounds."""
