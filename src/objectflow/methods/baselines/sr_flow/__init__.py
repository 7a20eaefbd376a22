"""Semi-rigid scene flow (Quiroga et al., ECCV 2014), one step of the method a file; `estimator` is the whole."""
