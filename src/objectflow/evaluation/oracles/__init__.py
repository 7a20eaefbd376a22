"""Oracles: methods that are given a part of the truth, as upper bounds."""
