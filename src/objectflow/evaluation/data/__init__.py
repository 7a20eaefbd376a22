"""Where evaluated pairs come from, and what is true in them."""
