"""The training-free estimator, one step per module (background, proposals, assignment); `estimator` combines them."""
