"""Baseline methods, one per module or package."""
