"""Semi-rigid scene flow (Quiroga et al., ECCV 2014), one step per module; `estimator` combines them."""
