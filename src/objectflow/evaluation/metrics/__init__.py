"""Metrics of one pair: flow, masks, object motions, moving objects and boundaries."""
