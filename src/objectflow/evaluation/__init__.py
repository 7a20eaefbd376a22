"""Scores: flow, segmentation and object motions against the truth, pair by pair, then over a set."""
