"""The training-free estimator, one step a file: background, proposals, assignment, and the whole in `estimator`."""
