"""Sets of pairs that can be evaluated, and their truth."""
