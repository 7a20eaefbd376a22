"""Evaluation of methods on pairs with known truth: data, predictions, metrics and tables."""
